"""The choice of the linear solver: what it counts, and what it makes of a sequence."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import support
from hypothesis import given, settings
from hypothesis import strategies as st
from random_problems import draw
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import reverse_cuthill_mckee
from support import random_views

from jaxba import BundleProblem, ProblemError, build_layout
from jaxba.problem.frames import in_frames
from jaxba.problem.options import StepOptions
from jaxba.scenes import SceneConfig, random_scene
from jaxba.solver.choose import choose_linear_solver, count_pairs, predict
from jaxba.structure.observation_order import ObservationOrder
from jaxba.structure.residual_slots import laid_out

SEQUENCE = SceneConfig(
    cameras=300,
    points=6000,
    observations=24000,
    max_depth=10.0,
    gap_share=0.0,
    trajectory="lateral",
)
"""A point is seen by up to 18 cameras in a row."""


def renumbered(problem: BundleProblem, seed: int) -> BundleProblem:
    """The same problem with its cameras in random order."""
    order = np.random.default_rng(seed).permutation(problem.num_cameras)
    cameras = np.empty_like(problem.cameras)
    cameras[order] = problem.cameras
    return problem.replace(
        cameras=cameras, camera_index=order[problem.camera_index].astype(np.int32)
    )


# Counts


@settings(max_examples=50, deadline=None)
@given(st.integers(1, 25), st.integers(1, 15), st.integers(0, 10**6), st.integers(0, 4))
def test_pairs_blocks_and_reach_are_those_of_brute_force(cameras, points, seed, duplicates):
    problem = random_views(cameras, points, seed, duplicates)
    pairs = 0
    shared = np.zeros((cameras, cameras), bool)
    for point in range(points):
        track = problem.camera_index[problem.point_index == point]
        for i, a in enumerate(track):
            for b in track[: i + 1]:
                pairs += 1
                shared[a, b] = shared[b, a] = True
    row, column = np.nonzero(shared)
    rank = np.argsort(reverse_cuthill_mckee(csr_matrix(shared), symmetric_mode=True))
    reach = min(
        np.abs(row - column).max(initial=0), np.abs(rank[row] - rank[column]).max(initial=0)
    )
    assert count_pairs(ObservationOrder.of(problem)) == (pairs, np.tril(shared).sum(), reach)


def test_the_counted_reach_is_that_of_the_layout():
    """Within a tile of 11 cameras, the size in which a band is stored."""
    problem = renumbered(random_scene(SEQUENCE, 0), 1)
    pairs = build_layout(problem).pairs
    assert pairs is not None
    assert pairs.band is not None
    _, tile, columns = pairs.band.blocks.shape
    assert columns == tile * (1 + -(-count_pairs(ObservationOrder.of(problem)).bandwidth // tile))


@pytest.mark.parametrize("limit", ["MAX_COUNTED_PAIRS", "MAX_COUNTED_CAMERAS"])
def test_what_is_not_counted_is_bounded_from_above(monkeypatch, limit):
    problem = random_scene(SEQUENCE, 0)
    exact = count_pairs(ObservationOrder.of(problem))
    monkeypatch.setattr("jaxba.solver.choose." + limit, 10)
    bound = count_pairs(ObservationOrder.of(problem))
    assert bound.pairs == exact.pairs
    assert exact.blocks < bound.blocks <= 300 * 301 // 2
    assert exact.bandwidth < bound.bandwidth == 300


# The choice


def test_a_banded_sequence_of_hundreds_of_cameras_is_factored():
    problem = random_scene(SEQUENCE, 0)
    assert choose_linear_solver(problem, StepOptions(), "auto").linear_solver == "explicit"
    costs = predict(problem)
    assert 0 < costs["explicit"] < min(costs["sparse"], costs["implicit"])


def test_the_band_of_a_sequence_is_found_in_any_numbering():
    """Not quite the narrowest: finding that is a hard problem."""
    problem = random_scene(SEQUENCE, 0)
    for seed in range(3):
        assert predict(renumbered(problem, seed))["explicit"] < 2 * predict(problem)["explicit"]


def test_a_system_of_hundreds_of_cameras_without_a_band_is_not_factored():
    """As many cameras and observations, but every point is seen from anywhere."""
    problem = random_scene(SEQUENCE, 0)
    rng = np.random.default_rng(0)
    anywhere = problem.replace(
        camera_index=rng.integers(300, size=problem.num_observations).astype(np.int32)
    )
    assert count_pairs(ObservationOrder.of(anywhere)).bandwidth > 200
    assert predict(anywhere)["explicit"] > 5 * predict(problem)["explicit"]
    assert choose_linear_solver(anywhere, StepOptions(), "auto").linear_solver != "explicit"


def test_a_few_cameras_are_factored():
    for problem in (
        support.tiny(),
        support.single(),
        random_scene(replace(SEQUENCE, cameras=50), 0),
    ):
        assert choose_linear_solver(problem, StepOptions(), "auto").linear_solver == "explicit"


def test_a_few_cameras_in_rigs_with_priors_are_factored_though_a_product_is_quicker():
    problem = laid_out(in_frames(draw(34)[0]))
    assert problem.num_cameras == 18
    assert min(predict(problem), key=predict(problem).__getitem__) != "explicit"
    assert choose_linear_solver(problem, StepOptions(), "auto").linear_solver == "explicit"


def test_many_cameras_that_see_few_points_are_factored_by_way_of_the_points():
    """As with the corners of a calibration board; without that way 2700 unknowns would be
    factored."""
    board = random_views(300, 20, 0)
    assert predict(board)["explicit"] < min(predict(board)["sparse"], predict(board)["implicit"])
    assert choose_linear_solver(board, StepOptions(), "auto").linear_solver == "explicit"
    assert build_layout(board).grid is not None
    twice = random_views(300, 20, 0, duplicates=1)
    assert build_layout(twice).grid is None
    assert predict(twice)["explicit"] > 100 * predict(board)["explicit"]


def test_a_factorisation_beyond_the_machine_is_refused_where_there_is_no_choice(monkeypatch):
    problem = random_scene(replace(SEQUENCE, cameras=50), 0)
    options = StepOptions()
    assert choose_linear_solver(problem, options, "explicit").linear_solver == "explicit"
    monkeypatch.setattr("jaxba.runtime.process.memory", lambda: 1e6)
    with pytest.raises(
        ProblemError,
        match=r"^50 cameras take some 0 GB to solve by a factorisation, more than the 0 GB",
    ):
        choose_linear_solver(problem, options, "explicit")
    assert choose_linear_solver(problem, StepOptions(), "implicit").linear_solver == "implicit"


def test_a_solver_without_the_memory_for_it_is_not_chosen(monkeypatch):
    problem = random_scene(SEQUENCE, 0)
    monkeypatch.setattr("jaxba.solver.choose.MAX_BYTES", 1e6)
    costs = predict(problem)
    assert costs["explicit"] == costs["sparse"] == np.inf
    assert choose_linear_solver(problem, StepOptions(), "auto").linear_solver == "implicit"
