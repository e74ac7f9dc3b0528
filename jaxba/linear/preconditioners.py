"""Preconditioners of the reduced camera system.

Source: Agarwal et al. 2010 (block diagonals), Weber et al. 2023 (power series, Ceres calls it SPSE); two levels:
linear/two_level.py.
"""

from __future__ import annotations

from collections.abc import Callable

import jax.numpy as jnp
from jax import Array, lax
from jax.scipy.linalg import solve_triangular
from jaxtyping import Float

from jaxba.linear.schur import CameraSystem, PointSystem
from jaxba.linear.two_level import Anchor, coarse_preconditioner
from jaxba.model.linearize import Linearization
from jaxba.problem.options import StepOptions
from jaxba.runtime.fusion import fusion_barrier
from jaxba.structure.layout import Layout
from jaxba.structure.segment_sums import as_rows, outer_sum, take_rows, tree_sum

Operator = Callable[[Array], Array]


def preconditioner(
    layout: Layout,
    linear: Linearization,
    points: PointSystem,
    system: CameraSystem,
    anchor: Anchor,
    blocks: Float[Array, "blocks 9 9"] | None,
    apply: Operator,
    options: StepOptions,
) -> Operator:
    """The preconditioner that the options name, as a function of the residual.

    Args:
        blocks: the reduced camera system where it has been formed.
        apply: its product with a vector.
    """
    if options.preconditioner in ("jacobi", "power-series"):
        inverse = block_inverse(system.blocks)
        if options.preconditioner == "jacobi":
            return inverse
        return lambda r: series(apply, system, inverse, r, options.preconditioner_order)
    if blocks is None or layout.pairs is None:
        diagonal = diagonal_blocks(layout, linear, points, system)
    else:
        diagonal = take_rows(blocks, layout.pairs.diagonal)
    fine = block_inverse(diagonal)
    if options.preconditioner == "schur-jacobi":
        return fine
    coarse = coarse_preconditioner(layout, linear, points, system, anchor)
    return lambda r: fine(r) + coarse(r)


def diagonal_blocks(
    layout: Layout, linear: Linearization, points: PointSystem, system: CameraSystem
) -> Float[Array, "cameras 9 9"]:
    """The diagonal blocks of S, `D_c + sum J_c^T (I - Q Q^T) J_c`, from rows `F^T J_c` with `F F^T = I - Q Q^T`.

    Two rows an observation, and a sum that cannot lose its sign. A camera that sees a point twice adds a product across
    the two observations, which is left out: this is a preconditioner.
    """
    over, under = points.projected
    dot = lambda a, b: a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
    f00 = jnp.sqrt(jnp.maximum(1 - dot(over, over), 0))
    f10 = -dot(over, under) / jnp.where(f00 > 0, f00, 1)
    f11 = jnp.sqrt(jnp.maximum(1 - dot(under, under) - f10 * f10, 0))
    f00, f10, f11 = fusion_barrier(jnp.stack([f00, f10, f11]))
    first, second = linear.camera_jacobian
    columns = [f00 * a + f10 * b for a, b in zip(first, second, strict=True)] + [f11 * b for b in second]
    level, *levels = layout.camera_levels
    gathered = take_rows(as_rows(columns), level).reshape(level.shape[0], -1, 9)
    return system.only_damping + tree_sum(outer_sum(gathered, gathered), tuple(levels))


def series(
    apply: Callable[[Array], Array],
    system: CameraSystem,
    inverse: Callable[[Array], Array],
    right: Float[Array, "cameras 9"],
    order: int,
) -> Float[Array, "cameras 9"]:
    """First `order + 1` terms of `sum_i (B^-1 W)^i B^-1 b`, a symmetric map of b."""

    def body(_: Array, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        total, term = carry
        term = inverse(jnp.einsum("cab,cb->ca", system.blocks, term) - apply(term))
        return total + term, term

    start = inverse(right)
    return lax.fori_loop(0, order, body, (start, start))[0]


def block_inverse(blocks: Float[Array, "cameras 9 9"]) -> Callable[[Array], Array]:
    """Applies the inverses of positive definite blocks, formed once by Cholesky."""
    factor = jnp.linalg.cholesky(blocks, symmetrize_input=False)
    eye = jnp.broadcast_to(jnp.eye(blocks.shape[-1], dtype=blocks.dtype), blocks.shape)
    root = solve_triangular(factor, eye, lower=True)
    inverse = jnp.einsum("cji,cjk->cik", root, root)
    return lambda r: jnp.einsum("cab,cb->ca", inverse, r)
