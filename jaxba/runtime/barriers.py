"""Boundaries: two that XLA does not fuse across, and one that makes it do one thing after another."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Float, Int

from jaxba.typing import AnyArray


def materialized(rows: Float[Array, "k n"]) -> Float[Array, "k n"]:
    """The same rows, made once and stored, for values that many later expressions share.

    XLA fuses what makes a value into everything that reads it and computes it again each time; it fused the rotation of
    a camera into the gather for its observations, and so took its sine once per observation (docs/optimisations.md). On
    a CPU `optimization_barrier` is dropped before fusion, so there an exact product with the unit matrix stands in for
    it: products are never fused. A non-finite entry spoils its column.
    """
    return lax.platform_dependent(rows, cpu=_times_one, default=lax.optimization_barrier)


def _times_one(rows: Array) -> Array:
    return jnp.matmul(jnp.eye(rows.shape[0], dtype=rows.dtype), rows, precision="highest")


def apart(function: Callable[..., Array], *operands: Array, index: Int[AnyArray, "..."]) -> Array:
    """`function(*operands)`, computed by itself: XLA fuses it with nothing that comes before or after it.

    A kernel that writes its result into its place in a larger array, as the last one in the body of a loop does, runs
    on one core; and what a gather reads is fused into it and computed anew for every row that it takes. On a CPU the
    way out is a branch that is always taken: branches are computations of their own, and cost a few microseconds. On a
    GPU, where a branch makes the host wait, nothing is done.

    Args:
        function: of arrays, to one array.
        operands: its arguments.
        index: any index array that is an argument of the whole program: nowhere negative, which XLA does not know.
    """

    def nothing(*operands: Array) -> Array:
        result = jax.eval_shape(function, *operands)
        return jnp.zeros(result.shape, result.dtype)

    taken = jnp.reshape(jnp.asarray(index), -1)[0] >= 0
    branch = lambda *operands: lax.cond(taken, function, nothing, *operands)
    return lax.platform_dependent(*operands, cpu=branch, default=function)


def after(first: Array, then: Array) -> Array:
    """`then`, but not before `first` is there. A first entry of `first` that is not finite spoils it.

    For two batched LAPACK calls that do not need each other: XLA on a CPU runs them side by side, each waits for the
    threads that the other holds, and with two threads a solve stood still for ever (jax 0.10.2; random clusters on
    333 cameras). Zero times a float is not folded.
    """
    return then + 0 * jnp.ravel(first)[0]
