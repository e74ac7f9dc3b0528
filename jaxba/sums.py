"""The two dense sums that a `Layout` makes possible: over a point's slots and over a camera's."""

from __future__ import annotations

import functools
import itertools
import math
import operator
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float, Int

from jaxba.layout import Layout
from jaxba.problem import AnyArray
from jaxba.slots import Bucket
from jaxba.together import in_haste, sum_each

WRITTEN_OUT = 32
"""Sums over so few slots of a point are written out: XLA's own loop over them is not vectorised and waits for each
addition. All eleven vectors of a point iteration in 0.46 to 0.7 of the time, up to 0.1 s longer to compile."""


def take(values: Array, index: Int[AnyArray, "..."]) -> Array:
    """Columns (last axis) of `values` at `index`, which is known to be in range."""
    return values.at[..., index].get(mode="promise_in_bounds")


def take_each(rows: Array | list[Array], index: Int[AnyArray, " n"]) -> list[Array]:
    """`take` of every row by itself: contiguous vectors, where one gather of all rows would interleave them."""
    return [row.at[index].get(mode="promise_in_bounds") for row in rows]


def take_rows(values: Array, index: Int[AnyArray, "..."]) -> Array:
    """Rows (first axis) of `values` at `index`, which is known to be in range."""
    return values.at[index].get(mode="promise_in_bounds")


def outer_sum(left: Float[Array, "n terms a"], right: Float[Array, "n terms b"]) -> Float[Array, "n a b"]:
    """`sum_k left[:, k]^T right[:, k]` for many small items, written out term by term.

    One fused loop whose inner dimension is vectorised and whose outer one is shared by threads. XLA's batched matrix
    product does neither for blocks of this size on a CPU: it took four times as long (docs/optimisations.md).
    """
    total = left[:, 0, :, None] * right[:, 0, None, :]
    for k in range(1, left.shape[1]):
        total = total + left[:, k, :, None] * right[:, k, None, :]
    return total


def total(values: Float[Array, " n"]) -> Float[Array, ""]:
    """The sum, by way of partial sums, so that float32 loses digits with the square root of n instead of with n."""
    width = int(np.sqrt(values.shape[0])) + 1
    padded = jnp.concatenate([values, jnp.zeros((-values.shape[0]) % width, values.dtype)])
    return jnp.sum(jnp.sum(padded.reshape(-1, width), axis=1))


def tree_sum(rows: Array, levels: tuple[Int[AnyArray, "_ _"], ...]) -> Array:
    """Sums rows into targets along a tree made by `trees.sum_tree`."""
    for level in levels:
        parts = [take_rows(rows, level[:, k]) for k in range(level.shape[1])]
        rows = functools.reduce(operator.add, parts)
    return rows


def point_sum(layout: Layout, values: Float[Array, "k slots"]) -> Float[Array, "k points"]:
    """Sums each point's slots; every bucket is a dense sum, a padded layout has a tree."""
    if layout.point_levels is not None:
        # every point of the tree reads the empty slot: were it not a number for one, it would be for all
        return tree_sum(jnp.where(layout.slot_mask, values, jnp.zeros_like(values)).T, layout.point_levels).T
    return _bucket_sums(values, layout.buckets)


def point_sums(layout: Layout, rows: list[Float[Array, " slots"]]) -> list[Float[Array, " points"]]:
    """`point_sum` of vectors that are stored one by one. Those over tiles, which are long, are summed in place."""
    if layout.point_levels is not None or in_haste.value:
        return list(point_sum(layout, jnp.stack(rows)))
    parts, start = [], 0
    for tiled, group in itertools.groupby(layout.buckets, key=lambda bucket: bucket[0] > 1):
        # those out of tiles are stacked at once
        buckets = tuple(group)
        for run in zip(buckets) if tiled else [buckets]:
            end = start + sum(map(math.prod, run))
            own = [row[start:end] for row in rows]
            if tiled:
                parts.append([sums.reshape(-1) for sums in sum_each([row.reshape(run[0]) for row in own], 1)])
            else:
                parts.append(list(_bucket_sums(jnp.stack(own), run)))
            start = end
    return [jnp.concatenate(pieces) for pieces in zip(*parts, strict=True)]


def _bucket_sums(values: Float[Array, "k slots"], buckets: Sequence[Bucket]) -> Float[Array, "k points"]:
    parts, start = [], 0
    for bucket in buckets:
        size = math.prod(bucket)
        block = values[:, start : start + size].reshape(-1, *bucket)
        if bucket[1] <= WRITTEN_OUT and not in_haste.value:
            sums = functools.reduce(operator.add, [block[:, :, k] for k in range(bucket[1])])
        else:
            sums = jnp.sum(block, axis=2)
        parts.append(sums.reshape(values.shape[0], -1))
        start += size
    return jnp.concatenate(parts, axis=1)
