"""Gathers and segmented sums with the index arrays of a `Layout`: sums over the slots of each point
or camera.

Some functions exist in two forms only because XLA compiles them differently; their docstrings say
which is faster."""

from __future__ import annotations

import functools
import math
import operator
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import Float, Int

from jaxba.runtime.fusion import (
    compute_in_one_loop,
    compute_unfused,
    fast_compilation,
    sum_in_one_loop,
)
from jaxba.structure.layout import Layout
from jaxba.structure.padding import POINT_CHUNK
from jaxba.typing import AnyArray


def take(values: Array, index: Int[AnyArray, "..."]) -> Array:
    """`values[..., index]` for indices that are known to be in range and not negative."""
    own = values.ndim - 1
    return _gather(values, index, axis=own, offset_dims=tuple(range(own)))


def take_each(rows: Array | list[Array], index: Int[AnyArray, " n"]) -> list[Array]:
    """`take` of every row separately, as a list of vectors.

    For rows that are stored as one array `take` is usually faster: 0.37 instead of 1.02 ms for nine
    components of 250
    cameras on 125,000 slots. For the three coordinates of points it is slower: point iterations
    took 1.1 to 1.3 times as long with `take`."""
    return [take(row, index) for row in rows]


def take_rows(values: Array, index: Int[AnyArray, "..."]) -> Array:
    """`values[index]` for indices that are known to be in range and not negative."""
    first = np.ndim(index)
    return _gather(values, index, axis=0, offset_dims=tuple(range(first, first + values.ndim - 1)))


def _gather(
    values: Array, index: Int[AnyArray, "..."], axis: int, offset_dims: tuple[int, ...]
) -> Array:
    """`lax.gather` along one axis. Tracing an indexing of JAX's arrays takes ten times as long, and
    adds operations for indices from the end."""
    dims = lax.GatherDimensionNumbers(
        offset_dims, collapsed_slice_dims=(axis,), start_index_map=(axis,)
    )
    sizes = (*values.shape[:axis], 1, *values.shape[axis + 1 :])
    return lax.gather(values, jnp.asarray(index)[..., None], dims, sizes, mode="promise_in_bounds")


def as_rows(columns: list[Float[Array, " n"]]) -> Float[Array, "n k"]:
    """`jnp.stack(columns, axis=1)`, as a concatenation.

    XLA compiles the stack to a loop that selects the vector for every entry: 2.5 instead of 0.8 ms
    for twenty vectors on 125,000 slots, two cores."""
    return jnp.concatenate([column[:, None] for column in columns], axis=1)


def outer_sum(
    left: Float[Array, "n terms a"], right: Float[Array, "n terms b"]
) -> Float[Array, "n a b"]:
    """`sum_k left[:, k]^T right[:, k]` for many small items, unrolled over k.

    XLA on a CPU compiles this to one fused loop, vectorised and multi-threaded. Its batched matrix
    product takes 1.7 times as long for blocks of this size. But it is a call of a library, as fast
    when compiled without optimisation, and that makes the loop 16 times as slow: so under
    `fast_compilation` it is the product."""
    if fast_compilation.value:
        return lax.dot_general(left, right, (((1,), (1,)), ((0,), (0,))), precision="highest")
    total = left[:, 0, :, None] * right[:, 0, None, :]
    for k in range(1, left.shape[1]):
        total = total + left[:, k, :, None] * right[:, k, None, :]
    return total


def total(values: Float[Array, " n"]) -> Float[Array, ""]:
    """The sum, in two stages: its float32 rounding error then grows with the square root of n, not
    with n."""
    width = int(np.sqrt(values.shape[0])) + 1
    padded = jnp.concatenate([values, jnp.zeros((-values.shape[0]) % width, values.dtype)])
    return jnp.sum(jnp.sum(padded.reshape(-1, width), axis=1))


def tree_sum(rows: Array, levels: tuple[Int[AnyArray, "_ _"], ...]) -> Array:
    """Sums rows into targets along a summation tree (`sum_trees.sum_tree`).

    For fewer kernels the rows of a level are gathered one by one and added if they have one axis,
    and gathered together and reduced if they have more: each of the two is one kernel there, and
    many in the other case. XLA would fuse the levels of the second kind into one kernel, which
    computes what they sum again for each: 96 instead of 2 ms for the five levels of Ladybug-49,
    padded."""
    for level in levels:
        if rows.ndim > 2:

            def level_sum(rows, level):
                return jnp.sum(take_rows(rows, level), axis=1)

            rows = compute_unfused(level_sum, rows, jnp.asarray(level), index=level)
            continue
        parts = [take_rows(rows, level[:, k]) for k in range(level.shape[1])]
        rows = functools.reduce(operator.add, parts)
    return rows


# ranks of a level up to which each is gathered by itself. More take long to compile.
UNROLLED_RANKS = 4


def prefix_sum(
    first: Array, values: Array, levels: tuple[Int[AnyArray, "_ _"], ...], axis: int
) -> Array:
    """Adds to the sums of targets the items of further ranks (`sum_trees.prefix_levels`). `first`
    are sums of the targets over the ranks that are not listed, `levels` index arrays of those that
    are; `axis` is that of the items, 0 or -1."""
    gather = take_rows if axis == 0 else take
    sums = None
    for level in reversed(levels):
        if level.shape[0] > UNROLLED_RANKS:
            part = jnp.sum(gather(values, level), axis=axis + min(axis, 0))
        else:
            part = functools.reduce(operator.add, [gather(values, rank) for rank in level])
        sums = part if sums is None else part + _lengthened(sums, part.shape[axis], axis)
    return first if sums is None else first + _lengthened(sums, first.shape[axis], axis)


def _lengthened(values: Array, length: int, axis: int) -> Array:
    widths = [(0, 0)] * values.ndim
    widths[axis] = (0, length - values.shape[axis])
    return jnp.pad(values, widths)


def _sum_of_chunks(
    layout: Layout, levels: tuple[Int[AnyArray, "_ _"], ...], chunks: Array
) -> Array:
    """Sums over the points of a padded layout, from the sums of chunks [k, chunks]."""
    count = layout.num_points

    def over_ranks(chunks: Array) -> Array:
        own = layout.slot_point[:count] == jnp.arange(count, dtype=layout.slot_point.dtype)
        first = jnp.where(own, chunks[:, :count], jnp.zeros_like(chunks[:, :count]))
        return prefix_sum(first, chunks, levels, -1)

    return compute_unfused(over_ranks, chunks, index=layout.slot_point)


def point_sum(layout: Layout, values: Float[Array, "k slots"]) -> Float[Array, "k points"]:
    """Sums over the slots of each point: a dense sum per bucket, or over chunks and then ranks in a
    padded layout."""
    if layout.point_levels is not None:
        # points read an empty chunk, of which a nan would spread to all of them
        seen = jnp.where(layout.slot_used, values, jnp.zeros_like(values))
        count = layout.num_slots // POINT_CHUNK
        chunks = functools.reduce(
            operator.add, [seen[:, k * count : (k + 1) * count] for k in range(POINT_CHUNK)]
        )
        return _sum_of_chunks(layout, layout.point_levels, chunks)
    parts = []
    start = 0
    for bucket in layout.buckets:
        end = start + math.prod(bucket)
        parts.append(
            jnp.sum(values[:, start:end].reshape(-1, *bucket), axis=2).reshape(values.shape[0], -1)
        )
        start = end
    return jnp.concatenate(parts, axis=1)


def point_sums(layout: Layout, rows: list[Float[Array, " slots"]]) -> list[Float[Array, " points"]]:
    """`point_sum` of separate vectors, in one loop and without copying them into one array."""
    if fast_compilation.value:
        return list(point_sum(layout, jnp.stack(rows)))
    if layout.point_levels is not None:
        return point_sums_of(layout, lambda rows: rows, rows)
    parts = []
    start = 0
    for bucket in layout.buckets:
        end = start + math.prod(bucket)
        parts.append(
            [
                sums.reshape(-1)
                for sums in sum_in_one_loop([row[start:end].reshape(bucket) for row in rows], 1)
            ]
        )
        start = end
    return [jnp.concatenate(pieces) for pieces in zip(*parts, strict=True)]


def point_sums_of(
    layout: Layout, function: Callable[..., list[Array]], *operands: Any
) -> list[Float[Array, " points"]]:
    """`point_sums` of what `compute_in_one_loop(function, *operands)` returns.

    With chunks it is summed over these in the loop that computes it, and never stored."""
    if layout.point_levels is None or fast_compilation.value:
        return point_sums(layout, compute_in_one_loop(function, *operands))

    def summed(*halves: Any) -> list[Array]:
        # points read an empty chunk, of which a nan would spread to all of them
        terms = [
            [jnp.where(mask, row, jnp.zeros_like(row)) for row in function(*half)]
            for mask, *half in halves
        ]
        return [functools.reduce(operator.add, rows) for rows in zip(*terms, strict=True)]

    halves = [
        jax.tree.map(
            lambda x, k=k: x.reshape(*x.shape[:-1], POINT_CHUNK, -1)[..., k, :],
            (layout.slot_used, *operands),
        )
        for k in range(POINT_CHUNK)
    ]
    return list(
        _sum_of_chunks(layout, layout.point_levels, jnp.stack(compute_in_one_loop(summed, *halves)))
    )
