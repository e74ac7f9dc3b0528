"""The reduced camera system `S x = b` by a factorisation: of a band, dense, or of Woodbury's
capacitance matrix.

What cameras share is solved as `T^T S T y = T^T b`, `x = T y` (structure/unknowns.py): by merging
rows and columns of S where it is one dense matrix or has frames, else with lenses as a border
(linear/border.py), so that a band stays one."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Float

from jaxba.linear.band_cholesky import band_factor
from jaxba.linear.border import Solve, bordered, without_lenses
from jaxba.linear.cholesky import factor_and_solve, factor_panels
from jaxba.linear.formed import dense_blocks, dense_coupling, dense_system, reduced_blocks
from jaxba.linear.schur import DampedSystem, apply_reduced
from jaxba.linear.woodbury import capacitance_solve
from jaxba.structure.camera_ordering import Band
from jaxba.structure.covisibility import PairLayout
from jaxba.structure.density import has_few_points
from jaxba.structure.layout import Layout
from jaxba.structure.segment_sums import take_rows
from jaxba.structure.unknowns import Unknowns

# machine epsilons added to the unit diagonal of a scaled float32 system, indefinite by rounding
FLOAT32_SHIFT = 64.0


def in_full(layout: Layout) -> bool:
    """Whether the system is factored in float64 also if mixed precision is asked for: it is small,
    or has frames."""
    return layout.unknowns.merged or _by_woodbury(layout)


def factored(system: DampedSystem, *, rough: bool = False) -> Solve:
    """`T (T^T S T)^-1 T^T`; non-finite if S is not positive definite. The system is B + D_c and
    what is eliminated. `rough` is for a preconditioner in float32: the diagonal is scaled to one
    and shifted, so that the factor exists."""
    layout = system.layout
    unknowns = system.layout.unknowns
    if _by_woodbury(layout):
        wide = dense_coupling(system)
        return lambda right: capacitance_solve(wide, system.cameras.blocks, right)
    if layout.grid is not None:
        return _merged(unknowns, dense_system(system), rough)
    pairs = layout.part("pairs")
    blocks = reduced_blocks(system)
    if unknowns.merged:
        return _merged(unknowns, dense_blocks(pairs, blocks), rough)
    kept = without_lenses(unknowns, pairs, blocks)
    if pairs.band is None:
        solve_by_camera = _of_camera_rows(_dense(dense_blocks(pairs, kept), rough))
    else:
        solve_by_camera = _banded(pairs, pairs.band, kept, rough)

    def product(x):
        return apply_reduced(system, x)

    return bordered(unknowns, product, solve_by_camera, system.cameras.right, store=rough)


def _by_woodbury(layout: Layout) -> bool:
    if layout.grid is None or layout.axes or layout.unknowns.shared:
        return False
    return has_few_points(*layout.grid.shape)


def _merged(unknowns: Unknowns, lower: Float[Array, "n n"], rough: bool) -> Solve:
    """Of S as one matrix, of which only the lower triangle is read."""
    numbers = unknowns.numbers
    solve = _dense(numbers.merged(lower), rough)
    return lambda right: numbers.copied(solve(numbers.total(right.reshape(-1)))).reshape(
        right.shape
    )


def _dense(matrix: Float[Array, "n n"], rough: bool) -> Solve:
    if not rough:
        return lambda x: factor_and_solve(matrix, x)
    scale = lax.rsqrt(jnp.diagonal(matrix))
    panels = factor_panels(
        matrix * scale[:, None] * scale + _shift(matrix) * jnp.eye(len(matrix), dtype=matrix.dtype)
    )

    def times(x):
        return (scale if x.ndim == 1 else scale[:, None]) * x

    return lambda x: times(panels.solve(times(x)))


def _of_camera_rows(solve: Solve) -> Solve:
    """Solves for [cameras, width, ...] by a solver for [cameras * width, ...]."""
    return lambda right: solve(right.reshape(-1, *right.shape[2:])).reshape(right.shape)


def _banded(
    pairs: PairLayout, band: Band, blocks: Float[Array, "blocks width width"], rough: bool
) -> Solve:
    if rough:
        # [cameras, width]
        diagonal = jnp.diagonal(take_rows(blocks, pairs.diagonal), axis1=1, axis2=2)
        scale = lax.rsqrt(diagonal)
        sides = (
            take_rows(scale, pairs.block_row)[:, :, None],
            take_rows(scale, pairs.block_column)[:, None, :],
        )
        own = (pairs.block_camera < len(scale)).astype(blocks.dtype)[:, None, None]
        blocks = blocks * sides[0] * sides[1] + _shift(blocks) * own * jnp.eye(
            blocks.shape[-1], dtype=blocks.dtype
        )
    else:
        scale = 1.0
    factor = band_factor(band, blocks)

    def solve_column(right):
        return scale * factor.solve(scale * right) if rough else factor.solve(right)

    def solve(right):
        if right.ndim == 2:
            return solve_column(right)
        return jax.vmap(solve_column, in_axes=2, out_axes=2)(right)

    return solve


def _shift(matrix: Array) -> float:
    return FLOAT32_SHIFT * float(jnp.finfo(matrix.dtype).eps)
