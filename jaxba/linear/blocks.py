"""Blocks of a symmetric matrix as sums of products over pairs of observations.

A block of the reduced camera system is a sum over the points that two cameras both see: `S_jk -= sum_i Y_ij Y_ik^T`.
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from jaxba.runtime import loops
from jaxba.runtime.fusion import compute_unfused
from jaxba.structure.covisibility import PairLayout
from jaxba.structure.segment_sums import outer_sum, prefix_sum, take_rows, tree_sum


def pair_products(
    pairs: PairLayout, rows: Float[Array, "items three_width"], width: int
) -> Float[Array, "blocks square"]:
    """`sum Y_left Y_right^T` for every block of the lower triangle; the last block is zero.

    Args:
        pairs: which rows are multiplied into which block.
        rows: `Y^T` [3, width] of every observation, flattened.
        width: number of rows and columns of a block.
    """

    def batch(parts: tuple[Array, Array, Array]) -> Array:
        *sides, sums = parts
        left, right = (take_rows(rows, side).reshape(side.shape[0], -1, width) for side in sides)
        products = compute_unfused(outer_sum, left, right, index=sums)
        return compute_unfused(lambda chunks: tree_sum(chunks, (sums,)), products, index=sums)

    # batch by batch, so that the gathered rows and their products stay in the cache
    partial = loops.map_rows(batch, (pairs.left, pairs.right, pairs.sums), pairs.used).reshape(-1, width * width)
    if pairs.used is None:
        return compute_unfused(lambda partial: tree_sum(partial, pairs.levels), partial, index=pairs.sums)
    zeros = jnp.zeros((pairs.levels[0].shape[1], width * width), partial.dtype)
    return compute_unfused(lambda partial: prefix_sum(zeros, partial, pairs.levels, 0), partial, index=pairs.sums)


def dense_blocks(pairs: PairLayout, blocks: Float[Array, "blocks width width"]) -> Float[Array, "n n"]:
    """The blocks assembled into one matrix, of which only the lower triangle is filled.

    Raises:
        ValueError: the layout was built without a table of blocks.
    """
    if pairs.table is None:
        raise ValueError("this layout has no table of blocks: build it with factor=True to factor the system")
    side, width = pairs.table.shape[0], blocks.shape[-1]
    dense = take_rows(blocks.reshape(-1, width**2), pairs.table).reshape(side, side, width, width)
    return dense.transpose(0, 2, 1, 3).reshape(width * side, width * side)
