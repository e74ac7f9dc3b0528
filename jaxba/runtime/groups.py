"""`jax.vmap` in groups of a size that suits a CPU."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jax import Array, lax

T = TypeVar("T")

# scenes that step together on a CPU, in a core's cache: 64 scenes of 10 x 40 took no less time each
GROUP = 8


def step_groups(function: Callable[..., T], *arguments: Any, shared: Any = None) -> T:
    """`jax.vmap(function)` in groups of `GROUP`, one after the other, on a CPU; at once elsewhere.

    Under `jax.vmap` the groups stay as large and there are more of them. `function` is of one
    scene, and gets `shared`, arrays that all scenes share, first if that is not None. The arguments
    have a first axis of scenes. Under `jax.vmap` the function must not close over other arrays."""
    if jax.default_backend() != "cpu":
        return _at_once(function, shared, arguments)

    @jax.custom_batching.custom_vmap
    def grouped(shared: Any, arguments: Any) -> T:
        return _grouped(function, shared, arguments)

    @grouped.def_vmap
    def more_groups(size: int, batched: Any, shared: Any, arguments: Any) -> tuple[T, Any]:
        if any(jax.tree.leaves(batched[0])):
            raise ValueError("arrays that all scenes share must not be batched")

        def whole(x, own):
            return x if own else jnp.broadcast_to(x, (size, *x.shape))

        flat = jax.tree.map(lambda x, own: _joined(whole(x, own)), arguments, batched[1])
        found = _grouped(function, shared, flat)
        found = jax.tree.map(lambda x: x.reshape(size, len(x) // size, *x.shape[1:]), found)
        return found, jax.tree.map(lambda _: True, found)

    return grouped(shared, arguments)


def _at_once(function: Callable[..., T], shared: Any, arguments: Any) -> T:
    one = function if shared is None else functools.partial(function, shared)
    return jax.vmap(one)(*arguments)


def _grouped(function: Callable[..., T], shared: Any, arguments: Any) -> T:
    count = jax.tree.leaves(arguments)[0].shape[0]
    if count <= GROUP:
        return _at_once(function, shared, arguments)
    # whole groups only: `lax.map` would run the remainder at the same time as the groups, and two
    # batched factorisations at a time can deadlock if XLA has two threads
    rows = jnp.minimum(jnp.arange(-(-count // GROUP) * GROUP), count - 1).reshape(-1, GROUP)
    found = lax.map(
        lambda a: _at_once(function, shared, a), jax.tree.map(lambda x: x[rows], arguments)
    )
    return jax.tree.map(lambda x: _joined(x)[:count], found)


def _joined(x: Array) -> Array:
    """The first two axes of an array, perhaps an empty one, as one."""
    return x.reshape(x.shape[0] * x.shape[1], *x.shape[2:])
