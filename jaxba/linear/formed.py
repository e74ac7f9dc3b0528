"""The reduced camera system S formed: the blocks of its lower triangle, or one dense matrix.

A block is a sum over the points that two cameras both see: `S_jk -= sum_i Y_ij Y_ik^T`."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from jaxba.linear.schur import DampedSystem, coupling_by_camera, coupling_rows
from jaxba.runtime import loops
from jaxba.runtime.fusion import compute_unfused
from jaxba.structure.covisibility import PairLayout
from jaxba.structure.devices import sum_over_devices
from jaxba.structure.layout import Layout
from jaxba.structure.segment_sums import outer_sum, prefix_sum, take_rows, tree_sum


def reduced_blocks(system: DampedSystem) -> Float[Array, "blocks width width"]:
    """The blocks of the lower triangle of S, in the order of `PairLayout`; the last one is zero."""
    layout = system.layout
    blocks = system.cameras.blocks
    pairs = layout.part("pairs")
    width = blocks.shape[-1]
    products = sum_over_devices(layout, pair_products(pairs, coupling_by_camera(system), width))

    def subtracted(own: Array, products: Array) -> Array:
        own = jnp.concatenate([own.reshape(-1, width**2), jnp.zeros((1, width**2), own.dtype)])
        return (take_rows(own, pairs.block_camera) - products).reshape(-1, width, width)

    return compute_unfused(subtracted, blocks, products, index=pairs.block_row)


def apply_blocks(
    layout: Layout, blocks: Float[Array, "blocks width width"], x: Float[Array, "cameras width"]
) -> Float[Array, "cameras width"]:
    """`S x` with S in blocks of the lower triangle; each block is read once, for itself and for its
    transpose."""
    pairs = layout.part("pairs")
    rows = jnp.einsum("nab,nb->na", blocks, take_rows(x, pairs.block_column))
    columns = jnp.einsum("nab,na->nb", blocks, take_rows(x, pairs.block_row))
    return tree_sum(jnp.concatenate([rows, columns]), pairs.product_levels)


def dense_coupling(system: DampedSystem) -> Float[Array, "unknowns columns"]:
    """`W = E L^-T`, so that `S = B + D_c - W W^T`: one row per camera unknown, one column per
    coordinate of a point."""
    grid = system.layout.part("grid")
    count, cameras = grid.shape
    rows = take_rows(coupling_rows(system), grid).reshape(count, cameras, 3, -1)
    return rows.transpose(1, 3, 0, 2).reshape(-1, 3 * count)


def dense_system(system: DampedSystem) -> Float[Array, "unknowns unknowns"]:
    """`S = B + D_c - W W^T` as one dense matrix product."""
    layout = system.layout
    wide = dense_coupling(system)
    product = sum_over_devices(layout, jnp.matmul(wide, wide.T, precision="highest"))
    unit = jnp.eye(layout.num_cameras, dtype=product.dtype)
    own = system.cameras.blocks[:, :, None, :] * unit[:, None, :, None]
    return own.reshape(product.shape) - product


def pair_products(
    pairs: PairLayout, rows: Float[Array, "items three_width"], width: int
) -> Float[Array, "blocks square"]:
    """`sum Y_left Y_right^T` for every block of the lower triangle; the last block is zero. `pairs`
    says which rows are multiplied into which block, `rows` are `Y^T` [3, width] of every
    observation, flattened."""

    def batch(parts: tuple[Array, Array, Array]) -> Array:
        *sides, sums = parts
        left, right = (take_rows(rows, side).reshape(side.shape[0], -1, width) for side in sides)
        products = compute_unfused(outer_sum, left, right, index=sums)
        return tree_sum(products, (sums,))

    # batch by batch, so that the gathered rows and their products stay in the cache
    partial = loops.map_rows(batch, (pairs.left, pairs.right, pairs.sums), pairs.used).reshape(
        -1, width * width
    )
    if pairs.used is None:
        return compute_unfused(
            lambda partial: tree_sum(partial, pairs.levels), partial, index=pairs.sums
        )
    zeros = jnp.zeros((pairs.levels[0].shape[1], width * width), partial.dtype)
    return compute_unfused(
        lambda partial: prefix_sum(zeros, partial, pairs.levels, 0), partial, index=pairs.sums
    )


def dense_blocks(
    pairs: PairLayout, blocks: Float[Array, "blocks width width"]
) -> Float[Array, "n n"]:
    """The blocks assembled into one matrix, of which only the lower triangle is filled."""
    assert pairs.table is not None
    side = pairs.table.shape[0]
    width = blocks.shape[-1]
    dense = take_rows(blocks.reshape(-1, width**2), pairs.table).reshape(side, side, width, width)
    return dense.transpose(0, 2, 1, 3).reshape(width * side, width * side)
