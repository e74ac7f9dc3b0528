"""Cholesky factorisation of a banded reduced camera system, tile by tile.

A window of as many tiles as the band is wide slides down the diagonal. Each step factors its first
tile, solves for the tiles below, subtracts their outer product from the rest of the window, and
moves on by one row of tiles. The compiled program has one loop body, whatever the length of the
sequence.

Source: Golub and Van Loan, "Matrix Computations", section 4.3 (band Cholesky), blocked as LAPACK's
pbtrf."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array, lax
from jax.scipy.linalg import solve_triangular
from jaxtyping import Float

from jaxba.linear.cholesky import lower_cholesky
from jaxba.structure.camera_ordering import Band
from jaxba.structure.segment_sums import take_rows


def band_rows(
    band: Band, blocks: Float[Array, "blocks width width"]
) -> Float[Array, "tiles rows columns"]:
    """The tiles of every row of tiles; the diagonal one is last. Padding gets a unit diagonal."""
    tiles, m, columns = band.blocks.shape
    width = blocks.shape[-1]
    rows = take_rows(blocks.reshape(-1, width**2), band.blocks).reshape(
        tiles, m, columns, width, width
    )
    rows = rows.transpose(0, 1, 3, 2, 4).reshape(tiles, width * m, width * columns)
    padding = jnp.repeat(band.camera == band.rank.shape[0], width, axis=1).astype(rows.dtype)
    unit = padding[:, :, None] * jnp.eye(width * m, dtype=rows.dtype)
    return rows.at[:, :, -width * m :].add(unit)


class BandFactor(NamedTuple):
    """Cholesky factor L of a band matrix, in tiles."""

    band: Band
    inverses: Float[Array, "tiles size size"]  # of the diagonal tiles
    # the rows of L below each diagonal tile, within the band
    below: Float[Array, "tiles rest size"]

    def solve(self, right: Float[Array, "cameras width"]) -> Float[Array, "cameras width"]:
        """Solves `L L^T x = b`."""
        tiles, rest, size = self.below.shape
        zero = jnp.zeros((1, right.shape[1]), right.dtype)
        rights = take_rows(jnp.concatenate([right, zero]), self.band.camera).reshape(tiles, size)

        def forward(before: Array, row: tuple[Array, Array, Array]) -> tuple[Array, Array]:
            right_tile, inverse, below = row
            known = jnp.concatenate([before, jnp.zeros(size, right.dtype)])  # from earlier tiles
            half = jnp.matmul(inverse, right_tile - known[:size], precision="highest")
            return known[size:] + jnp.matmul(below, half, precision="highest"), half

        def backward(after: Array, row: tuple[Array, Array, Array]) -> tuple[Array, Array]:
            half, inverse, below = row
            known = jnp.matmul(below.T, after, precision="highest")
            x = jnp.matmul(inverse.T, half - known, precision="highest")
            return jnp.concatenate([x, after])[:rest], x

        nothing = jnp.zeros(rest, right.dtype)
        _, halves = lax.scan(forward, nothing, (rights, self.inverses, self.below))
        _, x = lax.scan(backward, nothing, (halves, self.inverses, self.below), reverse=True)
        return take_rows(x.reshape(-1, right.shape[1]), self.band.rank)


def band_factor(band: Band, blocks: Float[Array, "blocks width width"]) -> BandFactor:
    """Cholesky factor of S; non-finite if S is not positive definite."""
    rows = band_rows(band, blocks)
    _, size, columns = rows.shape
    # tiles in the window, rows below its first tile
    window_tiles = columns // size
    rest = columns - size
    window = jnp.zeros((columns, columns), rows.dtype)
    for k in range(window_tiles):  # row k of the window ends on the diagonal
        window = window.at[k * size : (k + 1) * size, : (k + 1) * size].set(
            rows[k, :, columns - (k + 1) * size :]
        )
    entering = jnp.concatenate(
        [rows[window_tiles:], jnp.zeros((window_tiles, size, columns), rows.dtype)]
    )
    unit = jnp.eye(size, dtype=rows.dtype)

    def eliminate(window: Array, new: Array) -> tuple[Array, tuple[Array, Array]]:
        factor = lower_cholesky(window[:size, :size])
        inverse = solve_triangular(factor, unit, lower=True)
        below = jnp.matmul(window[size:, :size], inverse.T, precision="highest")
        update = jnp.matmul(below, below.T, precision="highest")
        shifted = jnp.concatenate(
            [window[size:, size:] - update, jnp.zeros((rest, size), rows.dtype)], axis=1
        )
        return jnp.concatenate([shifted, new]), (inverse, below)

    _, (inverses, below) = lax.scan(eliminate, window, entering)
    return BandFactor(band, inverses, below)
