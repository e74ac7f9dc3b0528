"""The reduced camera system S formed: the blocks of its lower triangle, or one dense matrix."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array
from jaxtyping import Float, Int

from jaxba.linear.blocks import pair_products
from jaxba.linear.schur import CameraSystem, PointSystem, coupling_by_camera, coupling_rows
from jaxba.model.linearize import Linearization
from jaxba.runtime.fusion import compute_unfused
from jaxba.structure.devices import sum_over_devices
from jaxba.structure.layout import Layout, PairLayout
from jaxba.structure.segment_sums import take_rows, tree_sum
from jaxba.typing import AnyArray


def reduced_blocks(
    layout: Layout, linear: Linearization, points: PointSystem, system: CameraSystem
) -> Float[Array, "blocks width width"]:
    """The blocks of the lower triangle of S, in the order of `PairLayout`; the last one is zero."""
    pairs = pairs_of(layout)
    width = system.blocks.shape[-1]
    products = sum_over_devices(layout, pair_products(pairs, coupling_by_camera(layout, points, system), width))

    def subtracted(own: Array, products: Array) -> Array:
        own = jnp.concatenate([own.reshape(-1, width**2), jnp.zeros((1, width**2), own.dtype)])
        return (take_rows(own, pairs.block_camera) - products).reshape(-1, width, width)

    return compute_unfused(subtracted, system.blocks, products, index=pairs.block_row)


def apply_blocks(
    layout: Layout, blocks: Float[Array, "blocks width width"], x: Float[Array, "cameras width"]
) -> Float[Array, "cameras width"]:
    """`S x` with S in blocks of the lower triangle; each block is read once, for itself and for its transpose."""
    pairs = pairs_of(layout)
    rows = jnp.einsum("nab,nb->na", blocks, take_rows(x, pairs.block_column))
    columns = jnp.einsum("nab,na->nb", blocks, take_rows(x, pairs.block_row))
    return tree_sum(jnp.concatenate([rows, columns]), pairs.product_levels)


def dense_coupling(
    grid: Int[AnyArray, "points cameras"], linear: Linearization, points: PointSystem
) -> Float[Array, "unknowns columns"]:
    """`W = E L^-T`, so that `S = B + D_c - W W^T`: one row per camera unknown, one column per coordinate of a point."""
    count, cameras = grid.shape
    rows = take_rows(coupling_rows(linear, points), grid).reshape(count, cameras, 3, -1)
    return rows.transpose(1, 3, 0, 2).reshape(-1, 3 * count)


def dense_system(
    layout: Layout, linear: Linearization, points: PointSystem, system: CameraSystem
) -> Float[Array, "unknowns unknowns"]:
    """`S = B + D_c - W W^T` as one dense matrix product."""
    cameras = layout.num_cameras
    wide = dense_coupling(grid_of(layout), linear, points)
    product = sum_over_devices(layout, jnp.matmul(wide, wide.T, precision="highest"))
    own = system.blocks[:, :, None, :] * jnp.eye(cameras, dtype=product.dtype)[:, None, :, None]
    return own.reshape(product.shape) - product


def pairs_of(layout: Layout) -> PairLayout:
    """Pairs of a layout; a ValueError if it lists none."""
    if layout.pairs is None:
        raise ValueError("this layout lists no pairs: build it with pairs=True for a formed reduced camera system")
    return layout.pairs


def grid_of(layout: Layout) -> Int[AnyArray, "points cameras"]:
    """Grid of a layout; a ValueError if it has none."""
    if layout.grid is None:
        raise ValueError("this layout has no grid of slots: its system is formed from pairs")
    return layout.grid
