"""Converts a bundle adjustment problem to a Ceres problem and back. Needs the extra `ceres`."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Bool

from jaxba.peers.colmap import (
    LENS_SIZE,
    PRINCIPAL_POINT,
    SMALLEST_DEPTH,
    TwoSidedReprojection,
    pose_manifold,
    pyceres,
    reprojection,
)
from jaxba.problem import geometry
from jaxba.problem.bundle_problem import BundleProblem, ProblemError
from jaxba.problem.geometry import COLMAP_FLIP as FLIP
from jaxba.problem.geometry import bal_rotations, colmap_quaternions


class ColmapProblem:
    """The parameters as NumPy arrays, and a `pyceres.Problem` that changes them in place.

    Each camera has its own pose, f, k1 and k2. The principal point is constant and the gauge is free. An observation
    whose point is not in front of its camera at the start gets the cost function `TwoSidedReprojection`, since COLMAP's
    would be zero. `count_behind` does the same for points that move behind their camera later.

    Ceres holds raw pointers into `poses`, `lenses` and `points`, and to the cost functions. This object owns all of
    them, so it must live for as long as `ceres` is used.
    """

    def __init__(self, problem: BundleProblem) -> None:
        """Copies the parameters. Raises ProblemError: covariances, lenses, constants, priors or rigs."""
        parts = problem.whitening, problem.lenses, problem.constants, problem.rigs
        if problem.residuals or any(part is not None for part in parts):
            raise ProblemError("Ceres as a peer takes no covariances, lenses, constants, priors or rigs")
        self.start = problem
        self.poses, self.lenses, self.points = _parameters(problem)
        self.pixels = np.asarray(problem.observations, np.float64) * FLIP[:2]
        self.ceres = pyceres.Problem()
        self._points, self._poses, self._lenses = list(self.points), list(self.poses), list(self.lenses)
        self._manifolds = (pose_manifold(), pyceres.SubsetManifold(LENS_SIZE, list(PRINCIPAL_POINT)))
        self._costs: list[Any] = [None] * problem.num_observations
        self._residuals: list[Any] = [None] * problem.num_observations
        self.in_python = geometry.depths(problem) < SMALLEST_DEPTH
        """Whether the cost function of an observation is the one in Python, shape `(observations,)`."""
        for observation, behind in enumerate(self.in_python):
            self._add_observation(observation, TwoSidedReprojection if behind else reprojection)
        self.observing = np.unique(problem.camera_index)
        """Cameras that have observations."""
        for camera in self.observing:
            self.ceres.set_manifold(self._poses[camera], self._manifolds[0])
            self.ceres.set_manifold(self._lenses[camera], self._manifolds[1])

    def _add_observation(self, observation: int, cost: Any) -> None:
        camera, point = self.start.camera_index[observation], self.start.point_index[observation]
        self._costs[observation] = cost(self.pixels[observation])
        blocks = [self._points[point], self._poses[camera], self._lenses[camera]]
        self._residuals[observation] = self.ceres.add_residual_block(self._costs[observation], None, blocks)

    def count_behind(self, behind: Bool[np.ndarray, " observations"]) -> int:
        """Replaces cost functions of observations of points that moved behind their camera; returns how many."""
        new = np.flatnonzero(behind & ~self.in_python).tolist()
        for observation in new:
            self.ceres.remove_residual_block(self._residuals[observation])
            self._add_observation(observation, TwoSidedReprojection)
        self.in_python[new] = True
        return len(new)

    def add_point_cost(self, cost: Any, point: int) -> None:
        """Adds a cost function of one point that is not an observation."""
        self._costs.append(cost)
        self.ceres.add_residual_block(cost, None, [self._points[point]])

    def parameters(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Copies of `poses`, `lenses` and `points`."""
        return self.poses.copy(), self.lenses.copy(), self.points.copy()

    def restore(self, parameters: tuple[np.ndarray, np.ndarray, np.ndarray]) -> None:
        """Sets the parameters to what `parameters` returned, in place."""
        for block, old in zip((self.poses, self.lenses, self.points), parameters, strict=True):
            block[:] = old

    def set_parameters_of(self, problem: BundleProblem) -> None:
        """Sets the parameters to those of a problem of the same shape, in place."""
        self.restore(_parameters(problem))

    def bundle(self) -> BundleProblem:
        """The problem at the current parameters. Cameras without observations are unchanged."""
        cameras: Any = np.array(self.start.cameras, np.float64)
        poses, lenses = self.poses[self.observing], self.lenses[self.observing]
        cameras[self.observing] = np.hstack([bal_rotations(poses[:, :4]), poses[:, 4:] * FLIP, lenses[:, [0, 3, 4]]])
        return self.start.replace(cameras=cameras, points=self.points.copy())


def _parameters(problem: BundleProblem) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """New arrays of poses `(cameras, 7)`, lenses `(cameras, 5)` and points `(points, 3)` in COLMAP's convention."""
    cameras = np.asarray(problem.cameras, np.float64)
    lenses = np.zeros((len(cameras), LENS_SIZE))
    lenses[:, [0, 3, 4]] = cameras[:, 6:]
    poses = np.hstack([colmap_quaternions(cameras[:, :3]), cameras[:, 3:6] * FLIP])
    return poses, lenses, np.array(problem.points, np.float64, order="C")
