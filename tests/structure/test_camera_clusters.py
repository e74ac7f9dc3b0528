"""Clusters of cameras: those that see the same points come together, and the coarse sums lose
nothing."""

from __future__ import annotations

import numpy as np
import pytest
import support
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import csr_matrix
from support import random_views

from jaxba import ConjugateGradients, Layout, StepOptions, build_layout, make_method
from jaxba.structure import agglomeration, camera_clusters
from jaxba.structure.agglomeration import agglomerate, shared_points
from jaxba.structure.camera_clusters import CLUSTER_CAMERAS, ClusterLayout

# cameras, points, seed
sizes = st.tuples(st.integers(1, 30), st.integers(1, 25), st.integers(0, 10**6))


def clusters_of(layout: Layout) -> ClusterLayout:
    assert layout.clusters is not None
    return layout.clusters


def weights(nodes: int, edges: dict[tuple[int, int], float]) -> csr_matrix:
    """A symmetric matrix from its entries above the diagonal."""
    dense = np.zeros((nodes, nodes))
    for (a, b), weight in edges.items():
        dense[a, b] = dense[b, a] = weight
    return csr_matrix(dense)


def groups(label) -> set[frozenset[int]]:
    """The groups, whatever their numbers."""
    return {frozenset(np.flatnonzero(label == number).tolist()) for number in np.unique(label)}


# What cameras share


@settings(max_examples=50, deadline=None)
@given(sizes)
def test_shared_points_are_those_that_two_cameras_both_see(size):
    problem = random_views(*size)
    cameras = problem.num_cameras
    points = problem.num_points
    found, seen = shared_points(
        np.asarray(problem.camera_index), np.asarray(problem.point_index), cameras, points
    )
    sees = [set(problem.point_index[problem.camera_index == c].tolist()) for c in range(cameras)]
    expected = [
        [0 if a == b else len(sees[a] & sees[b]) for b in range(cameras)] for a in range(cameras)
    ]
    assert np.array_equal(found.toarray(), expected)
    assert np.array_equal(seen, [len(points) for points in sees])
    assert np.count_nonzero(found.data) == found.nnz


def test_with_too_many_pairs_a_sample_of_the_points_is_counted(monkeypatch):
    """Every fourth point instead of all: a quarter of what each two share, since here all see
    all."""
    camera = np.tile(np.arange(5), 400)
    point = np.repeat(np.arange(400), 5)
    monkeypatch.setattr(agglomeration, "MAX_PRODUCTS", 400 * 25 / 4)
    found, _ = shared_points(camera, point, 5, 400)
    assert np.array_equal(found.toarray(), 100 * (1 - np.eye(5)))


# Groups


@settings(max_examples=100, deadline=None)
@given(
    st.integers(1, 40),
    st.sampled_from([0.0, 0.03, 0.2, 1.0]),
    st.integers(1, 45),
    st.integers(0, 10**6),
)
def test_labels_count_from_zero_and_there_are_no_more_than_asked_for(nodes, share, wanted, seed):
    rng = np.random.default_rng(seed)
    linked = np.triu(rng.random((nodes, nodes)) < share, 1) * rng.integers(1, 4, (nodes, nodes))
    label = agglomerate(csr_matrix(linked + linked.T, dtype=np.float32), nodes, wanted)
    assert label.shape == (nodes,)
    assert np.array_equal(np.unique(label), np.arange(label.max() + 1))
    assert label.max() + 1 == min(nodes, wanted)


@pytest.mark.parametrize("seed", range(5))
def test_two_far_groups_come_apart_however_the_cameras_are_numbered(seed):
    """All of a group share ten points with each other; one camera of each group sees one point of
    the other's."""
    rng = np.random.default_rng(seed)
    order = rng.permutation(20)
    one = order[:12]
    other = order[12:]
    edges = {(a, b): 10.0 for group in (one, other) for a in group for b in group if a < b}
    edges[one[0], other[0]] = 1.0
    assert groups(agglomerate(weights(20, edges), 20, 2)) == {
        frozenset(one.tolist()),
        frozenset(other.tolist()),
    }


def test_a_sequence_is_cut_into_runs_of_neighbours():
    """Cameras that are nearer share more: every cluster is a run without holes, of at most twice
    the mean."""
    edges = {(a, b): 1.0 * (6 - (b - a)) for a in range(64) for b in range(a + 1, min(a + 6, 64))}
    label = agglomerate(weights(64, edges), 64, 8)
    runs = groups(label)
    assert len(runs) == 8
    assert all(max(run) - min(run) == len(run) - 1 for run in runs)
    assert all(len(run) <= 16 for run in runs)


def test_what_nothing_connects_is_thrown_together_until_there_are_few_enough():
    assert groups(agglomerate(csr_matrix((7, 7)), 7, 7)) == {frozenset([k]) for k in range(7)}
    label = agglomerate(csr_matrix((7, 7)), 7, 3)
    assert len(groups(label)) == 3
    # two triangles and two loners: what is connected stays together
    triangles = {(a, b): 1.0 for t in (0, 3) for a in range(t, t + 3) for b in range(a + 1, t + 3)}
    label = agglomerate(weights(8, triangles), 8, 2)
    assert label.max() == 1
    assert len(set(label[:3])) == len(set(label[3:6])) == 1


def test_one_camera_is_one_cluster():
    assert np.array_equal(agglomerate(csr_matrix((1, 1)), 1, 1), [0])
    problem = support.single()
    found = clusters_of(build_layout(problem, StepOptions(linear_solver="sparse")))
    assert np.array_equal(found.label, [0])
    assert np.array_equal(found.members, [[0]])


# The layout


def sum_by_levels(rows: np.ndarray, levels) -> np.ndarray:
    for level in levels:
        rows = rows[np.asarray(level)].sum(axis=1)
    return rows


def seen_by_cluster(
    layout: Layout, found: ClusterLayout, values: np.ndarray
) -> dict[tuple[int, int], int]:
    """Sum of the slots of each (column of the point, cluster), one slot after the other."""
    total = {}
    for slot in np.flatnonzero(layout.slot_mask):
        key = int(layout.slot_point[slot]), int(found.label[layout.slot_camera[slot]])
        total[key] = total.get(key, 0) + int(values[slot])
    return total


@pytest.mark.parametrize("cluster_cameras", [1, 3, CLUSTER_CAMERAS])
@settings(max_examples=25, deadline=None)
@given(sizes, st.integers(0, 5))
def test_every_coarse_slot_sums_exactly_one_clusters_views_of_one_point(
    cluster_cameras, size, duplicates
):
    """Random whole numbers as weights: a slot that is missing, doubled or in the wrong place
    changes a sum."""
    problem = random_views(*size, duplicates=duplicates)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(camera_clusters, "CLUSTER_CAMERAS", cluster_cameras)
        layout = build_layout(problem, StepOptions(linear_solver="sparse"))
    found = clusters_of(layout)
    cameras = problem.num_cameras
    count = len(found.members)
    assert count == max(1, cameras // cluster_cameras)

    members = np.asarray(found.members)
    assert np.array_equal(np.sort(members[members < cameras]), np.arange(cameras))
    for number, row in enumerate(members):
        assert np.array_equal(
            np.sort(row[row < cameras]), np.flatnonzero(np.asarray(found.label) == number)
        )

    rng = np.random.default_rng(size[2])
    values = np.where(layout.slot_mask, rng.integers(1, 1 << 20, layout.num_slots), 0)
    expected = seen_by_cluster(layout, found, values)
    sums = sum_by_levels(values, found.levels)
    assert sums[-1] == 0
    assert found.point.shape == sums.shape
    told = sorted(zip(np.asarray(found.point)[:-1].tolist(), sums[:-1].tolist(), strict=True))
    assert told == sorted((column, total) for (column, _), total in expected.items())

    blocks = np.zeros((count, count), np.int64)
    for (column, a), left in expected.items():
        for b in range(a + 1):
            blocks[a, b] += left * expected.get((column, b), 0)
    pairs = found.pairs
    assert pairs.table is not None
    chunks = (sums[pairs.left] * sums[pairs.right]).sum(axis=-1)
    assert np.array_equal(
        sum_by_levels(support.batch_sums(pairs, chunks), pairs.levels)[np.asarray(pairs.table)],
        blocks,
    )
    assert np.array_equal(
        np.asarray(pairs.block_camera)[np.diagonal(pairs.table)], np.arange(count)
    )


def test_there_are_never_more_clusters_than_the_limit(monkeypatch):
    monkeypatch.setattr(camera_clusters, "most_clusters", lambda observations: 2)
    found = clusters_of(build_layout(random_views(30, 25, 0), StepOptions(linear_solver="sparse")))
    assert len(found.members) == 2


def test_clusters_are_made_only_where_the_two_level_preconditioner_is_asked_for():
    problem = support.tiny()

    def made(**changes):
        return build_layout(problem, StepOptions(**changes)).clusters is not None

    assert made(linear_solver="sparse")
    assert made(linear_solver="implicit")
    assert not made(
        linear_solver="implicit", conjugate_gradients=ConjugateGradients("schur-jacobi")
    )
    assert not made(linear_solver="explicit")
    assert not made(method=make_method("deeplm"))
