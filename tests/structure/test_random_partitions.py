"""Random clusterings of the camera graph, and the index arrays made of them."""

from __future__ import annotations

import itertools

import jax.numpy as jnp
import numpy as np
import pytest
import support
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components
from support import bal_file, needs_data

from jaxba import BundleProblem, StepOptions, build_layout, read_bal
from jaxba.methods.stba import StochasticClusters
from jaxba.structure.louvain import camera_graph, cluster, clusterings
from jaxba.structure.random_partitions import PARTITIONS
from jaxba.structure.segment_sums import tree_sum


def observed(cameras: int, points: int, seed: int, share: float = 0.3) -> BundleProblem:
    """Random visibilities; only who sees what matters."""
    rng = np.random.default_rng(seed)
    sees = rng.random((cameras, points)) < share
    sees[0, 0] = True
    camera, point = np.nonzero(sees)
    return BundleProblem.create(
        np.ones((cameras, 9)), np.ones((points, 3)), np.zeros((len(camera), 2)), camera, point
    )


def graph_of(problem: BundleProblem) -> csr_matrix:
    camera = np.asarray(problem.camera_index)
    point = np.asarray(problem.point_index)
    return camera_graph(camera, point, problem.num_cameras, problem.num_points)


sizes = st.tuples(st.integers(1, 30), st.integers(1, 40), st.integers(0, 99))


@settings(max_examples=40, deadline=None)
@given(sizes)
def test_weights_are_shared_points_over_points_that_either_sees(size):
    problem = observed(*size)
    sees = [set(problem.point_index[problem.camera_index == c].tolist()) for c in range(size[0])]
    expected = np.zeros((size[0], size[0]))
    for a, b in itertools.permutations(range(size[0]), 2):
        expected[a, b] = len(sees[a] & sees[b]) / max(len(sees[a] | sees[b]), 1)
    np.testing.assert_allclose(graph_of(problem).toarray(), expected, rtol=1e-6)


@settings(max_examples=40, deadline=None)
@given(sizes, st.integers(1, 12), st.integers(0, 5))
def test_clusters_hold_every_camera_once_and_not_too_many(size, largest, seed):
    graph = graph_of(observed(*size))
    for label in itertools.islice(clusterings(graph, largest, np.random.default_rng(seed)), 3):
        assert label.shape == (size[0],)
        counts = np.bincount(label)
        assert counts.min() >= 1
        assert counts.max() <= largest


@settings(max_examples=40, deadline=None)
@given(sizes, st.integers(2, 12))
def test_cameras_in_a_cluster_hang_together_by_shared_points(size, largest):
    graph = graph_of(observed(*size, share=0.1))
    label = next(clusterings(graph, largest, np.random.default_rng(0)))
    alone = np.diff(graph.indptr) == 0
    for name in range(label.max() + 1):
        members = np.flatnonzero(label == name)
        assert alone[members].all() or connected_components(graph[members][:, members])[0] == 1


def test_clusterings_differ_from_turn_to_turn_and_repeat_with_their_seed():
    graph = graph_of(observed(40, 200, 0))

    def draw(seed):
        return np.stack(
            list(itertools.islice(clusterings(graph, 10, np.random.default_rng(seed)), 5))
        )

    def same(a, b):
        return np.array_equal(a[:, None] == a, b[:, None] == b)

    assert np.array_equal(draw(3), draw(3))
    assert not any(same(a, b) for a, b in itertools.combinations(draw(3), 2))
    assert not same(draw(3)[0], draw(4)[0])


def test_the_heaviest_edge_that_was_cut_is_kept_in_the_next_turn():
    graph = graph_of(observed(40, 200, 0))
    label = cluster(graph, 10, None, None)
    for seed in range(10):
        edges = graph.tocoo()
        cut = label[edges.row] != label[edges.col]
        heaviest = np.argmax(np.where(cut, edges.data, -1))
        label = cluster(graph, 10, label, np.random.default_rng(seed))
        assert label[edges.row[heaviest]] == label[edges.col[heaviest]]


def test_better_communities_are_more_likely():
    """Two cliques with one weak bridge: without randomness exactly the cliques, with it nearly
    always."""
    block = np.ones((6, 6)) - np.eye(6)
    weights = np.block([[block, np.zeros((6, 6))], [np.zeros((6, 6)), block]])
    weights[0, 6] = weights[6, 0] = 0.01
    graph = csr_matrix(weights)
    cliques = np.repeat([0, 1], 6)
    assert np.array_equal(cluster(graph, 12, None, None), cliques)
    rng = np.random.default_rng(0)
    whole = sum(len(np.unique(cluster(graph, 6, None, rng)[:6])) == 1 for _ in range(50))
    assert whole > 25


# Index arrays


@settings(max_examples=8, deadline=None)  # each of another shape
@given(st.tuples(st.integers(2, 20), st.integers(1, 40), st.integers(0, 99)), st.integers(1, 8))
def test_copies_are_the_observations_of_a_point_from_one_cluster(size, largest):
    problem = observed(*size)
    layout = build_layout(problem, StepOptions(method=StochasticClusters(largest)))
    partitions = layout.part("partitions")
    values = np.random.default_rng(0).normal(size=layout.num_slots) * layout.slot_mask
    for turn in range(len(partitions.label)):
        part = partitions.at(turn)
        sums = np.asarray(tree_sum(jnp.asarray(values)[:, None], part.levels))[:, 0]
        used = np.flatnonzero(layout.slot_mask)
        pieces = {}
        for slot in used:
            key = int(layout.slot_point[slot]), int(part.label[layout.slot_camera[slot]])
            pieces.setdefault(key, []).append(slot)
        assert len({int(part.slot_replica[slots[0]]) for slots in pieces.values()}) == len(pieces)
        for slots in pieces.values():
            assert len(set(part.slot_replica[slots].tolist())) == 1
            np.testing.assert_allclose(
                sums[part.slot_replica[slots[0]]], values[slots].sum(), atol=1e-12
            )
        listed = part.members[part.members < problem.num_cameras]
        assert sorted(listed.tolist()) == list(range(problem.num_cameras))
        for name, members in enumerate(part.members):
            assert (part.label[members[members < problem.num_cameras]] == name).all()


def test_small_problems_have_one_partition_with_one_cluster():
    partitions = build_layout(support.tiny(), StepOptions(method=StochasticClusters())).partitions
    assert partitions.label.shape == (1, 6)
    many = build_layout(
        support.tiny(), StepOptions(method=StochasticClusters(cluster_cameras=2))
    ).partitions
    assert many.label.shape == (PARTITIONS, 6)


def test_a_layout_without_partitions_says_how_to_get_them():
    with pytest.raises(ValueError, match="no partitions: build it with the options of the step"):
        build_layout(support.tiny()).part("partitions")


@needs_data
def test_no_cluster_of_a_real_problem_is_larger_than_asked():
    problem = read_bal(bal_file("problem-49-7776-pre"))
    partitions = build_layout(
        problem, StepOptions(method=StochasticClusters(cluster_cameras=16))
    ).partitions
    assert partitions.members.shape[2] <= 16
    assert 3 <= partitions.members.shape[1] <= 12
