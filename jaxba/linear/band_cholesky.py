"""Cholesky factorisation of a banded reduced camera system, tile by tile.

A window of as many tiles as the band is wide slides down the diagonal. Its first tile is factored, the tiles below are
solved for, their outer product is subtracted from the rest of the window, and the next row of tiles enters. One loop
body, whatever the length of the sequence. Source: Golub and Van Loan, "Matrix Computations", section 4.3 (band
Cholesky), with the blocked right-looking update of LAPACK's pbtrf.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array, lax
from jax.scipy.linalg import solve_triangular
from jaxtyping import Float

from jaxba.structure.camera_ordering import Band
from jaxba.structure.segment_sums import take_rows


def band_rows(band: Band, blocks: Float[Array, "blocks 9 9"]) -> Float[Array, "tiles rows columns"]:
    """The tiles of every row up to the diagonal one, which is last; unit diagonal in the padding."""
    tiles, m, columns = band.blocks.shape
    rows = take_rows(blocks.reshape(-1, 81), band.blocks).reshape(tiles, m, columns, 9, 9)
    rows = rows.transpose(0, 1, 3, 2, 4).reshape(tiles, 9 * m, 9 * columns)
    padding = jnp.repeat(band.camera == band.place.shape[0], 9, axis=1).astype(rows.dtype)
    unit = padding[:, :, None] * jnp.eye(9 * m, dtype=rows.dtype)
    return rows.at[:, :, -9 * m :].add(unit)


class BandFactor(NamedTuple):
    """A Cholesky factor by tiles."""

    band: Band
    inverses: Float[Array, "tiles size size"]  # of the diagonal tiles
    below: Float[Array, "tiles rest size"]  # what stands below them within the band

    def solve(self, right: Float[Array, "cameras 9"]) -> Float[Array, "cameras 9"]:
        """Solves `L L^T x = b`."""
        tiles, rest, size = self.below.shape
        zero = jnp.zeros((1, 9), right.dtype)
        sides = take_rows(jnp.concatenate([right, zero]), self.band.camera).reshape(tiles, size)

        def forward(before: Array, row: tuple[Array, Array, Array]) -> tuple[Array, Array]:
            side, inverse, below = row
            half = jnp.matmul(inverse, side - before[:size], precision="highest")
            after = jnp.concatenate([before, jnp.zeros(size, right.dtype)])[size:]
            return after + jnp.matmul(below, half, precision="highest"), half

        def backward(after: Array, row: tuple[Array, Array, Array]) -> tuple[Array, Array]:
            half, inverse, below = row
            known = jnp.matmul(below.T, after, precision="highest")
            x = jnp.matmul(inverse.T, half - known, precision="highest")
            return jnp.concatenate([x, after])[:rest], x

        nothing = jnp.zeros(rest, right.dtype)
        # before its turn a tile has no more than `rest` rows to subtract from; with no tile below there is none
        padded = nothing if rest else jnp.zeros(size, right.dtype)
        _, halves = lax.scan(forward if rest else _alone, padded, (sides, self.inverses, self.below))
        _, x = lax.scan(backward, nothing, (halves, self.inverses, self.below), reverse=True)
        return take_rows(x.reshape(-1, 9), self.band.place)


def _alone(nothing: Array, row: tuple[Array, Array, Array]) -> tuple[Array, Array]:
    side, inverse, _ = row
    return nothing, jnp.matmul(inverse, side, precision="highest")


def band_factor(band: Band, blocks: Float[Array, "blocks 9 9"]) -> BandFactor:
    """Factors S; not finite where it is not positive definite."""
    rows = band_rows(band, blocks)
    _, size, columns = rows.shape
    held, rest = columns // size, columns - size  # tiles in the window, rows below its first tile
    window = jnp.zeros((columns, columns), rows.dtype)
    for k in range(held):  # row k of the window ends on the diagonal
        window = window.at[k * size : (k + 1) * size, : (k + 1) * size].set(rows[k, :, columns - (k + 1) * size :])
    entering = jnp.concatenate([rows[held:], jnp.zeros((held, size, columns), rows.dtype)])
    unit = jnp.eye(size, dtype=rows.dtype)

    def eliminate(window: Array, new: Array) -> tuple[Array, tuple[Array, Array]]:
        factor = jnp.linalg.cholesky(window[:size, :size], symmetrize_input=False)
        inverse = solve_triangular(factor, unit, lower=True)
        below = jnp.matmul(window[size:, :size], inverse.T, precision="highest")
        update = jnp.matmul(below, below.T, precision="highest")
        shifted = jnp.concatenate([window[size:, size:] - update, jnp.zeros((rest, size), rows.dtype)], axis=1)
        return jnp.concatenate([shifted, new]), (inverse, below)

    _, (inverses, below) = lax.scan(eliminate, window, entering)
    return BandFactor(band, inverses, below)


def band_factor_and_solve(
    band: Band, blocks: Float[Array, "blocks 9 9"], right: Float[Array, "cameras 9"]
) -> Float[Array, "cameras 9"]:
    """Solves `S x = b`; not finite where S is not positive definite."""
    return band_factor(band, blocks).solve(right)
