"""Covariances where not everything is determined are those of the dense pseudo-inverse, and NaN for
the rest."""

from __future__ import annotations

import numpy as np
import pytest
import support
from support import solved

from jaxba import (
    BundleProblem,
    ProblemError,
    ProblemWarning,
    StepOptions,
    covariance,
    hold,
    with_gauge,
)
from jaxba.problem.labels import Labels
from jaxba.problem.options import Coordinates


def weak() -> BundleProblem:
    """Camera 4 has four observations, camera 5 a constant pose and one, point 7 one; nothing sees
    point 9."""
    problem = hold(with_gauge(solved(), "two-cameras"), poses=[5])
    camera = problem.camera_index
    point = problem.point_index

    def of_camera(at):
        return np.cumsum(camera == at) * (camera == at)

    kept = (of_camera(4) <= 4) & (of_camera(5) <= 1) & (point != 9)
    kept &= (point != 7) | (np.cumsum((point == 7) & kept) <= 1)
    return problem.replace(
        observations=problem.observations[kept], camera_index=camera[kept], point_index=point[kept]
    )


def dense(problem: BundleProblem) -> np.ndarray:
    """The pseudo-inverse of the whole information matrix, NaN for numbers with a part in its null
    space."""
    _, jacobian = support.linear(problem, StepOptions(coordinates=Coordinates(rotation="manifold")))
    constant = np.zeros(problem.cameras.shape, bool)
    constant[:, :6] = problem.constants.poses
    moves = ~np.concatenate([constant.ravel(), np.repeat(problem.constants.points, 3)])
    size = np.linalg.norm(jacobian[:, moves], axis=0)
    scale = 1 / np.where(size > 0, size, 1.0)
    _, values, rows = np.linalg.svd(jacobian[:, moves] * scale)
    values = np.append(values, np.zeros(len(rows) - len(values)))
    determined = values > 1e-10
    part = rows[determined] / values[determined, None]
    inverse = part.T @ part * scale[:, None] * scale
    lost = np.linalg.norm(rows[~determined], axis=0) > 1e-8
    inverse[lost], inverse[:, lost] = np.nan, np.nan
    whole = np.zeros((len(moves), len(moves)))
    whole[np.ix_(moves, moves)] = inverse
    return whole


def close(found: np.ndarray, wanted: np.ndarray) -> None:
    np.testing.assert_allclose(
        found, wanted, rtol=1e-4, atol=1e-7 * np.nan_to_num(np.abs(wanted)).max() + 1e-14
    )


def test_what_is_determined_has_the_covariance_of_the_dense_pseudo_inverse():
    problem = weak()
    points = 100 + np.arange(problem.num_points)
    cameras = 10 + np.arange(6)
    labels = Labels(tuple(f"{k}.jpg" for k in range(6)), cameras, 20 + np.arange(6), points)
    note = r"NaN for a covariance: image 14 \(4.jpg\), camera 24 and 1 more, point 107"
    with pytest.warns(ProblemWarning, match=note):
        found = covariance(problem.replace(labels=labels))
    whole = dense(problem)
    for camera in range(6):
        at = 9 * camera + np.arange(9)
        close(found.poses[camera], whole[np.ix_(at[:6], at[:6])])
        close(found.lenses[camera], whole[np.ix_(at[6:], at[6:])])
    for point in range(problem.num_points):
        at = 9 * 6 + 3 * point + np.arange(3)
        close(found.points[point], whole[np.ix_(at, at)])
    lost = [
        np.flatnonzero(np.isnan(x).any(axis=(1, 2))).tolist()
        for x in (found.poses, found.lenses, found.points)
    ]
    once = np.flatnonzero(
        np.bincount(problem.point_index, minlength=problem.num_points) < 2
    ).tolist()
    assert lost == [[4], [4, 5], once]
    assert np.isnan(np.diagonal(found.between(1, 4))).tolist() == [False] * 6 + [True] * 6


def test_a_point_that_is_nearly_not_determined_changes_no_other_covariance():
    """Rays of one point are parallel to within the given angle: its information is a share of that
    squared."""
    problem = hold(with_gauge(solved(), "two-cameras"), lenses="all")
    without = problem.point_index != 7
    names = ("observations", "camera_index", "point_index")
    wanted = covariance(
        problem.replace(**{name: getattr(problem, name)[without] for name in names})
    )
    for distance in (1e4, 1e6):
        points = np.array(problem.points)
        points[7] *= distance
        found = covariance(problem.replace(points=points))
        others = np.arange(problem.num_points) != 7
        assert np.isfinite(found.points).all()
        # a point at infinity says something of rotations alone: variances become smaller, by a
        # little
        assert (np.diagonal(found.points[others], axis1=1, axis2=2) > 0).all()

        def near(x):
            return np.diagonal(x, axis1=1, axis2=2)

        assert (near(found.points[others]) <= near(wanted.points[others]) * (1 + 1e-6)).all()
        assert (near(found.poses) <= near(wanted.poses) * (1 + 1e-6)).all()


def test_derivatives_that_overflow_are_one_line():
    cameras = np.array(solved().cameras)
    points = np.array(solved().points)
    point = solved().point_index[solved().camera_index == 0][0]
    cameras[0, :6], points[point] = 0.0, [1.0, 1.0, -1e-70]  # nearly in the plane of a camera
    problem = hold(solved().replace(cameras=cameras, points=points), poses=[0, 1])
    with pytest.raises(ProblemError, match="no covariances: derivatives of the pixels overflow"):
        covariance(problem)
