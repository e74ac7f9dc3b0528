"""Solvers of the reduced camera system `S x = b`.

- `explicit`: form S and factor it by Cholesky, as a band if it is one, else dense.
- `sparse`: form the non-zero blocks of S, then conjugate gradients with them.
- `implicit`: conjugate gradients without forming S; a product takes two passes over the observations.
- `cg`: the same, but `jax.scipy.sparse.linalg.cg` with a fixed number of iterations. Its derivatives are those of the
  solution, and reverse mode passes through it.

Source: Agarwal et al. 2010, "Bundle Adjustment in the Large".
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.scipy.sparse.linalg import cg
from jaxtyping import Float, Int

from jaxba.linear.band_cholesky import band_factor, band_factor_and_solve
from jaxba.linear.blocks import dense_blocks, pair_products
from jaxba.linear.border import Border, border_of, without_shared
from jaxba.linear.cholesky import factor_and_solve, factor_panels
from jaxba.linear.conjugate_gradients import conjugate_gradients
from jaxba.linear.preconditioners import preconditioner
from jaxba.linear.schur import CameraSystem, PointSystem, apply_reduced, coupling_by_camera, coupling_rows
from jaxba.linear.two_level import Anchor
from jaxba.linear.woodbury import capacitance_solve
from jaxba.model.linearize import Linearization
from jaxba.problem.options import StepOptions
from jaxba.runtime.fusion import compute_unfused
from jaxba.structure.density import has_few_points
from jaxba.structure.devices import sum_over_devices
from jaxba.structure.layout import Layout, PairLayout
from jaxba.structure.segment_sums import take_rows, tree_sum
from jaxba.typing import AnyArray

FLOAT32_SHIFT = 64.0
"""Machine epsilons added to the unit diagonal of a scaled float32 system, which rounding may have made indefinite."""

CORRECTION_FORCING = 1e-3
"""Forcing term of the float64 conjugate gradients around a float32 factorisation; they take two or three products."""

T = TypeVar("T")


def solve_reduced(
    layout: Layout,
    linear: Linearization,
    points: PointSystem,
    system: CameraSystem,
    anchor: Anchor,
    options: StepOptions,
    forcing: float | Float[Array, ""],
) -> tuple[Float[Array, "cameras width"], Int[Array, ""]]:
    """Solves `S x = b` for the camera step, in manifold coordinates, with the solver that the options name.

    Args:
        layout: the problem's observations.
        linear: residuals and Jacobians.
        points: the eliminated points.
        system: B + D_c and b.
        anchor: current poses and points, for the two-level preconditioner.
        options: linear solver and precision.
        forcing: forcing term of conjugate gradients for the solvers `sparse` and `implicit`.

    Returns:
        The step and the number of iterations (0 for a factorisation). The step is non-finite if a factorisation failed.
    """
    product = lambda x: apply_reduced(layout, linear, points, system, x)
    explicit, grid = options.linear_solver == "explicit", layout.grid
    if explicit and system.unknowns is not None:
        return _solve_bordered(layout, linear, points, system, options)
    # the system of a scene with few points is small: float32 would save nothing
    if explicit and grid is not None and (not options.mixed_precision or _by_woodbury(layout)):
        return solve_dense(layout, linear, points, system), _no_iterations()
    if not options.mixed_precision:
        if explicit:
            return factor_blocks(layout, reduced_blocks(layout, linear, points, system), system.right), _no_iterations()
        return _solve_iteratively(layout, linear, points, system, anchor, options, forcing)
    linear32, points32, system32, anchor32 = to_single((linear, points, system, anchor))
    if explicit:
        if grid is None:
            solve = factored(layout, reduced_blocks(layout, linear32, points32, system32))
        else:
            solve = factored_dense(dense_system(layout, linear32, points32, system32))
        precondition = lambda r: solve(r.astype(jnp.float32)).astype(r.dtype)
        return _conjugate_gradients(product, precondition, system, options, CORRECTION_FORCING)
    step, iterations = _solve_iteratively(layout, linear32, points32, system32, anchor32, options, forcing)
    return step.astype(system.right.dtype), iterations


def to_single(tree: T) -> T:
    """All floating point arrays in float32; booleans are unchanged."""
    return jax.tree.map(lambda x: x if x.dtype == bool else x.astype(jnp.float32), tree)


def _solve_iteratively(
    layout: Layout,
    linear: Linearization,
    points: PointSystem,
    system: CameraSystem,
    anchor: Anchor,
    options: StepOptions,
    forcing: float | Float[Array, ""],
) -> tuple[Float[Array, "cameras width"], Int[Array, ""]]:
    blocks = None
    apply = lambda x: apply_reduced(layout, linear, points, system, x)
    if options.linear_solver == "sparse":
        formed = blocks = reduced_blocks(layout, linear, points, system)
        apply = lambda x: apply_blocks(layout, formed, x)
    precondition = preconditioner(
        layout, linear, points, system, anchor, blocks, options.conjugate_gradients.preconditioner
    )
    unknowns = layout.unknowns
    if unknowns is not None and (unknowns.shared or unknowns.free is not None):  # on the range of T
        project, plain, inverse = unknowns.project, apply, precondition
        apply, precondition = lambda x: project(plain(x)), lambda r: project(inverse(r))
        system = system._replace(right=project(system.right))
    if options.linear_solver == "cg":
        # it returns no count; below the rounding error its iterations would end as 0 / 0
        budget, least = options.conjugate_gradients.budget, float(jnp.finfo(system.right.dtype).eps)
        step, _ = cg(apply, system.right, tol=least, maxiter=budget, M=precondition)
        return step, jnp.full((), budget, jnp.int32)
    return _conjugate_gradients(apply, precondition, system, options, forcing)


def _solve_bordered(
    layout: Layout, linear: Linearization, points: PointSystem, system: CameraSystem, options: StepOptions
) -> tuple[Float[Array, "cameras width"], Int[Array, ""]]:
    """Solves `T^T S T y = T^T b` for shared lenses by a factorisation, and returns `T y`."""
    assert system.unknowns is not None
    if system.unknowns.frame is not None:
        return _solve_merged(layout, linear, points, system), _no_iterations()
    project = system.unknowns.project
    product = lambda x: apply_reduced(layout, linear, points, system, x)
    if not options.mixed_precision:
        border = border_of(system.unknowns, product, system.right)
        inner = _factored_without_shared(layout, linear, points, system, border, shifted=False)
        solved = inner(jnp.concatenate([border.kept(system.right)[:, :, None], border.columns], axis=2))
        return border.finish(solved[:, :, 0], solved[:, :, 1:], system.right), _no_iterations()
    linear32, points32, system32 = to_single((linear, points, system))
    single = lambda x: apply_reduced(layout, linear32, points32, system32, x)
    border = border_of(system.unknowns, single, system32.right)
    inner = _factored_without_shared(layout, linear32, points32, system32, border, shifted=True)
    columns = inner(border.columns)

    def precondition(r: Array) -> Array:
        r32 = r.astype(jnp.float32)
        return border.finish(inner(border.kept(r32)[:, :, None])[:, :, 0], columns, r32).astype(r.dtype)

    system = system._replace(right=project(system.right))
    return _conjugate_gradients(lambda x: project(product(x)), precondition, system, options, CORRECTION_FORCING)


def _solve_merged(
    layout: Layout, linear: Linearization, points: PointSystem, system: CameraSystem
) -> Float[Array, "cameras width"]:
    """Solves `T^T S T y = T^T b` where frames and perhaps lenses are shared, as one dense matrix; returns `T y`."""
    unknowns, shape = system.unknowns, system.right.shape
    assert unknowns is not None
    if layout.grid is not None:
        matrix = dense_system(layout, linear, points, system)
    else:
        lower = dense_blocks(_pairs(layout), reduced_blocks(layout, linear, points, system))
        matrix = jnp.tril(lower) + jnp.tril(lower, -1).T
    index, size = unknowns.index(shape[0]).reshape(-1), shape[0] * shape[1]
    total = lambda rows: jax.ops.segment_sum(rows, index, num_segments=size)
    unused = total(jnp.ones_like(index)) == 0
    merged = total(total(matrix).T) + jnp.diag(unused.astype(matrix.dtype))
    return factor_and_solve(merged, total(system.right.reshape(-1)))[index].reshape(shape)


def _factored_without_shared(
    layout: Layout, linear: Linearization, points: PointSystem, system: CameraSystem, border: Border, *, shifted: bool
) -> Callable[[Array], Array]:
    """`A^-1` of several columns, where A is S without shared lenses; `shifted` for a float32 preconditioner."""
    unknowns, cameras = border.unknowns, layout.num_cameras
    if layout.grid is not None:
        matrix = dense_system(layout, linear, points, system)
        every = jnp.arange(cameras)
        blocks = matrix.reshape(cameras, -1, cameras, matrix.shape[0] // cameras).transpose(0, 2, 1, 3)
        blocks = blocks.reshape(-1, *blocks.shape[2:])
        row, column = jnp.repeat(every, cameras), jnp.tile(every, cameras)
        kept = without_shared(unknowns, blocks, row, column, row == column)
        matrix = kept.reshape(cameras, cameras, *kept.shape[1:]).transpose(0, 2, 1, 3)
        matrix = matrix.reshape(cameras * kept.shape[1], -1)
    else:
        pairs = _pairs(layout)
        formed = reduced_blocks(layout, linear, points, system)
        own = pairs.block_camera < cameras
        kept = without_shared(unknowns, formed, pairs.block_row, pairs.block_column, own)
        if pairs.band is not None:
            if shifted:
                return jax.vmap(factored(layout, kept), in_axes=2, out_axes=2)
            return jax.vmap(band_factor(pairs.band, kept).solve, in_axes=2, out_axes=2)
        matrix = dense_blocks(pairs, kept)
    flat = lambda x: x.reshape(matrix.shape[0], -1)
    if shifted:
        return jax.vmap(factored_dense(matrix), in_axes=2, out_axes=2)
    return lambda x: factor_and_solve(matrix, flat(x)).reshape(x.shape)


def _no_iterations() -> Int[Array, ""]:
    return jnp.zeros((), jnp.int32)


def reduced_blocks(
    layout: Layout, linear: Linearization, points: PointSystem, system: CameraSystem
) -> Float[Array, "blocks width width"]:
    """The blocks of the lower triangle of S, in the order of `PairLayout`; the last one is zero."""
    pairs = _pairs(layout)
    width = system.blocks.shape[-1]
    products = sum_over_devices(layout, pair_products(pairs, coupling_by_camera(layout, points, system), width))

    def subtracted(own: Array, products: Array) -> Array:
        own = jnp.concatenate([own.reshape(-1, width**2), jnp.zeros((1, width**2), own.dtype)])
        return (take_rows(own, pairs.block_camera) - products).reshape(-1, width, width)

    return compute_unfused(subtracted, system.blocks, products, index=pairs.block_row)


def solve_dense(
    layout: Layout, linear: Linearization, points: PointSystem, system: CameraSystem
) -> Float[Array, "cameras width"]:
    """Solves `S x = b` where most cameras see most points: by S itself, or by Woodbury's identity for few points."""
    if _by_woodbury(layout):
        return capacitance_solve(dense_coupling(_grid(layout), linear, points), system)
    matrix = dense_system(layout, linear, points, system)
    return factor_and_solve(matrix, system.right.reshape(-1)).reshape(system.right.shape)


def _by_woodbury(layout: Layout) -> bool:
    return layout.axis is None and has_few_points(*_grid(layout).shape)


def _grid(layout: Layout) -> Int[AnyArray, "points cameras"]:
    if layout.grid is None:
        raise ValueError("this layout has no grid of slots: its system is formed from pairs")
    return layout.grid


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
    wide = dense_coupling(_grid(layout), linear, points)
    product = sum_over_devices(layout, jnp.matmul(wide, wide.T, precision="highest"))
    own = system.blocks[:, :, None, :] * jnp.eye(cameras, dtype=product.dtype)[:, None, :, None]
    return own.reshape(product.shape) - product


def factor_blocks(
    layout: Layout, blocks: Float[Array, "blocks width width"], right: Float[Array, "cameras width"]
) -> Float[Array, "cameras width"]:
    """Solves `S x = b` by a Cholesky factorisation: of a band if the layout has one, else dense."""
    band = _pairs(layout).band
    if band is not None:
        return band_factor_and_solve(band, blocks, right)
    return factor_and_solve(dense_blocks(_pairs(layout), blocks), right.reshape(-1)).reshape(right.shape)


def factored_dense(matrix: Float[Array, "n n"]) -> Callable[[Array], Array]:
    """As `factored`, for a dense matrix."""
    scale = lax.rsqrt(jnp.diagonal(matrix))
    shift = FLOAT32_SHIFT * float(jnp.finfo(matrix.dtype).eps)
    panels = factor_panels(matrix * scale[:, None] * scale + shift * jnp.eye(matrix.shape[0], dtype=matrix.dtype))
    return lambda r: (scale * panels.solve(scale * r.reshape(-1))).reshape(r.shape)


def factored(layout: Layout, blocks: Float[Array, "blocks width width"]) -> Callable[[Array], Array]:
    """`S^-1` in float32, for a preconditioner. The diagonal is scaled to one and shifted, so that the factor exists."""
    pairs = _pairs(layout)
    if pairs.band is None:
        return factored_dense(dense_blocks(pairs, blocks))
    diagonal = jnp.diagonal(take_rows(blocks, pairs.diagonal), axis1=1, axis2=2)  # [cameras, 9]
    scale = lax.rsqrt(diagonal)
    shift = FLOAT32_SHIFT * float(jnp.finfo(blocks.dtype).eps)
    scaled = blocks * take_rows(scale, pairs.block_row)[:, :, None] * take_rows(scale, pairs.block_column)[:, None, :]
    own = (pairs.block_camera < layout.num_cameras).astype(blocks.dtype)
    scaled = scaled + shift * own[:, None, None] * jnp.eye(blocks.shape[-1], dtype=blocks.dtype)
    band = band_factor(pairs.band, scaled)
    return lambda r: scale * band.solve(scale * r)


def apply_blocks(
    layout: Layout, blocks: Float[Array, "blocks width width"], x: Float[Array, "cameras width"]
) -> Float[Array, "cameras width"]:
    """`S x` with S in blocks of the lower triangle; each block is read once, for itself and for its transpose."""
    pairs = _pairs(layout)
    rows = jnp.einsum("nab,nb->na", blocks, take_rows(x, pairs.block_column))
    columns = jnp.einsum("nab,na->nb", blocks, take_rows(x, pairs.block_row))
    return tree_sum(jnp.concatenate([rows, columns]), pairs.product_levels)


def _pairs(layout: Layout) -> PairLayout:
    if layout.pairs is None:
        raise ValueError("this layout lists no pairs: build it with pairs=True for a formed reduced camera system")
    return layout.pairs


def _conjugate_gradients(
    apply: Callable[[Array], Array],
    precondition: Callable[[Array], Array],
    system: CameraSystem,
    options: StepOptions,
    forcing: float | Float[Array, ""],
) -> tuple[Float[Array, "cameras width"], Int[Array, ""]]:
    return conjugate_gradients(
        apply,
        system.right,
        precondition,
        forcing=forcing,
        tolerance=options.conjugate_gradients.tolerance,
        max_iterations=options.conjugate_gradients.max_iterations,
    )
