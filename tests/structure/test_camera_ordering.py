"""Orders of the cameras: a narrow band is found where there is one, and every block has one place
in it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import csgraph, csr_matrix

from jaxba.structure.camera_ordering import (
    MAX_BAND_FRACTION,
    MIN_BAND_CAMERAS,
    Band,
    band_of,
    camera_order,
    is_banded,
    reverse_cuthill_mckee,
)
from jaxba.structure.sum_trees import sorted_by

graphs = st.tuples(
    st.integers(1, 40), st.sampled_from([0.0, 0.05, 0.2, 1.0]), st.integers(0, 10**6)
)


def random_graph(cameras: int, share: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Every camera with itself and a share of all pairs, lower triangle."""
    rng = np.random.default_rng(seed)
    linked = np.tril(rng.random((cameras, cameras)) < share, -1) | np.eye(cameras, dtype=bool)
    row, column = np.nonzero(linked)
    return row, column


def band_graph(cameras: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Every camera with itself and the `width` before it."""
    row, column = np.tril_indices(cameras)
    near = row - column <= width
    return row[near], column[near]


def reach_by_brute_force(rows, columns, rank) -> int:
    return max(
        (abs(int(rank[a]) - int(rank[b])) for a, b in zip(rows, columns, strict=True)), default=0
    )


# The order


@settings(max_examples=100, deadline=None)
@given(graphs, st.booleans())
def test_the_reverse_cuthill_mckee_ordering_is_that_of_scipy(graph, loops):
    """Cameras of equal degree included, in connected graphs and others."""
    cameras = graph[0]
    linked = np.zeros((cameras, cameras), bool)
    linked[random_graph(*graph)] = True
    linked = linked | linked.T if loops else (linked | linked.T) & ~np.eye(cameras, dtype=bool)
    expected = csgraph.reverse_cuthill_mckee(csr_matrix(linked), symmetric_mode=True)
    assert np.array_equal(reverse_cuthill_mckee(linked), expected)


@pytest.mark.parametrize("most", [1, 300, 1 << 16, (1 << 16) + 1, 10**6])
def test_integers_are_sorted_stably(most):
    keys = np.random.default_rng(0).integers(most, size=20_000).astype(np.int32)
    keys[:2] = most - 1
    assert np.array_equal(sorted_by(keys, most), np.argsort(keys, kind="stable"))
    assert sorted_by(keys[:0], most).shape == (0,)


@settings(max_examples=100, deadline=None)
@given(graphs)
def test_ranks_are_a_permutation_with_the_reach_that_is_told_and_no_worse_than_the_given_order(
    graph,
):
    cameras = graph[0]
    rows, columns = random_graph(*graph)
    rank, reach = camera_order(rows, columns, cameras)
    assert np.array_equal(np.sort(rank), np.arange(cameras))
    assert reach == reach_by_brute_force(rows, columns, rank)
    assert reach <= reach_by_brute_force(rows, columns, np.arange(cameras))


@settings(max_examples=50, deadline=None)
@given(graphs)
def test_either_triangle_will_do_and_cameras_that_share_nothing_may_be_left_out(graph):
    cameras = graph[0]
    rows, columns = random_graph(*graph)
    away = rows != columns
    rank, reach = camera_order(rows[away], columns[away], cameras)
    assert np.array_equal(np.sort(rank), np.arange(cameras))
    assert reach == reach_by_brute_force(rows, columns, rank)
    assert camera_order(columns[away], rows[away], cameras)[1] == reach


@pytest.mark.parametrize(("cameras", "width"), [(2, 1), (30, 1), (64, 5), (100, 20), (41, 40)])
@pytest.mark.parametrize("seed", range(3))
def test_a_shuffled_band_is_found_again(cameras, width, seed):
    rows, columns = band_graph(cameras, width)
    shuffle = np.random.default_rng(seed).permutation(cameras)
    rank, reach = camera_order(shuffle[rows], shuffle[columns], cameras)
    assert reach == width == reach_by_brute_force(shuffle[rows], shuffle[columns], rank)


def test_an_order_that_is_best_already_stays():
    rank, reach = camera_order(*band_graph(50, 7), 50)
    assert np.array_equal(rank, np.arange(50))
    assert reach == 7


def test_two_sequences_that_take_turns_are_laid_one_after_the_other():
    """Cameras 0, 2, 4, ... and 1, 3, 5, ... see nothing in common: each is a band of 3, together
    one of 6."""
    row, column = band_graph(40, 3)
    rank, reach = camera_order(
        np.append(2 * row, 2 * row + 1), np.append(2 * column, 2 * column + 1), 80
    )
    assert reach == 3
    assert np.ptp(rank[::2]) == np.ptp(rank[1::2]) == 39


def test_only_large_systems_with_a_narrow_band_are_banded():
    widest = int(np.ceil(MAX_BAND_FRACTION * 300)) - 1
    assert is_banded(300, widest)
    assert not is_banded(300, widest + 1)
    assert is_banded(MIN_BAND_CAMERAS, 0)
    assert not is_banded(MIN_BAND_CAMERAS - 1, 0)


# Places in the band


@settings(max_examples=100, deadline=None)
@given(graphs, st.sampled_from([1, 2, 3, 7, 11, 50]))
def test_every_block_has_exactly_its_place_and_every_camera_too(graph, tile):
    cameras = graph[0]
    rows, columns = random_graph(*graph)
    rank, reach = camera_order(rows, columns, cameras)
    high = np.maximum(rank[rows], rank[columns])
    low = np.minimum(rank[rows], rank[columns])
    names = np.sort(high * cameras + low)
    band = band_of(names, rank, reach, tile)

    tiles = -(-cameras // tile)
    assert band.camera.shape == (tiles, tile)
    flat = np.asarray(band.camera).ravel()
    assert np.array_equal(flat[np.asarray(band.rank)], np.arange(cameras))
    assert np.count_nonzero(flat == cameras) == tiles * tile - cameras
    assert np.array_equal(band.rank, rank)

    count = len(names)
    assert np.array_equal(np.sort(np.asarray(band.blocks)[band.blocks < count]), np.arange(count))
    assert (np.asarray(band.blocks)[band.blocks >= count] == count).all()
    assert places(band, count) == {
        number: divmod(int(name), cameras) for number, name in enumerate(names)
    }


def places(band: Band, count: int) -> dict[int, tuple[int, int]]:
    """Row and column in ranks of every block: the last tile of a row stands on the diagonal."""
    tiles, tile, columns = band.blocks.shape
    found = {}
    for row in range(tiles):
        first = (row + 1) * tile - columns
        for i, k in np.argwhere(np.asarray(band.blocks)[row] < count):
            found[int(band.blocks[row, i, k])] = (int(row * tile + i), int(first + k))
    return found


@pytest.mark.parametrize(("width", "tiles"), [(0, 1), (1, 2), (4, 2), (5, 3), (8, 3), (200, 10)])
def test_a_row_holds_no_more_tiles_than_the_band_is_wide(width, tiles):
    rows, columns = band_graph(40, width)
    band = band_of(np.sort(rows * 40 + columns), np.arange(40), int((rows - columns).max()), tile=4)
    assert band.blocks.shape == (10, 4, 4 * tiles)
