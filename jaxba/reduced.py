"""Solvers of the reduced camera system `S x = b`.

- `explicit`: S formed from chunked products over co-visible pairs, factored: dense, or as a band where it is one.
- `sparse`: S formed in blocks, conjugate gradients on the blocks.
- `implicit`: conjugate gradients with two passes over the observations a product; S is never formed.
- `power`: the power series `sum_i (B^-1 W)^i B^-1 b`, `S = B - W`, without inner products.

Source: Agarwal et al. 2010 (implicit and explicit), Weber et al. 2023, "Power Bundle Adjustment" (series).
"""

from __future__ import annotations

from collections.abc import Callable

import jax.numpy as jnp
from jax import Array, lax
from jax.scipy.linalg import solve_triangular
from jaxtyping import Float, Int

from jaxba.band import band_factor_and_solve
from jaxba.cg import conjugate_gradients
from jaxba.eliminate import CameraSystem, PointSystem, apply_reduced, coupling_rows
from jaxba.layout import Layout, PairLayout
from jaxba.linearize import Linearization
from jaxba.options import StepOptions
from jaxba.sums import outer_sum, take_rows, tree_sum

Vector = Float[Array, "cameras 9"]


def solve_reduced(
    layout: Layout, linear: Linearization, points: PointSystem, system: CameraSystem, options: StepOptions
) -> tuple[Float[Array, "cameras 9"], Int[Array, ""]]:
    """Solves for the camera step, in manifold coordinates, with the solver that the options name.

    Returns:
        The step, and the number of iterations (0 after a factorisation, the order of a power series). Not finite where
        a factorisation failed.
    """
    if options.linear_solver in ("implicit", "power"):
        apply = lambda x: apply_reduced(layout, linear, points, system, x)
        if options.linear_solver == "power":
            return _power_series(apply, system, options)
        return _iterate(apply, _preconditioner(layout, linear, points, system, apply, options), system, options)
    blocks = reduced_blocks(layout, linear, points, system)
    if options.linear_solver == "explicit":
        return factor_blocks(layout, blocks, system.right), jnp.zeros((), jnp.int32)
    apply = lambda x: apply_blocks(layout, blocks, x)
    if options.preconditioner == "schur-jacobi":
        diagonal = take_rows(blocks, _pairs(layout).diagonal)
        return _iterate(apply, _block_inverse(diagonal), system, options)
    return _iterate(apply, _preconditioner(layout, linear, points, system, apply, options), system, options)


def reduced_blocks(
    layout: Layout, linear: Linearization, points: PointSystem, system: CameraSystem
) -> Float[Array, "blocks 9 9"]:
    """The blocks of the reduced camera system's lower triangle, in the order of `PairLayout`; the last is zero."""
    pairs = _pairs(layout)
    coupling = coupling_rows(linear, points)

    def multiply(sides: tuple[Array, Array]) -> Array:
        left, right = (take_rows(coupling, side).reshape(side.shape[0], -1, 9) for side in sides)
        return outer_sum(left, right)

    # one batch after the other, so that the gathered operands stay small
    chunks = lax.map(multiply, (pairs.left, pairs.right)).reshape(-1, 81)
    blocks = tree_sum(chunks, pairs.levels)
    zero = jnp.zeros((1, 81), blocks.dtype)
    blocks = take_rows(jnp.concatenate([system.blocks.reshape(-1, 81), zero]), pairs.block_camera) - blocks
    return blocks.reshape(-1, 9, 9)


def factor_blocks(layout: Layout, blocks: Array, right: Array) -> Array:
    band = _pairs(layout).band
    if band is not None:
        return band_factor_and_solve(band, blocks, right)
    return factor_and_solve(dense_system(layout, blocks), right)


def dense_system(layout: Layout, blocks: Float[Array, "blocks 9 9"]) -> Float[Array, "unknowns unknowns"]:
    """The reduced camera system as a dense matrix; only its lower triangle is filled."""
    cameras = layout.num_cameras
    table = _pairs(layout).table
    if table is None:
        raise ValueError("this layout has no table of blocks: build it with factor=True to factor the system")
    dense = take_rows(blocks.reshape(-1, 81), table).reshape(cameras, cameras, 9, 9)
    return dense.transpose(0, 2, 1, 3).reshape(9 * cameras, 9 * cameras)


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


def factor_and_solve(matrix: Float[Array, "n n"], right: Float[Array, "cameras 9"]) -> Float[Array, "cameras 9"]:
    """Cholesky after Jacobi scaling; not finite when the matrix is not positive definite."""
    scale = lax.rsqrt(jnp.diagonal(matrix))
    factor = jnp.linalg.cholesky(matrix * scale[:, None] * scale, symmetrize_input=False)
    half = solve_triangular(factor, right.reshape(-1) * scale, lower=True)
    return (solve_triangular(factor, half, lower=True, trans="T") * scale).reshape(right.shape)


def _iterate(
    apply: Callable[[Array], Array], precondition: Callable[[Array], Array], system: CameraSystem, options: StepOptions
) -> tuple[Float[Array, "cameras 9"], Int[Array, ""]]:
    return conjugate_gradients(
        apply,
        system.right,
        precondition,
        forcing=options.cg_forcing,
        tolerance=options.cg_tolerance,
        max_iterations=options.cg_max_iterations,
    )


def _preconditioner(
    layout: Layout,
    linear: Linearization,
    points: PointSystem,
    system: CameraSystem,
    apply: Callable[[Array], Array],
    options: StepOptions,
) -> Callable[[Array], Array]:
    """`jacobi`: blocks of B. `schur-jacobi`: diagonal blocks of S. `power-series`: a short series, as Ceres' SPSE."""
    if options.preconditioner == "schur-jacobi":
        level, *levels = layout.camera_levels
        gathered = take_rows(coupling_rows(linear, points), level).reshape(level.shape[0], -1, 9)
        products = tree_sum(outer_sum(gathered, gathered), tuple(levels))
        return _block_inverse(system.blocks - products)
    inverse = _block_inverse(system.blocks)
    if options.preconditioner == "jacobi":
        return inverse
    return lambda r: _series(apply, system, inverse, r, options.preconditioner_order)


def _power_series(
    apply: Callable[[Array], Array], system: CameraSystem, options: StepOptions
) -> tuple[Float[Array, "cameras 9"], Int[Array, ""]]:
    order = options.power_order
    return _series(apply, system, _block_inverse(system.blocks), system.right, order), jnp.asarray(order, jnp.int32)


def _series(
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


def _block_inverse(blocks: Float[Array, "cameras 9 9"]) -> Callable[[Array], Array]:
    """Applies the inverses of positive definite blocks, formed once by Cholesky."""
    factor = jnp.linalg.cholesky(blocks, symmetrize_input=False)
    eye = jnp.broadcast_to(jnp.eye(blocks.shape[-1], dtype=blocks.dtype), blocks.shape)
    root = solve_triangular(factor, eye, lower=True)
    inverse = jnp.einsum("cji,cjk->cik", root, root)
    return lambda r: jnp.einsum("cab,cb->ca", inverse, r)
