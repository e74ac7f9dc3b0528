"""A problem without pixels: relative poses alone, against SciPy's least squares."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

import jaxba
from jaxba import residuals
from jaxba.problem.geometry import rotation_matrices
from jaxba.problem.row_value import AXES

COUNT = 8


def graph() -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """Angle-axis and translation of poses from the world, pairs of them, and their measured
    relative poses."""
    random = np.random.default_rng(0)
    poses = np.hstack(
        [0.5 * random.standard_normal((COUNT, 3)), random.standard_normal((COUNT, 3))]
    )
    pairs = np.array([(k, (k + step) % COUNT) for step in (1, 3) for k in range(COUNT)])
    turn, move = between(poses, pairs)
    noise = 0.05 * random.standard_normal((2, len(pairs), 3))
    turn = turn @ Rotation.from_rotvec(noise[0]).as_matrix()
    whitening = np.eye(6) / ([0.05] * 3 + [0.1] * 3)
    return (
        poses,
        pairs,
        {"rotation": turn, "translation": move + noise[1], "whitening": whitening[None]},
    )


def between(poses: np.ndarray, pairs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The poses of second cameras in the frames of first ones."""
    rotation = Rotation.from_rotvec(poses[:, :3]).as_matrix()
    one = rotation[pairs[:, 0]]
    two = rotation[pairs[:, 1]]
    turn = one @ two.transpose(0, 2, 1)
    return turn, poses[pairs[:, 0], 3:] - np.einsum("nij,nj->ni", turn, poses[pairs[:, 1], 3:])


def as_problem(poses: np.ndarray) -> jaxba.BundleProblem:
    turned = AXES[:, None] * Rotation.from_rotvec(poses[:, :3]).as_matrix()
    cameras = [
        Rotation.from_matrix(turned).as_rotvec(),
        AXES * poses[:, 3:],
        np.ones((len(poses), 3)),
    ]
    return jaxba.BundleProblem.create(np.hstack(cameras))


def held_graph() -> jaxba.BundleProblem:
    poses, pairs, measured = graph()
    rows = residuals.relative_pose(pose=pairs[:, 0], pose_2=pairs[:, 1], **measured)
    return jaxba.hold(jaxba.with_residual(as_problem(poses), rows), poses=[0])


@pytest.mark.slow("another file has a sample of it")
def test_a_pose_graph_has_covariances():
    assert np.isfinite(jaxba.covariance(held_graph()).poses).all()


@pytest.mark.slow
def test_a_pose_graph_ends_where_scipy_does():
    poses, pairs, measured = graph()
    problem = held_graph()
    solution = jaxba.solve(
        problem, "ceres", jaxba.SolveOptions(tolerances=jaxba.Tolerances(1e-15, 1e-15, 1e-15))
    )
    assert solution.linear_solver == "explicit"
    assert list(solution.costs) == ["pixels", "relative_pose"]
    np.testing.assert_array_equal(solution.problem.cameras[:, 6:], problem.cameras[:, 6:])

    def errors(free: np.ndarray) -> np.ndarray:
        """`Log(T_measured^-1 T)` of SE(3), by the exponential of its matrix."""
        turn, move = between(np.vstack([poses[:1], free.reshape(-1, 6)]), pairs)
        back = measured["rotation"].transpose(0, 2, 1)
        turn = back @ turn
        move = np.einsum("nij,nj->ni", back, move - measured["translation"])
        axis = Rotation.from_matrix(turn).as_rotvec()
        angle = np.linalg.norm(axis, axis=1)[:, None]
        cross = np.cross(axis, move)
        factor = 1 / angle**2 - (1 + np.cos(angle)) / (2 * angle * np.sin(angle))
        logarithm = move - cross / 2 + factor * np.cross(axis, cross)
        return (np.hstack([axis, logarithm]) @ measured["whitening"][0]).ravel()

    free = problem.replace(constants=None)
    held = jaxba.with_gauge(free, "two-cameras").constants
    assert np.asarray(held.poses).sum(axis=1).max() == 6
    assert np.asarray(held.poses).sum() == 6  # relative poses have a scale
    with pytest.raises(jaxba.ProblemError, match="three that two images see"):
        jaxba.with_gauge(free, "three-points")
    found = least_squares(errors, poses[1:].ravel(), xtol=1e-15, ftol=1e-15, gtol=1e-15)
    assert solution.final_cost == pytest.approx(found.cost, rel=1e-9)
    ends = AXES[:, None] * rotation_matrices(solution.problem.cameras[1:, :3])
    np.testing.assert_allclose(
        Rotation.from_matrix(ends).as_rotvec(), found.x.reshape(-1, 6)[:, :3], atol=1e-6
    )


def test_cameras_alone_are_nothing_to_solve():
    with pytest.raises(jaxba.ProblemError, match="the problem has no observations"):
        jaxba.solve(as_problem(graph()[0]))
