"""Loops of a program whose bodies XLA runs with all threads, on every version of it.

XLA on a CPU compiles a loop that it takes for a small one to a single function, which runs on one
core and without its fast kernels (the pass `SmallWhileLoopHoistingPass`). That is good for a few
scalars; a pass over all observations takes three times as long. From jaxlib 0.12 on it takes loops
of any size for small ones. It leaves a loop alone that contains a sort, which such a function
cannot do. So the loops here, with the arguments of those of `jax.lax`, sort two integers in every
iteration, which takes less than a microsecond. A loop of `jax.lax` that contains one of these is
safe, too."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Int

from jaxba.typing import AnyArray

Carry = TypeVar("Carry")


def while_loop(
    condition: Callable[[Carry], Any], body: Callable[[Carry], Carry], start: Carry
) -> Carry:
    """`jax.lax.while_loop`, never taken for a small loop."""

    # the condition reads the counter, or XLA would remove it with its sort
    def more(loop):
        return condition(loop[1]) & (loop[0] >= 0)

    return lax.while_loop(
        more, lambda loop: (_next(loop[0]), body(loop[1])), (jnp.zeros((), jnp.int32), start)
    )[1]


def fori_loop(
    first: int | Int[Array, ""],
    end: int | Int[AnyArray, ""],
    body: Callable[[Any, Carry], Carry],
    start: Carry,
) -> Carry:
    """`jax.lax.fori_loop`, never taken for a small loop."""

    def advance(loop):
        return (_next(loop[0]), body(loop[0], loop[1]))

    begin = jnp.asarray(first, jnp.int32)
    return lax.while_loop(lambda loop: loop[0] < end, advance, (begin, start))[1]


def run_if(
    needed: Any, function: Callable[..., Carry], arguments: tuple[Any, ...], otherwise: Carry
) -> Carry:
    """`function(*arguments)` where it is needed, else `otherwise`: a loop of at most one iteration.

    Under `vmap` both branches of `jax.lax.cond` would be computed; this is, once one of the batch
    needs it. What does not change in a loop XLA computes before it, needed or not: so the arguments
    pass a barrier that is in the loop. `needed` is a boolean or 0 or 1, and the function is of
    arrays or pytrees of arrays. Values that it closes over may be evaluated even if `needed` is
    false. `otherwise` is of the type of its result."""

    def body(k: Array, _: Carry) -> Carry:
        inside, _ = lax.optimization_barrier((arguments, k))
        return function(*inside)

    return fori_loop(0, jnp.asarray(needed, jnp.int32), body, otherwise)


def map_rows(
    function: Callable[[Any], Any], rows: Any, used: Int[AnyArray, ""] | None = None
) -> Any:
    """`jax.lax.map`, never taken for a small loop: the results for the entries of a leading axis,
    one after the other. `function` is of one entry, `rows` a pytree of arrays with a common leading
    axis, at least one entry long. It is applied to `used` entries, the others giving zero; None: to
    all. With a number there are no reverse derivatives."""
    count = jax.tree.leaves(rows)[0].shape[0]

    def at(k):
        return jax.tree.map(lambda all_: lax.dynamic_index_in_dim(all_, k, keepdims=False), rows)

    if used is None:  # a scan, for reverse differentiation
        return lax.scan(
            lambda k, _: (_next(k), function(at(k))), jnp.zeros((), jnp.int32), length=count
        )[1]
    results = jax.tree.map(
        lambda one: jnp.zeros((count, *one.shape), one.dtype), jax.eval_shape(function, at(0))
    )

    def body(k: Array, results: Any) -> Any:
        def put(all_, one):
            return lax.dynamic_update_index_in_dim(all_, one, k, 0)

        return jax.tree.map(put, results, function(at(k)))

    return fori_loop(0, used, body, results)


def _next(counter: Int[Array, ""]) -> Int[Array, ""]:
    """The counter plus one, by way of a sort on a CPU."""

    def by_sort(n):
        return lax.sort(jnp.stack([n, n + 1]))[1]

    return lax.platform_dependent(counter, cpu=by_sort, default=lambda n: n + 1)
