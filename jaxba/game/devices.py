"""Rows divided among devices: what each device takes, and the only places where devices of a training talk.

Inside `jax.shard_map` over the axis `AXIS`. Each device holds equal shares of the environments and of a batch, in the
order of the devices. With one device every function returns what it was given, and nothing is in the program.
"""

from __future__ import annotations

from typing import TypeVar

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.flatten_util import ravel_pytree

Tree = TypeVar("Tree")

AXIS = "devices"
"""The mesh axis."""


def own_rows(tree: Tree, devices: int) -> Tree:
    """This device's rows of arrays that all devices hold."""
    if devices == 1:
        return tree

    def own(x: Array) -> Array:
        count = x.shape[0] // devices
        return lax.dynamic_slice_in_dim(x, lax.axis_index(AXIS) * count, count)

    return jax.tree.map(own, tree)


def all_rows(tree: Tree, devices: int) -> Tree:
    """The rows of all devices, on every device. One collective: the arrays are columns of one matrix meanwhile, of a
    type that holds all of them exactly."""
    if devices == 1:
        return tree
    leaves, structure = jax.tree.flatten(tree)
    dtype = jnp.result_type(*leaves)
    columns = [x.reshape(len(x), -1).astype(dtype) for x in leaves]
    rows = lax.all_gather(jnp.concatenate(columns, axis=1), AXIS, tiled=True)
    ends = [sum(x.shape[1] for x in columns[: k + 1]) for k in range(len(columns) - 1)]
    parts = zip(jnp.split(rows, ends, axis=1), leaves, strict=True)
    whole = [part.reshape(-1, *x.shape[1:]).astype(x.dtype) for part, x in parts]
    return jax.tree.unflatten(structure, whole)


def mean(tree: Tree, devices: int) -> Tree:
    """The mean over devices, on every device. One collective."""
    if devices == 1:
        return tree
    flat, unravel = ravel_pytree(tree)
    return unravel(lax.pmean(flat, AXIS))
