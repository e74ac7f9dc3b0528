"""Sums of products over pairs, as blocks of a symmetric matrix."""

from __future__ import annotations

from jax import Array, lax
from jaxtyping import Float

from jaxba.runtime.fusion import compute_unfused
from jaxba.structure.covisibility import PairLayout
from jaxba.structure.segment_sums import outer_sum, take_rows, tree_sum


def pair_products(
    pairs: PairLayout, rows: Float[Array, "items three_width"], width: int
) -> Float[Array, "blocks square"]:
    """`sum Y_left Y_right^T` for every block of the lower triangle; the last block is zero.

    Args:
        pairs: which rows multiply into which block.
        rows: `Y` of every slot, its three columns one after the other, each of length `width`.
        width: unknowns of a block's side.
    """

    def batch(parts: tuple[Array, Array, Array]) -> Array:
        *sides, sums = parts
        left, right = (take_rows(rows, side).reshape(side.shape[0], -1, width) for side in sides)
        products = compute_unfused(outer_sum, left, right, index=sums)
        return compute_unfused(lambda chunks: tree_sum(chunks, (sums,)), products, index=sums)

    # one batch after the other, so that what is gathered and its products stay in cache
    partial = lax.map(batch, (pairs.left, pairs.right, pairs.sums)).reshape(-1, width * width)
    return compute_unfused(lambda partial: tree_sum(partial, pairs.levels), partial, index=pairs.sums)


def dense_blocks(pairs: PairLayout, blocks: Float[Array, "blocks square"], width: int) -> Float[Array, "n n"]:
    """The matrix made of the blocks; only its lower triangle is filled."""
    if pairs.table is None:
        raise ValueError("this layout has no table of blocks: build it with factor=True to factor the system")
    side = pairs.table.shape[0]
    dense = take_rows(blocks, pairs.table).reshape(side, side, width, width)
    return dense.transpose(0, 2, 1, 3).reshape(width * side, width * side)
