"""Cholesky factorisation of a banded reduced camera system, tile by tile.

A window of as many tiles as the band is wide slides down the diagonal. Its first tile is factored, the tiles below are
solved for, their outer product is subtracted from the rest of the window, and the next row of tiles enters. One loop
body, whatever the length of the sequence. Source: Golub and Van Loan, "Matrix Computations", section 4.3 (band
Cholesky), with the blocked right-looking update of LAPACK's pbtrf.
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array, lax
from jax.scipy.linalg import solve_triangular
from jaxtyping import Float

from jaxba.ordering import Band
from jaxba.sums import take_rows


def band_rows(band: Band, blocks: Float[Array, "blocks 9 9"]) -> Float[Array, "tiles rows columns"]:
    """The tiles of every row up to the diagonal one, which is last; unit diagonal in the padding."""
    tiles, m, columns = band.blocks.shape
    rows = take_rows(blocks.reshape(-1, 81), band.blocks).reshape(tiles, m, columns, 9, 9)
    rows = rows.transpose(0, 1, 3, 2, 4).reshape(tiles, 9 * m, 9 * columns)
    padding = jnp.repeat(band.camera == band.place.shape[0], 9, axis=1).astype(rows.dtype)
    unit = padding[:, :, None] * jnp.eye(9 * m, dtype=rows.dtype)
    return rows.at[:, :, -9 * m :].add(unit)


def band_factor_and_solve(
    band: Band, blocks: Float[Array, "blocks 9 9"], right: Float[Array, "cameras 9"]
) -> Float[Array, "cameras 9"]:
    """Solves `S x = b`; not finite where S is not positive definite."""
    rows = band_rows(band, blocks)
    tiles, size, columns = rows.shape
    held = columns // size  # tiles in the window
    rest = columns - size
    zero = jnp.zeros((1, 9), right.dtype)
    sides = take_rows(jnp.concatenate([right, zero]), band.camera).reshape(tiles, size)

    window = jnp.zeros((columns, columns), rows.dtype)
    for k in range(held):  # row k of the window ends on the diagonal
        window = window.at[k * size : (k + 1) * size, : (k + 1) * size].set(rows[k, :, columns - (k + 1) * size :])
    entering = jnp.concatenate([rows[held:], jnp.zeros((held, size, columns), rows.dtype)])
    entering_sides = jnp.concatenate([sides[held:], jnp.zeros((held, size), rows.dtype)])

    unit = jnp.eye(size, dtype=rows.dtype)

    def eliminate(carry: tuple[Array, Array], new: tuple[Array, Array]) -> tuple[tuple[Array, Array], tuple]:
        window, side = carry
        factor = jnp.linalg.cholesky(window[:size, :size], symmetrize_input=False)
        inverse = solve_triangular(factor, unit, lower=True)
        below = jnp.matmul(window[size:, :size], inverse.T, precision="highest")
        solved = jnp.matmul(inverse, side[:size], precision="highest")
        update = jnp.matmul(below, below.T, precision="highest")
        shifted = jnp.concatenate([window[size:, size:] - update, jnp.zeros((rest, size), rows.dtype)], axis=1)
        side = jnp.concatenate([side[size:] - jnp.matmul(below, solved, precision="highest"), new[1]])
        return (jnp.concatenate([shifted, new[0]]), side), (inverse, below, solved)

    def substitute(after: Array, row: tuple[Array, Array, Array]) -> tuple[Array, Array]:
        inverse, below, solved = row
        known = jnp.matmul(below.T, after, precision="highest")
        x = jnp.matmul(inverse.T, solved - known, precision="highest")
        return jnp.concatenate([x, after])[:rest], x

    start = (window, sides[:held].reshape(-1))
    _, factored = lax.scan(eliminate, start, (entering, entering_sides))
    _, x = lax.scan(substitute, jnp.zeros(rest, rows.dtype), factored, reverse=True)
    return take_rows(x.reshape(-1, 9), band.place)
