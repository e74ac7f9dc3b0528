"""The two dense sums that a `Layout` makes possible: over a point's slots and over a camera's."""

from __future__ import annotations

import functools
import math
import operator

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float, Int

from jaxba.runtime.fusion import fast_compilation, sum_in_one_loop
from jaxba.structure.layout import Layout
from jaxba.typing import AnyArray


def take(values: Array, index: Int[AnyArray, "..."]) -> Array:
    """Columns (last axis) of `values` at `index`, which is known to be in range."""
    return values.at[..., index].get(mode="promise_in_bounds")


def take_each(rows: Array | list[Array], index: Int[AnyArray, " n"]) -> list[Array]:
    """`take` of every row by itself, as vectors of their own.

    Where they are stored together anyway, `take` of all is the faster: nine components of 250 cameras on 125,000 slots
    0.37 ms instead of 1.02. Not for the three coordinates of points: point iterations took 1.1 to 1.3 times as long so.
    """
    return [row.at[index].get(mode="promise_in_bounds") for row in rows]


def take_rows(values: Array, index: Int[AnyArray, "..."]) -> Array:
    """Rows (first axis) of `values` at `index`, which is known to be in range."""
    return values.at[index].get(mode="promise_in_bounds")


def as_rows(columns: list[Float[Array, " n"]]) -> Float[Array, "n k"]:
    """Vectors as the columns of one array.

    They are copied one after the other. What XLA makes of `jnp.stack(columns).T` asks at every entry which vector it is
    of: 2.5 ms instead of 0.8 for twenty vectors on 125,000 slots, two cores.
    """
    return jnp.concatenate([column[:, None] for column in columns], axis=1)


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
    parts, start = [], 0
    for bucket in layout.buckets:
        end = start + math.prod(bucket)
        parts.append(jnp.sum(values[:, start:end].reshape(-1, *bucket), axis=2).reshape(values.shape[0], -1))
        start = end
    return jnp.concatenate(parts, axis=1)


def point_sums(layout: Layout, rows: list[Float[Array, " slots"]]) -> list[Float[Array, " points"]]:
    """`point_sum` of vectors that are stored one by one: they are summed where they are, all at once."""
    if layout.point_levels is not None or fast_compilation.value:
        return list(point_sum(layout, jnp.stack(rows)))
    parts, start = [], 0
    for bucket in layout.buckets:
        end = start + math.prod(bucket)
        parts.append(
            [sums.reshape(-1) for sums in sum_in_one_loop([row[start:end].reshape(bucket) for row in rows], 1)]
        )
        start = end
    return [jnp.concatenate(pieces) for pieces in zip(*parts, strict=True)]
