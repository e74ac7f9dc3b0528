"""Sums over devices: the only place where devices of a sharded solve talk to each other.

Points are divided among devices, each with its observations and a `Layout` of its own; cameras are
on all of them. Sums over observations or points, into cameras or scalars, end in one of these
functions. Without a mesh they do nothing.

Source: the same division as in PBA (Wu et al. 2011) and DeepLM (Huang et al. 2021);
`jax.shard_map`."""

from __future__ import annotations

from typing import TypeVar

from jax import Array, lax

from jaxba.runtime.parts import kept as stored
from jaxba.structure.layout import Layout

DEVICES = "devices"  # name of the axis of the mesh over which points are divided
# name of the axis of the parts that a device computes one after the other (runtime/parts.py)
PARTS = "parts"

T = TypeVar("T")


def sum_over_devices(layout: Layout, values: T) -> T:
    """The sum of an array, or of each of a pytree, over all devices."""
    for axis in layout.axes:
        values = lax.psum(values, axis)
    return values


def kept(layout: Layout, values: T) -> T:
    """The same arrays, stored where a program over parts would compute them again
    (runtime/parts.py)."""
    return stored(values) if PARTS in layout.axes else values


def max_over_devices(layout: Layout, value: Array) -> Array:
    """The largest value of any device."""
    for axis in layout.axes:
        value = lax.pmax(value, axis)
    return value
