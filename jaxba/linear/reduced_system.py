"""Solvers of the reduced camera system `S x = b`.

- `explicit`: S formed from chunked products over co-visible pairs, factored: dense, or as a band where it is one.
- `sparse`: S formed in blocks, conjugate gradients on the blocks.
- `implicit`: conjugate gradients with two passes over the observations a product; S is never formed.

Source: Agarwal et al. 2010, "Bundle Adjustment in the Large".
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Float, Int

from jaxba.linear.band_cholesky import band_factor, band_factor_and_solve
from jaxba.linear.blocks import dense_blocks, pair_products
from jaxba.linear.cholesky import factor_and_solve, factor_panels
from jaxba.linear.conjugate_gradients import conjugate_gradients
from jaxba.linear.preconditioners import preconditioner
from jaxba.linear.schur import CameraSystem, PointSystem, apply_reduced, coupling_by_camera, coupling_rows
from jaxba.linear.shared_intrinsics_solve import solve_tied
from jaxba.linear.two_level import Anchor
from jaxba.linear.woodbury import capacitance_solve
from jaxba.model.linearize import Linearization
from jaxba.problem.options import StepOptions
from jaxba.runtime.fusion import compute_unfused
from jaxba.structure.density import has_few_points
from jaxba.structure.layout import Layout, PairLayout
from jaxba.structure.segment_sums import take_rows, tree_sum
from jaxba.typing import AnyArray

SINGLE_LIFT = 64.0
"""Rounding units added to the scaled diagonal of a system formed in float32, which may have lost its sign."""

REPAIR_FORCING = 1e-3
"""Forcing term of the full-precision iteration around a float32 factorisation: two or three products."""

T = TypeVar("T")


def solve_reduced(
    layout: Layout,
    linear: Linearization,
    points: PointSystem,
    system: CameraSystem,
    anchor: Anchor,
    options: StepOptions,
    forcing: float | Float[Array, ""],
) -> tuple[Float[Array, "cameras 9"], Int[Array, ""]]:
    """Solves for the camera step, in manifold coordinates, with the solver that the options name.

    Conjugate gradients, where they are all of the solver, end by `forcing`.

    Returns:
        The step, and the number of iterations (0 after a factorisation). Not finite where
        a factorisation failed.
    """
    product = lambda x: apply_reduced(layout, linear, points, system, x)
    explicit, grid = options.linear_solver == "explicit", layout.grid
    if system.ties is not None:
        formed = _dense(layout, linear, points, system)
        return solve_tied(system.ties, formed, system.right), _no_iterations()
    # a small capacitance matrix is not worth rounding to float32
    if explicit and grid is not None and (not options.mixed_precision or has_few_points(*grid.shape)):
        return solve_dense(grid, linear, points, system), _no_iterations()
    if not options.mixed_precision:
        if explicit:
            return factor_blocks(layout, reduced_blocks(layout, linear, points, system), system.right), _no_iterations()
        return _iterate_reduced(layout, linear, points, system, anchor, options, forcing)
    rough_linear, rough_points, rough_system, rough_anchor = to_single((linear, points, system, anchor))
    if explicit:
        if grid is None:
            solve = factored(layout, reduced_blocks(layout, rough_linear, rough_points, rough_system))
        else:
            solve = factored_dense(dense_system(grid, rough_linear, rough_points, rough_system))
        precondition = lambda r: solve(r.astype(jnp.float32)).astype(r.dtype)
        return _iterate(product, precondition, system, options, REPAIR_FORCING)
    step, iterations = _iterate_reduced(
        layout, rough_linear, rough_points, rough_system, rough_anchor, options, forcing
    )
    return step.astype(system.right.dtype), iterations


def to_single(tree: T) -> T:
    """The same numbers in float32; truth values stay what they are."""
    return jax.tree.map(lambda x: x if x.dtype == bool else x.astype(jnp.float32), tree)


def _iterate_reduced(
    layout: Layout,
    linear: Linearization,
    points: PointSystem,
    system: CameraSystem,
    anchor: Anchor,
    options: StepOptions,
    forcing: float | Float[Array, ""],
) -> tuple[Float[Array, "cameras 9"], Int[Array, ""]]:
    blocks = None
    apply = lambda x: apply_reduced(layout, linear, points, system, x)
    if options.linear_solver == "sparse":
        formed = blocks = reduced_blocks(layout, linear, points, system)
        apply = lambda x: apply_blocks(layout, formed, x)
    precondition = preconditioner(
        layout, linear, points, system, anchor, blocks, options.conjugate_gradients.preconditioner
    )
    return _iterate(apply, precondition, system, options, forcing)


def _no_iterations() -> Int[Array, ""]:
    return jnp.zeros((), jnp.int32)


def reduced_blocks(
    layout: Layout, linear: Linearization, points: PointSystem, system: CameraSystem
) -> Float[Array, "blocks 9 9"]:
    """The blocks of the reduced camera system's lower triangle, in the order of `PairLayout`; the last is zero."""
    pairs = _pairs(layout)
    products = pair_products(pairs, coupling_by_camera(layout, points, system), 9)

    def subtracted(own: Array, products: Array) -> Array:
        own = jnp.concatenate([own.reshape(-1, 81), jnp.zeros((1, 81), own.dtype)])
        return (take_rows(own, pairs.block_camera) - products).reshape(-1, 9, 9)

    return compute_unfused(subtracted, system.blocks, products, index=pairs.block_row)


def solve_dense(
    grid: Int[AnyArray, "points cameras"], linear: Linearization, points: PointSystem, system: CameraSystem
) -> Float[Array, "cameras 9"]:
    """Solves the reduced camera system of a dense scene, by way of the smaller one of two matrices."""
    if has_few_points(*grid.shape):
        return capacitance_solve(dense_coupling(grid, linear, points), system)
    matrix = dense_system(grid, linear, points, system)
    return factor_and_solve(matrix, system.right.reshape(-1)).reshape(system.right.shape)


def dense_coupling(
    grid: Int[AnyArray, "points cameras"], linear: Linearization, points: PointSystem
) -> Float[Array, "unknowns columns"]:
    """W, which couples cameras and points: a row per camera unknown, a column per coordinate of each point."""
    count, cameras = grid.shape
    rows = take_rows(coupling_rows(linear, points), grid).reshape(count, cameras, 3, 9)
    return rows.transpose(1, 3, 0, 2).reshape(9 * cameras, 3 * count)


def dense_system(
    grid: Int[AnyArray, "points cameras"], linear: Linearization, points: PointSystem, system: CameraSystem
) -> Float[Array, "unknowns unknowns"]:
    """The reduced camera system as one product `diag(B) - W W^T`."""
    cameras = grid.shape[1]
    wide = dense_coupling(grid, linear, points)
    product = jnp.matmul(wide, wide.T, precision="highest")
    own = system.blocks[:, :, None, :] * jnp.eye(cameras, dtype=product.dtype)[:, None, :, None]
    return own.reshape(9 * cameras, 9 * cameras) - product


def _dense(layout: Layout, linear: Linearization, points: PointSystem, system: CameraSystem) -> Float[Array, "n n"]:
    """The reduced camera system as one matrix; only its lower triangle is filled."""
    if layout.grid is not None:
        return dense_system(layout.grid, linear, points, system)
    return dense_blocks(_pairs(layout), reduced_blocks(layout, linear, points, system).reshape(-1, 81), 9)


def factor_blocks(
    layout: Layout, blocks: Float[Array, "blocks 9 9"], right: Float[Array, "cameras 9"]
) -> Float[Array, "cameras 9"]:
    """Solves by a Cholesky factorisation, of a band where the layout has found one."""
    band = _pairs(layout).band
    if band is not None:
        return band_factor_and_solve(band, blocks, right)
    return factor_and_solve(dense_blocks(_pairs(layout), blocks.reshape(-1, 81), 9), right.reshape(-1)).reshape(
        right.shape
    )


def factored_dense(matrix: Float[Array, "n n"]) -> Callable[[Array], Array]:
    """As `factored`, of a dense matrix."""
    scale = lax.rsqrt(jnp.diagonal(matrix))
    lift = SINGLE_LIFT * float(jnp.finfo(matrix.dtype).eps)
    panels = factor_panels(matrix * scale[:, None] * scale + lift * jnp.eye(matrix.shape[0], dtype=matrix.dtype))
    return lambda r: (scale * panels.solve(scale * r.reshape(-1))).reshape(r.shape)


def factored(layout: Layout, blocks: Float[Array, "blocks 9 9"]) -> Callable[[Array], Array]:
    """The inverse of a system known to rounding only, for a preconditioner: its scaled diagonal is lifted a little."""
    pairs = _pairs(layout)
    if pairs.band is None:
        return factored_dense(dense_blocks(pairs, blocks.reshape(-1, 81), 9))
    diagonal = jnp.diagonal(take_rows(blocks, pairs.diagonal), axis1=1, axis2=2)  # [cameras, 9]
    scale = lax.rsqrt(diagonal)
    lift = SINGLE_LIFT * float(jnp.finfo(blocks.dtype).eps)
    scaled = blocks * take_rows(scale, pairs.block_row)[:, :, None] * take_rows(scale, pairs.block_column)[:, None, :]
    own = (pairs.block_camera < layout.num_cameras).astype(blocks.dtype)
    scaled = scaled + lift * own[:, None, None] * jnp.eye(9, dtype=blocks.dtype)
    band = band_factor(pairs.band, scaled)
    return lambda r: scale * band.solve(scale * r)


def apply_blocks(
    layout: Layout, blocks: Float[Array, "blocks 9 9"], x: Float[Array, "cameras 9"]
) -> Float[Array, "cameras 9"]:
    """`S x` with S in blocks: each one is read once and serves its own place and its mirror image."""
    pairs = _pairs(layout)
    rows = jnp.einsum("nab,nb->na", blocks, take_rows(x, pairs.block_column))
    columns = jnp.einsum("nab,na->nb", blocks, take_rows(x, pairs.block_row))
    return tree_sum(jnp.concatenate([rows, columns]), pairs.product_levels)


def _pairs(layout: Layout) -> PairLayout:
    if layout.pairs is None:
        raise ValueError("this layout lists no pairs: build it with pairs=True for a formed reduced camera system")
    return layout.pairs


def _iterate(
    apply: Callable[[Array], Array],
    precondition: Callable[[Array], Array],
    system: CameraSystem,
    options: StepOptions,
    forcing: float | Float[Array, ""],
) -> tuple[Float[Array, "cameras 9"], Int[Array, ""]]:
    return conjugate_gradients(
        apply,
        system.right,
        precondition,
        forcing=forcing,
        tolerance=options.conjugate_gradients.tolerance,
        max_iterations=options.conjugate_gradients.max_iterations,
    )
