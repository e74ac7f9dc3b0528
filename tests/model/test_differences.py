"""Derivatives are compared with differences alike wherever a scene is, and wrong ones are refused
everywhere."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from ready_made import EACH, ORIGINS, relative_poses, row_of, scene

import jaxba
from jaxba import residuals
from jaxba.problem import geometry

TIGHT = jaxba.SolveOptions(tolerances=jaxba.Tolerances(1e-14, 1e-14, 1e-14), max_iterations=200)


@jax.custom_jvp
def lie(x):
    return x


@lie.defjvp
def _(primals, tangents):
    return primals[0], 1.01 * tangents[0]


@jaxba.residual
def lying_distance(point, point_2, *, length):
    return lie(jnp.linalg.norm(point_2 - point)) - length


@jaxba.residual
def lying_pose(pose, pose_2, *, rotation, translation, whitening):
    measured = {"rotation": rotation, "translation": translation, "whitening": whitening}
    return lie(residuals.relative_pose.function(pose, pose_2, **measured))


@jaxba.residual
def lying_block(pose, offset, *, measured):
    return 1e3 * (pose.center - measured) + lie(offset)


def taken(problem: jaxba.BundleProblem, name: str) -> jaxba.BundleProblem:
    rows, unknowns = row_of(name, problem)
    return jaxba.with_residual(problem, rows, unknowns=unknowns)


@pytest.mark.parametrize(
    "name",
    [
        "distance",
        *(
            pytest.param(name, marks=pytest.mark.slow)
            for name in residuals.__all__
            if name not in ("distance", "preintegrated")
        ),
    ],
)
@pytest.mark.parametrize("size", [1.0, 1e-2])
def test_a_residual_is_taken_and_has_its_cost_wherever_the_scene_is(name, size):
    costs = []
    for origin in ORIGINS:
        problem = taken(scene(origin, size=size), name)
        costs.append(jaxba.solve(problem, options=jaxba.SolveOptions(max_iterations=0)).costs[name])
    assert len(costs) == len(ORIGINS)
    np.testing.assert_allclose(costs, costs[0], rtol=1e-3)  # nanometres over centimetres, twice


@pytest.mark.parametrize("gap", [1e-2, 1e-4, 1e-6])
def test_a_function_may_bend_within_a_small_part_of_the_scene(gap):
    problem = scene()
    points = problem.points.copy()
    points[EACH + 1] = points[EACH] + [gap, 0.0, 0.0]
    rows = residuals.distance(point=EACH, point_2=EACH + 1, length=np.ones(len(EACH)), sigma=0.1)
    assert jaxba.with_residual(problem.replace(points=points), rows).residuals


@pytest.mark.parametrize("origin", ORIGINS)
def test_wrong_derivatives_are_refused_wherever_the_scene_is(origin, unchecked):
    rows = lying_distance(point=EACH, point_2=EACH + 1, length=1.0)
    with pytest.raises(
        jaxba.ProblemError, match="lying_distance do not agree with differences: by point"
    ):
        jaxba.with_residual(scene(origin), rows)


def test_a_wrong_derivative_by_what_moves_little_is_refused(unchecked):
    problem = scene()
    rows = lying_block(pose=EACH, offset=EACH, measured=np.zeros((1, 3)))
    with pytest.raises(
        jaxba.ProblemError, match="lying_block do not agree with differences: by offset"
    ):
        jaxba.with_residual(problem, rows, unknowns={"offset": np.ones((problem.num_cameras, 3))})


def half_a_turn_away(problem: jaxba.BundleProblem) -> dict[str, np.ndarray]:
    """Relative poses that are 180 degrees from those of the scene."""
    rotation, translation = relative_poses(problem)
    return {"rotation": rotation @ np.diag([1.0, -1.0, -1.0]), "translation": translation}


@pytest.mark.slow
@pytest.mark.parametrize("origin", ["origin", "map"])
def test_where_rotations_jump_only_wrong_derivatives_are_refused(origin, unchecked):
    problem = scene(origin)
    measured = half_a_turn_away(problem) | {"whitening": np.eye(6)[None]}
    index = {"pose": EACH, "pose_2": EACH + 1}
    assert jaxba.with_residual(problem, residuals.relative_pose(**index, **measured)).residuals
    with pytest.raises(
        jaxba.ProblemError, match="lying_pose do not agree with differences: by pose"
    ):
        jaxba.with_residual(problem, lying_pose(**index, **measured))


@pytest.mark.slow
def test_a_pose_graph_ends_alike_in_map_coordinates():
    """One of its poses starts half a turn away."""
    costs = []
    for origin in ("origin", "map"):
        problem = scene(origin)
        rotation, translation = relative_poses(problem)
        measured = {
            "rotation": np.concatenate([rotation, np.eye(3)[None]]),
            "translation": np.concatenate([translation + 0.1, np.ones((1, 3))]),
            "whitening": np.eye(6),
        }
        rows = residuals.relative_pose(pose=[*EACH, 0], pose_2=[*(EACH + 1), 4], **measured)
        cameras = problem.cameras.copy()
        turns = geometry.rotation_matrices(cameras[:, :3])
        turns[2] = np.diag([1.0, -1.0, -1.0]) @ turns[2]
        centers = geometry.camera_centers(problem.cameras)
        cameras[:, :3] = geometry.angle_axis(turns)
        cameras[:, 3:6] = geometry.translations(turns, centers)
        graph = jaxba.with_residual(jaxba.BundleProblem.create(cameras), rows)
        costs.append(jaxba.solve(jaxba.hold(graph, poses=[0]), options=TIGHT).final_cost)
    assert costs[1] == pytest.approx(costs[0], rel=1e-6)
