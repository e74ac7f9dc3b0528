"""Wrong matches are found and left out, also where images start at wrong places, and the rest ends
as without them."""

from __future__ import annotations

import functools

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import jaxba
from jaxba import (
    BundleProblem,
    ProblemError,
    SceneConfig,
    SolveOptions,
    random_scene,
    solve_graduated,
)
from jaxba.problem import geometry

QUICK = SolveOptions(compilation="quick")
IMAGES = [3, 8]


@functools.cache
def scene() -> BundleProblem:
    return random_scene(SceneConfig(cameras=12, points=400, mean_track=6.0, trajectory="orbit"), 1)


def with_wrong(
    problem: BundleProblem, share: float, seed: int = 0
) -> tuple[BundleProblem, np.ndarray]:
    """Random pixels in the place of some, and which."""
    rng = np.random.default_rng(seed)
    pixels = problem.observations
    wrong = rng.random(len(pixels)) < share
    anywhere = rng.uniform(pixels.min(0), pixels.max(0), pixels.shape)
    return problem.replace(observations=np.where(wrong[:, None], anywhere, pixels)), wrong


def with_images(problem: BundleProblem, how: str) -> BundleProblem:
    """Images that face the other way, or are anywhere."""
    cameras = np.array(problem.cameras)
    rng = np.random.default_rng(7)
    turns = geometry.rotation_matrices(cameras[:, :3])
    centers = geometry.camera_centers(cameras)
    for image in IMAGES:
        turn = np.diag([-1.0, 1.0, -1.0]) @ turns[image]
        center = centers[image]
        if how == "anywhere":
            turn = Rotation.random(rng=rng).as_matrix()
            center = rng.normal(centers.mean(0), centers.std(0))
        cameras[image, :6] = *Rotation.from_matrix(turn).as_rotvec(), *(-turn @ center)
    return problem.replace(cameras=cameras)


def check(solution: jaxba.Solution, start: BundleProblem, right: np.ndarray) -> None:
    """Among the right ones that are kept, the cost is that of a solve of them alone from a start
    without errors."""
    assert solution.converged
    assert solution.rejected is not None
    kept = right & ~solution.rejected
    alone = jaxba.solve(start.subset(kept), options=QUICK)
    assert geometry.cost(solution.problem.subset(kept)) == pytest.approx(alone.final_cost, rel=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("how", ["well", "turned", "anywhere"])
def test_the_rest_ends_as_without_wrong_matches(how):
    problem, wrong = with_wrong(scene(), 0.3)
    start = problem if how == "well" else with_images(problem, how)
    solution = solve_graduated(start, options=QUICK)
    assert solution.rejected is not None
    assert np.mean(solution.rejected[wrong]) > 0.99
    lost = solution.set_aside
    assert how == "anywhere" or not len(lost)  # others were posed again
    assert set(lost) < set(IMAGES)
    of_lost = np.isin(problem.camera_index, lost)
    assert solution.rejected[of_lost].all()
    right = ~wrong & ~of_lost
    # else nothing says so
    right &= np.bincount(problem.point_index[right])[problem.point_index] > 1
    assert np.mean(solution.rejected[right]) < (0.01 if how == "well" else 0.05)
    np.testing.assert_array_equal(solution.problem.cameras[lost, :6], start.cameras[lost, :6])
    gone = np.setdiff1d(np.arange(problem.num_points), problem.point_index[~solution.rejected])
    assert len(gone)
    np.testing.assert_array_equal(solution.problem.points[gone], start.points[gone])
    check(solution, scene(), ~wrong)
    assert solution.final_cost < solution.initial_cost
    assert len(solution.history.cost) == solution.iterations


@pytest.mark.slow
def test_other_residuals_keep_their_weight():
    """Positions that were measured hold the scene, as in a solve without the wrong matches."""
    centers = geometry.camera_centers(scene().cameras)
    problem, wrong = with_wrong(scene(), 0.3)

    def measure(one):
        return jaxba.with_position_priors(one, centers, stddev=1e-3, align=False)

    solution = solve_graduated(measure(problem), options=QUICK)
    assert solution.rejected is not None
    assert solution.rejected[wrong].all()
    alone = jaxba.solve(measure(scene()).subset(~solution.rejected), options=QUICK)
    assert solution.final_cost == pytest.approx(alone.final_cost, rel=1e-3)


def test_iterations_are_counted_over_all_solves_and_a_callback_ends_them():
    seen = []
    problem = with_images(with_wrong(scene(), 0.3)[0], "turned")
    solution = solve_graduated(
        problem, options=QUICK, callback=lambda record: seen.append(record) or len(seen) == 7
    )
    assert [record.iteration for record in seen] == list(range(1, 8))
    assert solution.iterations == 7
    assert not solution.converged


@pytest.mark.slow
def test_hardly_a_right_match_is_rejected_but_beyond_a_limit_and_an_impossible_limit_is_an_error():
    found = solve_graduated(scene(), options=QUICK).rejected
    assert found is not None
    assert found.mean() < 2e-3
    solution = solve_graduated(scene(), options=QUICK, max_residual=1.5)
    norms = np.linalg.norm(geometry.residuals(solution.problem), axis=1)
    assert solution.rejected is not None
    assert norms[~solution.rejected].max() < 1.6  # after one more solve
    with pytest.raises(ProblemError, match="no observation fits"):
        solve_graduated(scene(), options=QUICK, max_residual=1e-9)
    with pytest.raises(ValueError, match="negative"):
        solve_graduated(scene(), max_residual=-1.0)
