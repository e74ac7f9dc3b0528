"""A solve starts where residuals say that the scene is as a whole, wherever it was, unless
something else says it."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest
from ready_made import EACH, ORIGINS, colmap_rotations, relative_poses
from scipy.spatial.transform import Rotation

import jaxba
from jaxba import residuals
from jaxba.problem import geometry
from jaxba.problem.similarity import Similarity, transformed
from jaxba.scenes import SceneConfig
from jaxba.solver.start import as_measured

TIGHT = jaxba.SolveOptions(tolerances=jaxba.Tolerances(1e-13, 1e-13, 1e-13), max_iterations=100)

UP = np.array([0.3, 0.2, 1.0])

FACTORS = (1e-3, 0.02, 1.0, 50.0, 1e3)

ENDS = ([3, 5, 7], [20, 21, 22])  # of measured distances


@pytest.fixture(scope="module")
def truth() -> jaxba.BundleProblem:
    problem = jaxba.random_scene(SceneConfig(5, 40, 180, noise=0.0), 3)
    noise = 0.3 * np.random.default_rng(0).standard_normal((180, 2))
    problem = problem.replace(observations=geometry.project(problem) + noise)
    return jaxba.hold(problem, numbers=["focal", "distortion"])


def somewhere(
    truth: jaxba.BundleProblem, scale: float, turn=(3.0, 0.3, 0.5)
) -> jaxba.BundleProblem:
    """The scene of another size, place and attitude, and a little off."""
    start = jaxba.perturb(truth, 1, 0.002, 0.02, 0.02)
    place = scale * np.array([1.0, 2.0, 3.0])
    return transformed(start, Similarity(scale, Rotation.from_rotvec(turn).as_matrix(), place))


def lengths(problem: jaxba.BundleProblem) -> np.ndarray:
    return np.linalg.norm(problem.points[ENDS[0]] - problem.points[ENDS[1]], axis=1)


def bars(truth: jaxba.BundleProblem, factor: float = 1.0) -> jaxba.problem.residuals.Rows:
    length = factor * lengths(truth)
    return residuals.distance(point=ENDS[0], point_2=ENDS[1], length=length, sigma=0.01)


def gravity(truth: jaxba.BundleProblem) -> jaxba.problem.residuals.Rows:
    measured = colmap_rotations(truth)[EACH] @ UP
    return residuals.gravity(pose=EACH, direction=measured, up=UP, sigma=0.01)


def control_points(
    truth: jaxba.BundleProblem, offset=(0.0, 0.0, 0.0)
) -> jaxba.problem.residuals.Rows:
    place = truth.points[:8] + offset
    return residuals.control_point(point=np.arange(8), position=place, whitening=np.eye(3) / 0.01)


def size(problem: jaxba.BundleProblem) -> float:
    return float(np.linalg.norm(np.ptp(geometry.camera_centers(problem.cameras), axis=0)))


def test_scale_bars_scale_a_scene_of_any_size_and_leave_its_pixels(truth):
    for factor in FACTORS:
        start = jaxba.with_residual(somewhere(truth, factor), bars(truth))
        moved = as_measured(start)
        share = lengths(start) / lengths(truth)
        expected = share @ np.ones(3) / (share @ share)  # least squares of equal lengths, roughly
        assert size(moved) / size(start) == pytest.approx(expected, rel=0.02)
        assert lengths(moved) == pytest.approx(lengths(truth), rel=0.02)
        assert geometry.cost(moved) == pytest.approx(geometry.cost(start), rel=1e-9)


def test_what_fits_or_is_aligned_or_held_stays_as_it_is(truth):
    fits = jaxba.with_residual(truth, bars(truth))
    assert as_measured(fits) is fits
    start = jaxba.with_residual(jaxba.hold(somewhere(truth, 50.0), poses=[0, 4]), bars(truth))
    assert as_measured(start) is start
    centers = geometry.camera_centers(truth.cameras)
    aligned = jaxba.with_position_priors(truth, centers, stddev=0.05, align=False)
    start = jaxba.with_residual(aligned, bars(truth, 50.0))
    assert as_measured(start) is start


@pytest.mark.parametrize("origin", ["origin", "map"])
@pytest.mark.parametrize("what", ["pose", "point"])
def test_a_scene_is_scaled_about_what_is_held(what, origin, truth):
    start = transformed(
        somewhere(truth, 50.0), Similarity(1.0, np.eye(3), np.array(ORIGINS[origin]))
    )
    start = jaxba.hold(start, poses=[2]) if what == "pose" else jaxba.hold(start, points=[9])
    moved = as_measured(jaxba.with_residual(start, bars(truth)))
    assert lengths(moved) == pytest.approx(lengths(truth), rel=0.02)
    assert geometry.cost(moved) == pytest.approx(geometry.cost(start), rel=1e-6)
    if what == "pose":
        np.testing.assert_array_equal(moved.cameras[2], start.cameras[2])
    else:
        np.testing.assert_array_equal(moved.points[9], start.points[9])


@jaxba.residual
def depth_in_metres(pose, point, *, measured):
    return 10 * (pose.to_camera(point)[2] - measured)


def measured(name: str, truth: jaxba.BundleProblem) -> list[jaxba.problem.residuals.Rows]:
    camera = truth.camera_index[::7]
    point = truth.point_index[::7]
    centers = geometry.camera_centers(truth.cameras)
    rotation, translation = relative_poses(truth)
    index = {"pose": EACH, "pose_2": EACH + 1}
    if name == "baselines":
        length = np.linalg.norm(np.diff(centers, axis=0), axis=1)
        return [residuals.baseline(**index, length=length, sigma=0.01)]
    if name == "relative poses":
        data = {"rotation": rotation, "translation": translation, "whitening": 100 * np.eye(6)}
        return [residuals.relative_pose(**index, **data)]
    if name == "a residual of one's own":
        return [depth_in_metres(pose=camera, point=point, measured=geometry.depths(truth)[::7])]
    if name == "antennas":
        arm = np.array([0.1, 0.2, 0.3])
        place = centers[EACH] + np.einsum("nji,j->ni", colmap_rotations(truth)[EACH], arm)
        return [
            residuals.position(pose=EACH, position=place, lever_arm=arm, whitening=100 * np.eye(3))
        ]
    return {
        "distances": [bars(truth)],
        "gravity": [gravity(truth)],
        "gravity and distances": [gravity(truth), bars(truth)],
        "control points": [control_points(truth)],
        "control points of a map": [control_points(truth, ORIGINS["map"])],
    }[name]


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        "distances",
        "baselines",
        "gravity",
        "gravity and distances",
        "relative poses",
        "antennas",
        "control points",
        "control points of a map",
        "a residual of one's own",
    ],
)
def test_a_solve_ends_alike_from_any_size_and_attitude(name, truth):
    """The truth is the end of a solve from the right size, place and attitude."""
    rows = measured(name, truth)

    def end(start: jaxba.BundleProblem) -> float:
        for part in rows:
            start = jaxba.with_residual(start, part)
        return jaxba.solve(start, options=TIGHT).final_cost

    offset = ORIGINS["map"] if name == "control points of a map" else (0.0, 0.0, 0.0)
    expected = end(transformed(truth, Similarity(1.0, np.eye(3), np.array(offset))))
    for factor in FACTORS:
        for turn in ((0.0, 0.0, 0.0), (3.0, 0.3, 0.5)):
            assert end(somewhere(truth, factor, turn)) == pytest.approx(expected, rel=1e-6)


@pytest.mark.slow
def test_one_scale_bar_costs_no_pixels(truth):
    alone = jaxba.solve(truth, options=TIGHT).final_cost
    length = lengths(truth)[:1]
    bar = residuals.distance(point=ENDS[0][:1], point_2=ENDS[1][:1], length=length, sigma=0.001)
    for factor in FACTORS:
        solution = jaxba.solve(jaxba.with_residual(somewhere(truth, factor), bar), options=TIGHT)
        assert solution.final_cost == pytest.approx(alone, rel=1e-9)
        assert lengths(solution.problem)[0] == pytest.approx(length[0], rel=1e-6)


@pytest.mark.slow
def test_a_scale_that_is_one_of_the_unknowns_moves_no_scene(truth):
    """Depths with a scale of each image: the scale is found, and the size of the scene stays."""
    start = somewhere(truth, 50.0)
    camera = start.camera_index[::7]
    point = start.point_index[::7]
    depths = geometry.depths(truth)[::7]
    rows = residuals.depth(pose=camera, point=point, image=camera, measured=depths, sigma=0.1)
    start = jaxba.with_residual(start, rows, unknowns={"image": np.tile([1.0, 0.0], (5, 1))})
    moved = as_measured(start)
    np.testing.assert_allclose(moved.points, start.points)
    assert moved.residuals.blocks[0][:, 0] == pytest.approx(0.02, rel=0.2)
    assert jaxba.solve(start, options=TIGHT).costs["depth"] < 1.0


@pytest.mark.slow
def test_one_wrong_control_point_with_a_robust_loss_moves_no_scene(truth):
    place = truth.points[:8].copy()
    place[3] += 100.0
    rows = residuals.control_point(point=np.arange(8), position=place, whitening=np.eye(3) / 0.01)
    start = jaxba.with_residual(somewhere(truth, 50.0), rows, loss=jaxba.Loss("cauchy"))
    moved = as_measured(start)
    away = np.linalg.norm(moved.points[:8] - truth.points[:8], axis=1)
    assert jnp.median(away) < 0.1


@pytest.mark.slow
def test_many_problems_start_as_one_does(truth):
    start = jaxba.with_residual(somewhere(truth, 50.0), bars(truth))
    options = jaxba.SolveOptions(max_iterations=3)
    alone = jaxba.solve(start, options=options).final_cost
    for solution in jaxba.solve_many([start, start], options=options):
        assert isinstance(solution, jaxba.Solution)
        assert solution.final_cost == pytest.approx(alone, rel=1e-9)
