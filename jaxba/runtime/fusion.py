"""Control over what XLA fuses: barriers that it does not fuse across, and several results in one
loop.

XLA fuses the expression that makes a value into every expression that reads it, and computes it
again in each. That is right for cheap values. The functions here are for the others: they never
change a result by more than rounding."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Float, Int

from jaxba.typing import AnyArray

Result = TypeVar("Result")

fast_compilation = jax.make_user_context(False)
"""Whether what is traced will be compiled by XLA's older kernel emitters with less optimisation
(`jaxba.runtime.compilation`). `compute_in_one_loop` would do twice the work there and take longer
to compile, so it does nothing then. With the newer emitters it pays without optimisation, too."""


def fusion_barrier(rows: Float[Array, "k n"]) -> Float[Array, "k n"]:
    """The same rows, computed once and stored: XLA does not fuse their computation into the
    expressions that read them.

    Without it XLA fuses the rotation of a camera into the gather for its observations, and takes
    its sine once per observation. On a CPU `optimization_barrier` is dropped before fusion, so
    there an exact product with the unit matrix stands in for it: products are never fused. A
    non-finite entry spoils its column."""

    def times_identity(rows):
        return jnp.matmul(jnp.eye(len(rows), dtype=rows.dtype), rows, precision="highest")

    return lax.platform_dependent(rows, cpu=times_identity, default=lax.optimization_barrier)


def compute_unfused(
    function: Callable[..., Result], *operands: Array, index: Int[AnyArray, "..."]
) -> Result:
    """`function(*operands)` in a kernel of its own: XLA fuses it with nothing that comes before or
    after it.

    A kernel that writes its result into a larger array, as the last one in the body of a loop does,
    runs on one core; and what a gather reads is fused into it and computed anew for every row. On a
    CPU a branch that is always taken avoids both: branches are computations of their own, and cost
    a few microseconds. On a GPU, where a branch makes the host wait, nothing is done. The function
    is of arrays, to one or several. `index` is any index array that is an argument of the whole
    program: nowhere negative, which XLA does not know."""

    def never(*operands: Array) -> Result:
        return jax.tree.map(
            lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(function, *operands)
        )

    taken = jnp.reshape(jnp.asarray(index), -1)[0] >= 0

    def branch(*operands):
        return lax.cond(taken, function, never, *operands)

    return lax.platform_dependent(*operands, cpu=branch, default=function)


def computed_after(dependency: Array, value: Array) -> Array:
    """`value`, made to depend on `dependency`, so that XLA computes the two one after the other.

    For two batched LAPACK calls that do not need each other: XLA on a CPU runs them side by side,
    each waits for the threads that the other holds, and with two threads a solve deadlocks (jax
    0.10.2; random clusters on 333 cameras). Zero times a float is not folded away. A first entry of
    `dependency` that is not finite makes `value` NaN."""
    return value + 0 * jnp.ravel(dependency)[0]


def compute_in_one_loop(function: Callable[..., list[Array]], *operands: Any) -> list[Array]:
    """`function(*operands)`, in one loop on a CPU unless `fast_compilation`; elsewhere as XLA makes
    it.

    XLA on a CPU makes every vector of a program in a loop of its own, which computes anew, or reads
    anew from memory, what vectors share: each of the 28 vectors of a linearisation would project
    its points again. A reduction of many operands is the one loop to which XLA gives several
    results. So the vectors are written as sums over an axis of two whose second half is zero: LLVM
    unrolls that axis, drops the zero half, and vectorises the rest, as it does for no reduction
    over three and more.

    The function is of arrays whose last axis is the loop's, elementwise in it: it indexes only the
    axes before, and returns vectors, at least one. A gather inside keeps LLVM from vectorising.
    Operands are arrays, or pytrees of them, whose last axis is the loop's. A gathered one, or one
    that several vectors are made of, is better stored before (`fusion_barrier`)."""

    def one_loop(*operands: Any) -> list[Array]:
        def twice(x):
            return jnp.broadcast_to(jnp.expand_dims(x, -2), (*x.shape[:-1], 2, x.shape[-1]))

        rows = function(*jax.tree.map(twice, operands))
        # one loop anyway, and XLA hands a sum of one operand to a library, which is slow
        if len(rows) == 1:
            return function(*operands)
        first = lax.broadcasted_iota(jnp.int32, rows[0].shape, 0) == 0
        return sum_in_one_loop([jnp.where(first, row, jnp.zeros_like(row)) for row in rows], 0)

    if fast_compilation.value:
        return function(*operands)
    return lax.platform_dependent(*operands, cpu=one_loop, default=function)


def sum_in_one_loop(rows: list[Array], axis: int) -> list[Array]:
    """Sums of several arrays of one shape over an axis, all in one loop."""

    def add(left, right):
        return [a + b for a, b in zip(left, right, strict=True)]

    return lax.reduce(rows, [jnp.zeros((), row.dtype) for row in rows], add, (axis,))
