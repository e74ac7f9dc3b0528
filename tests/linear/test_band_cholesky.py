"""Factorisation of banded systems against NumPy's dense solver."""

from __future__ import annotations

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxba.linear.band_cholesky import band_factor, band_rows
from jaxba.structure.camera_ordering import TILE_CAMERAS, Band, band_of

solve = jax.jit(lambda band, blocks, right: band_factor(band, blocks).solve(right))

SHAPES = [
    # cameras, width, tile
    pytest.param(1, 0, TILE_CAMERAS, id="one-camera"),
    pytest.param(7, 0, 3, id="diagonal"),
    pytest.param(5, 4, 11, id="one-tile"),
    pytest.param(12, 2, 3, id="whole-tiles"),
    pytest.param(11, 4, 3, id="wider-than-a-tile"),
    pytest.param(10, 9, 3, id="full"),
    pytest.param(25, 13, 2, id="many-tiles-wide"),
    pytest.param(70, 17, TILE_CAMERAS, id="as-in-a-layout"),
]


def system(cameras: int, width: int, tile: int) -> tuple[Band, np.ndarray, np.ndarray, np.ndarray]:
    """Band, its blocks, the same matrix dense in the cameras' own order, and a right-hand side.

    Positive definite: one plus a square for every two cameras that are linked. Half of those within
    the band are not."""
    rng = np.random.default_rng(100 * cameras + width)
    rank = rng.permutation(cameras)
    row, column = np.tril_indices(cameras)
    kept = (
        (row == column)
        | (row - column == width)
        | ((row - column < width) & (rng.random(len(row)) < 0.5))
    )
    row = row[kept]
    column = column[kept]
    full = np.eye(9 * cameras).reshape(cameras, 9, cameras, 9)
    for a, b in zip(row, column, strict=True):
        two = rng.normal(size=(2, 9, 9)) / 3
        for (i, one), (j, other) in itertools.product(zip((a, b), two, strict=True), repeat=2):
            full[i, :, j] += one.T @ other
    blocks = np.stack(
        [*(full[a, :, b] for a, b in zip(row, column, strict=True)), np.zeros((9, 9))]
    )
    own = full[rank][:, :, rank].reshape(9 * cameras, 9 * cameras)  # camera c stands at rank[c]
    return (
        band_of(row * cameras + column, rank, width, tile),
        blocks,
        own,
        rng.normal(size=(cameras, 9)),
    )


def on_diagonal(band: Band, camera: int) -> int:
    """Number of a camera's block; the last tile of a row is on the diagonal."""
    _, tile, columns = band.blocks.shape
    row, within = divmod(int(band.rank[camera]), tile)
    return int(band.blocks[row, within, columns - tile + within])


@pytest.mark.parametrize(("cameras", "width", "tile"), SHAPES)
def test_a_banded_system_is_solved_as_numpy_solves_it(cameras, width, tile):
    band, blocks, matrix, right = system(cameras, width, tile)
    expected = np.linalg.solve(matrix, right.ravel()).reshape(right.shape)
    found = solve(band, blocks, right)
    assert np.linalg.norm(found - expected) <= 1e-11 * np.linalg.norm(expected)


@pytest.mark.parametrize(("cameras", "width", "tile"), [(12, 2, 3), (25, 13, 2)])
def test_float32_is_solved_to_single_precision(cameras, width, tile):
    band, blocks, matrix, right = system(cameras, width, tile)
    expected = np.linalg.solve(matrix, right.ravel()).reshape(right.shape)
    found = solve(band, jnp.asarray(blocks, jnp.float32), jnp.asarray(right, jnp.float32))
    assert found.dtype == jnp.float32
    condition = np.linalg.cond(matrix)
    assert np.linalg.norm(found - expected) <= condition * np.finfo(
        np.float32
    ).eps * np.linalg.norm(expected)


@pytest.mark.parametrize(("cameras", "width", "tile"), SHAPES)
def test_a_system_that_is_not_positive_definite_has_no_finite_solution(cameras, width, tile):
    """A diagonal entry is lowered until the determinant has just changed its sign: `det(S - t e
    e^T) = det S (1 - t e.S^-1 e)`. It is that of the first camera in the band, of the last, or of
    any other."""
    band, blocks, matrix, right = system(cameras, width, tile)
    order = np.argsort(band.rank)
    for camera in {int(order[0]), int(order[-1]), cameras // 2}:
        unit = np.eye(9 * cameras)[9 * camera + 4]
        much = 1 / (unit @ np.linalg.solve(matrix, unit))
        lowered = blocks.copy()
        lowered[on_diagonal(band, camera), 4, 4] -= 0.999 * much
        assert np.isfinite(solve(band, lowered, right)).all()
        lowered[on_diagonal(band, camera), 4, 4] -= 0.002 * much
        assert not np.isfinite(solve(band, lowered, right)).all()


@pytest.mark.parametrize("camera", [0, 5, 11])
def test_a_nan_in_one_block_reaches_that_camera(camera):
    band, blocks, _, right = system(12, 2, 3)
    blocks[on_diagonal(band, camera)] = np.nan
    assert not np.isfinite(solve(band, blocks, right)[camera]).any()


def test_the_factor_multiplies_back_to_the_matrix():
    """Column by column of tiles: the inverted diagonal tile, and what stands below it."""
    band, blocks, matrix, _ = system(10, 4, 3)
    factor = jax.jit(band_factor)(band, blocks)
    count, rest, size = factor.below.shape
    lower = np.zeros((count * size + rest, count * size))
    for k in range(count):
        at = slice(k * size, (k + 1) * size)
        lower[at, at] = np.linalg.inv(factor.inverses[k])
        lower[(k + 1) * size : (k + 1) * size + rest, at] = factor.below[k]
    assert not lower[count * size :].any()  # nothing below the last tile
    lower = lower[: count * size]
    place = (9 * np.asarray(band.rank)[:, None] + np.arange(9)).ravel()
    np.testing.assert_allclose(
        (lower @ lower.T)[np.ix_(place, place)], matrix, rtol=1e-11, atol=1e-11
    )
    padding = slice(90, None)
    assert np.array_equal(lower[padding, padding], np.eye(18))
    assert not lower[padding, :90].any()


def test_rows_of_tiles_hold_the_lower_triangle_and_a_unit_diagonal_in_the_padding():
    band, blocks, matrix, _ = system(10, 4, 3)
    rows = np.asarray(band_rows(band, jnp.asarray(blocks)))
    count, size, columns = rows.shape
    lower = np.zeros((count * size, count * size + columns))
    for k in range(count):  # columns before the first are padding too
        lower[k * size : (k + 1) * size, (k + 1) * size : (k + 1) * size + columns] = rows[k]
    assert not lower[:, :columns].any()
    lower = lower[:, columns:]
    place = (9 * np.asarray(band.rank)[:, None] + np.arange(9)).ravel()
    expected = np.eye(count * size)
    expected[np.ix_(place, place)] = matrix
    block = np.arange(count * size) // 9
    assert np.array_equal(lower, np.where(block[:, None] >= block, expected, 0))
