"""Slots, sum trees and pairs: nothing lost, nothing twice, little padding."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from math import prod

import chex
import numpy as np
import pytest
import support
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxba import BundleProblem, Layout, build_layout, hold
from jaxba.structure import covisibility
from jaxba.structure.layout import CAMERA_CHUNK, NO_SYSTEM
from jaxba.structure.sum_trees import TREE_WIDTH, fitting_width, sum_tree, with_spare_row
from jaxba.structure.track_buckets import MAX_PADDING, TILE, TILED_POINTS

# Problems from track lengths


def problem_of(tracks: np.ndarray, cameras: int, seed: int, duplicates: int = 0) -> BundleProblem:
    """Every point seen by `tracks[i]` different cameras, observations in random order; some are
    there twice."""
    rng = np.random.default_rng(seed)
    point = np.repeat(np.arange(len(tracks)), tracks)
    camera = np.concatenate(
        [rng.choice(cameras, t, replace=False) for t in tracks] or [np.zeros(0)]
    ).astype(int)
    again = rng.integers(len(point), size=duplicates)
    point = np.concatenate([point, point[again]])
    camera = np.concatenate([camera, camera[again]])
    order = rng.permutation(len(point))
    return BundleProblem.create(
        rng.normal(size=(cameras, 9)),
        rng.normal(size=(len(tracks), 3)),
        rng.normal(size=(len(point), 2)),
        camera[order],
        point[order],
        weight=rng.uniform(0.5, 2, len(point)),
    )


def track_lengths(draw) -> tuple[np.ndarray, int]:
    """Random lengths of one of several kinds, and a number of cameras that allows them."""
    rng = np.random.default_rng(draw(st.integers(0, 10**6)))
    points = draw(st.integers(1, 400))
    longest = draw(st.sampled_from([1, 2, 5, 30, 200, 600]))
    kind = draw(
        st.sampled_from(["equal", "uniform", "geometric", "power law", "few giants", "many zeros"])
    )
    lengths = {
        "equal": np.full(points, longest),
        "uniform": rng.integers(0, longest + 1, points),
        "geometric": 1 + rng.geometric(min(1.0, 3 / longest), points),
        "power law": (rng.pareto(1.0, points) + 1).astype(int),
        "few giants": np.where(rng.random(points) < 0.02, longest, rng.integers(2, 4, points)),
        "many zeros": np.where(rng.random(points) < 0.8, 0, rng.integers(1, longest + 1, points)),
    }[kind]
    lengths = np.clip(lengths, 0, longest)
    lengths[0] = max(lengths[0], 1)
    return lengths, longest + draw(st.integers(0, 5))


tracks_and_cameras = st.composite(track_lengths)()


def points_of(layout: Layout) -> np.ndarray:
    """Problem index of every column of the layout; the number of points for padding."""
    return np.asarray(layout.points)


def rows_of(layout: Layout) -> Counter:
    """(camera, point, pixel, whitening) of every occupied slot."""
    mask = np.asarray(layout.slot_mask)
    point = points_of(layout)[layout.slot_point[mask]]
    columns = [layout.slot_camera[mask], point, *layout.pixels[:, mask]]
    if layout.whitening is not None:
        columns += list(layout.whitening.reshape(4, -1)[:, mask])
    return Counter(zip(*(np.asarray(c).tolist() for c in columns), strict=True))


def rows_of_problem(problem: BundleProblem) -> Counter:
    columns = [problem.camera_index, problem.point_index, *problem.observations.T]
    if problem.whitening is not None:
        columns += list(problem.whitening.reshape(-1, 4).T)
    return Counter(zip(*(np.asarray(c).tolist() for c in columns), strict=True))


# Slots


@settings(max_examples=75, deadline=None)
@given(tracks_and_cameras, st.integers(0, 3))
def test_every_observation_is_in_exactly_one_slot(case, duplicates):
    problem = problem_of(*case, seed=0, duplicates=duplicates)
    layout = build_layout(problem, NO_SYSTEM)
    assert rows_of(layout) == rows_of_problem(problem)
    empty = ~np.asarray(layout.slot_mask)
    assert empty.any()
    assert not np.any(layout.pixels[:, empty])
    assert not np.any(layout.whitening[:, :, empty])
    columns = points_of(layout)
    seen = np.unique(problem.point_index)
    assert np.array_equal(np.sort(columns[columns < problem.num_points]), seen)
    assert np.array_equal(
        layout.camera_seen, np.bincount(problem.camera_index, minlength=problem.num_cameras) > 0
    )
    assert layout.num_slots == sum(prod(bucket) for bucket in layout.buckets)
    assert layout.num_points == len(columns)


@settings(max_examples=150, deadline=None)
@given(tracks_and_cameras)
def test_at_most_a_tenth_is_padding_whatever_the_track_lengths(case):
    problem = problem_of(*case, seed=0)
    layout = build_layout(problem, NO_SYSTEM)
    spare = layout.buckets[0][1]  # the one point of padding that is always there
    assert layout.num_slots - spare <= (1 + MAX_PADDING) * problem.num_observations


def test_tiles_stay_within_that_tenth():
    """Many lengths, each with hardly more points than make a bucket one of tiles."""
    problem = problem_of(np.repeat(np.arange(2, 30), TILED_POINTS + 1), 40, seed=0)
    layout = build_layout(problem, NO_SYSTEM)
    assert any(tile == TILE for _, _, tile in layout.buckets)
    assert layout.num_slots - layout.buckets[0][1] <= (1 + MAX_PADDING) * problem.num_observations


@pytest.mark.parametrize("longest", [300, 900])
def test_long_tails_need_few_buckets(longest):
    """Every bucket costs compilation: a smooth distribution of lengths up to hundreds needs a dozen
    or two."""
    lengths = np.clip((np.random.default_rng(0).pareto(1.2, 4000) * 2 + 2).astype(int), 2, longest)
    layout = build_layout(problem_of(lengths, longest, seed=1), NO_SYSTEM)
    assert len(layout.buckets) <= 25
    assert layout.num_slots <= (1 + MAX_PADDING) * lengths.sum() + layout.buckets[0][1]


def test_the_order_of_the_observations_does_not_matter():
    problem = support.tiny()
    order = np.random.default_rng(0).permutation(problem.num_observations)
    shuffled = BundleProblem.create(
        problem.cameras,
        problem.points,
        problem.observations[order],
        problem.camera_index[order],
        problem.point_index[order],
    )
    one = build_layout(problem)
    other = build_layout(shuffled)
    assert one.buckets == other.buckets
    # slots name their observations by other numbers, of the same views
    np.testing.assert_array_equal(np.append(order, len(order))[other.observation], one.observation)
    chex.assert_trees_all_equal(one, replace(other, observation=one.observation), strict=True)


def test_one_observation_is_enough():
    problem = support.single()
    layout = build_layout(problem, grid=False)
    assert rows_of(layout) == rows_of_problem(problem)
    assert blocks_by_layout(layout, np.arange(layout.num_slots) + 1.0).shape == (1, 1)


@pytest.mark.parametrize("length", [2, 5])
def test_a_large_bucket_is_cut_into_tiles(length):
    """With slots of a tile side by side, a point of padding or more at its end, and every sum as it
    was."""
    problem = problem_of(np.full(3 * TILED_POINTS, length), 9, seed=1)
    layout = build_layout(problem, NO_SYSTEM)
    assert layout.buckets == ((3 * TILED_POINTS // TILE + 1, length, TILE),)
    assert rows_of(layout) == rows_of_problem(problem)
    of_tile = np.asarray(layout.slot_point).reshape(-1, length, TILE)
    assert np.array_equal(of_tile[:, 0].ravel(), np.arange(layout.num_points))
    assert (of_tile == of_tile[:, :1]).all()
    support.check_sums(layout, np.random.default_rng(0))


# Sums


def sum_by_levels(rows: np.ndarray, levels) -> np.ndarray:
    for level in levels:
        rows = rows[np.asarray(level)].sum(axis=1)
    return rows


def sum_by_ranks(rows: np.ndarray, levels) -> np.ndarray:
    total = np.zeros(levels[0].shape[1], rows.dtype)
    for level in levels:
        total[: level.shape[1]] += rows[np.asarray(level)].sum(axis=0)
    return total


sizes = st.one_of(st.just(0), st.integers(0, 12), st.integers(60, 70), st.integers(0, 1500))


@settings(max_examples=200, deadline=None)
@given(
    st.lists(sizes, min_size=1, max_size=12),
    st.sampled_from([1, 2, 3, 8, 64]),
    st.integers(0, 10**6),
)
def test_a_sum_tree_sums_every_target_once(counts, width, seed):
    counts = np.array(counts)
    rng = np.random.default_rng(seed)
    items = rng.permutation(counts.sum() + 3)[: counts.sum()]
    empty = int(counts.sum()) + 3
    rows = np.append(rng.integers(-1000, 1000, counts.sum() + 3), 0)
    expected = np.zeros(len(counts), int)
    np.add.at(expected, np.repeat(np.arange(len(counts)), counts), rows[items])
    levels = sum_tree(items, counts, empty, width)
    assert np.array_equal(sum_by_levels(rows, levels), expected)
    assert levels[0].shape[1] <= width
    assert all(level.shape[1] <= max(TREE_WIDTH, 1) for level in levels[1:])
    assert all(level.dtype == np.int32 for level in levels)


def test_the_first_level_is_as_wide_as_reads_least():
    assert fitting_width(np.full(50, 2)) == 2
    assert fitting_width(np.full(50, 3)) == 3
    assert fitting_width(np.full(50, 800)) == TREE_WIDTH


def test_a_tree_of_one_level_gets_a_row_of_padding():
    counts = np.array([2, 0, 3])
    rows = np.append(np.arange(1, 6), 0)
    levels = with_spare_row(sum_tree(np.arange(5), counts, 5, 3), 5)
    assert (levels[0] == 5).all(axis=1).sum() == 2  # the target without items, and the new one
    assert np.array_equal(sum_by_levels(rows, levels), [3, 0, 12])
    assert with_spare_row(levels, 5) is levels


@pytest.mark.parametrize("make", [support.tiny, support.odd], ids=["tiny", "odd"])
def test_point_and_camera_sums_equal_add_at(make):
    support.check_sums(build_layout(make()), np.random.default_rng(0))


def test_points_of_long_and_short_tracks_in_tiles_and_out_of_them_are_summed():
    long = 32
    lengths = np.repeat([3, long, 2 * long], [TILED_POINTS + 5, 300, 200])
    layout = build_layout(problem_of(lengths, 70, seed=2), NO_SYSTEM)
    shapes = [(tile == TILE, length > long) for _, length, tile in layout.buckets]
    assert (True, False) in shapes
    assert (False, True) in shapes
    assert (False, False) in shapes
    support.check_sums(layout, np.random.default_rng(0))


def test_a_camera_with_thousands_of_observations_is_summed_in_chunks():
    layout = build_layout(problem_of(np.full(5000, 2), 3, seed=2), NO_SYSTEM)
    assert layout.camera_levels[0].shape[1] == CAMERA_CHUNK
    values = np.where(layout.slot_mask, 1, 0)
    assert sum_by_levels(values, layout.camera_levels).sum() == 10000


# Pairs


def blocks_by_layout(layout: Layout, weights: np.ndarray) -> np.ndarray:
    """Sum over the listed pairs of the product of their slots' weights, per block of the lower
    triangle."""
    covisibility = layout.pairs
    weights = support.by_camera(layout, np.where(layout.slot_mask, weights, 0))
    chunks = (weights[covisibility.left] * weights[covisibility.right]).sum(axis=-1)
    partial = support.batch_sums(covisibility, chunks)
    summed = sum_by_levels if covisibility.used is None else sum_by_ranks
    return summed(partial, covisibility.levels)[np.asarray(covisibility.table)]


def blocks_by_brute_force(
    problem: BundleProblem, layout: Layout, weights: np.ndarray
) -> np.ndarray:
    """Products of all ordered pairs of observations of one point, kept where row camera >= column
    camera."""
    found = np.zeros((problem.num_cameras, problem.num_cameras))
    slots = np.flatnonzero(layout.slot_mask)
    camera = layout.slot_camera[slots]
    point = layout.slot_point[slots]
    for a in range(len(slots)):
        for b in np.flatnonzero(point == point[a]):
            if camera[a] >= camera[b]:
                found[camera[a], camera[b]] += weights[slots[a]] * weights[slots[b]]
    return found


@settings(max_examples=120, deadline=None)
@given(
    st.integers(0, 10**6),
    st.integers(1, 12),
    st.integers(1, 25),
    st.integers(0, 6),
    st.sampled_from([2, 7, 2048]),
)
def test_the_pairs_are_all_products_of_co_visible_cameras(seed, cameras, points, duplicates, batch):
    """Random whole numbers as weights: a pair that is missing, doubled or in the wrong block
    changes a sum."""
    rng = np.random.default_rng(seed)
    tracks = np.append(1, rng.integers(0, cameras + 1, points))
    problem = problem_of(tracks, cameras, seed, duplicates)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(covisibility, "PAIR_BATCH", batch)
        layout = build_layout(problem, grid=False)
    weights = rng.integers(1, 1 << 20, layout.num_slots).astype(np.float64)
    assert np.array_equal(
        blocks_by_layout(layout, weights), blocks_by_brute_force(problem, layout, weights)
    )


def test_pairs_of_constant_cameras_are_not_listed():
    """What nothing of a camera can change has no block in the reduced camera system."""
    problem = support.tiny()
    constant = np.array([1, 3])
    held = hold(problem, poses=constant, lenses=constant)
    layout = build_layout(held, grid=False)
    slots = np.flatnonzero(layout.slot_mask)
    camera = layout.slot_camera[slots]
    point = layout.slot_point[slots]
    moves = ~np.isin(camera, constant)
    tracks = np.bincount(point[moves])
    camera_of_sorted = support.by_camera(layout, np.asarray(layout.slot_camera))
    is_observation = support.by_camera(layout, np.asarray(layout.slot_mask))
    listed = is_observation[layout.pairs.left] & is_observation[layout.pairs.right]
    assert listed.sum() == np.sum(tracks * (tracks + 1) // 2)
    for side in (layout.pairs.left, layout.pairs.right):
        assert not np.isin(camera_of_sorted[side][listed], constant).any()


def test_the_number_of_pairs_is_that_of_the_track_lengths():
    problem = support.tiny()
    layout = build_layout(problem, grid=False)
    tracks = np.bincount(problem.point_index)
    seen = support.by_camera(layout, np.asarray(layout.slot_mask))
    listed = seen[layout.pairs.left] & seen[layout.pairs.right]
    assert listed.sum() == (tracks * (tracks + 1) // 2).sum()


def test_diagonal_blocks_know_their_camera_and_the_others_know_they_have_none():
    problem = support.odd()
    covisibility = build_layout(problem, grid=False).pairs
    cameras = problem.num_cameras
    assert np.array_equal(
        np.asarray(covisibility.block_camera)[np.diagonal(covisibility.table)], np.arange(cameras)
    )
    row, column = np.tril_indices(cameras, -1)
    assert (
        np.asarray(covisibility.block_camera)[np.asarray(covisibility.table)[row, column]]
        == cameras
    ).all()


def test_pairs_are_listed_only_on_demand():
    assert build_layout(support.tiny(), NO_SYSTEM).pairs is None


def test_a_grid_names_the_slot_of_every_view_and_an_empty_one_elsewhere():
    problem = support.tiny()
    layout = build_layout(problem)
    assert layout.grid is not None
    assert layout.pairs is None
    column = np.asarray(layout.points)
    seen = {
        (int(p), int(c)) for p, c in zip(problem.point_index, problem.camera_index, strict=True)
    }
    for row, views in enumerate(np.asarray(layout.grid)):
        for camera, slot in enumerate(views):
            assert bool(layout.slot_mask[slot]) == ((int(column[row]), camera) in seen)
            if layout.slot_mask[slot]:
                assert (layout.slot_point[slot], layout.slot_camera[slot]) == (row, camera)


def test_a_camera_that_sees_a_point_twice_has_no_grid():
    problem = problem_of(np.full(30, 4), 4, seed=0, duplicates=3)
    assert build_layout(problem).grid is None
    assert build_layout(problem_of(np.full(30, 4), 4, seed=0)).grid is not None
