"""A bundle adjustment problem as a Ceres problem, and back. Needs the extra `ceres`."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from jaxba.peers.colmap import LENS_SIZE, PRINCIPAL_POINT, SMALLEST_DEPTH, AnySide, pose_manifold, pyceres, reprojection
from jaxba.problem import geometry
from jaxba.problem.bundle_problem import BundleProblem, ProblemError
from jaxba.problem.geometry import COLMAP_FLIP as FLIP
from jaxba.problem.geometry import bal_rotations, colmap_quaternions


class ColmapProblem:
    """The parameters as arrays of our own, and a `pyceres.Problem` that works on them in place.

    Each camera has its own pose, f, k1 and k2; the principal point is constant, the gauge is free. An observation whose
    point is not in front of its camera at the start has a cost function in Python (`AnySide`), since COLMAP's would be
    zero; `keep` does the same for those that get there later.

    Ceres holds bare pointers into `poses`, `lenses` and `points`, and to the cost functions. This object owns them all,
    so keep it for as long as `ceres` is used.
    """

    def __init__(self, problem: BundleProblem) -> None:
        """Copies the parameters; the problem itself never changes.

        Raises:
            ProblemError: the problem has covariances or lenses.
        """
        if problem.whitening is not None or problem.lenses is not None:
            raise ProblemError("Ceres as a peer takes no covariances or weights, and no shared or partly fixed lenses")
        self.start = problem
        self.poses, self.lenses, self.points = _parameters(problem)
        self.pixels = np.asarray(problem.observations, np.float64) * FLIP[:2]
        self.ceres = pyceres.Problem()
        self._points, self._poses, self._lenses = list(self.points), list(self.poses), list(self.lenses)
        self._manifolds = (pose_manifold(), pyceres.SubsetManifold(LENS_SIZE, list(PRINCIPAL_POINT)))
        self._costs: list[Any] = [None] * problem.num_observations
        self._residuals: list[Any] = [None] * problem.num_observations
        self.in_python = geometry.depths(problem) < SMALLEST_DEPTH
        """Per observation: whether its cost function is in Python."""
        for observation, hidden in enumerate(self.in_python):
            self._add(observation, AnySide if hidden else reprojection)
        self.seen = np.unique(problem.camera_index)
        for camera in self.seen:
            self.ceres.set_manifold(self._poses[camera], self._manifolds[0])
            self.ceres.set_manifold(self._lenses[camera], self._manifolds[1])

    def _add(self, observation: int, cost: Any) -> None:
        camera, point = self.start.camera_index[observation], self.start.point_index[observation]
        self._costs[observation] = cost(self.pixels[observation])
        blocks = [self._points[point], self._poses[camera], self._lenses[camera]]
        self._residuals[observation] = self.ceres.add_residual_block(self._costs[observation], None, blocks)

    def keep(self, hidden: Bool[np.ndarray, " observations"]) -> int:
        """Gives observations whose points went behind their camera a cost function that counts; returns how many."""
        new = np.flatnonzero(hidden & ~self.in_python).tolist()
        for observation in new:
            self.ceres.remove_residual_block(self._residuals[observation])
            self._add(observation, AnySide)
        self.in_python[new] = True
        return len(new)

    def add(self, cost: Any, point: int) -> None:
        """Adds an error of one point that is no observation."""
        self._costs.append(cost)
        self.ceres.add_residual_block(cost, None, [self._points[point]])

    def parameters(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Copies of `poses`, `lenses` and `points`."""
        return self.poses.copy(), self.lenses.copy(), self.points.copy()

    def restore(self, parameters: tuple[np.ndarray, np.ndarray, np.ndarray]) -> None:
        """Puts back what `parameters` returned, in place."""
        for block, old in zip((self.poses, self.lenses, self.points), parameters, strict=True):
            block[:] = old

    def move_to(self, problem: BundleProblem) -> None:
        """Takes over the parameters of another problem of the same shape, in place."""
        self.restore(_parameters(problem))

    def residuals(self) -> Float[np.ndarray, " residuals"]:
        """What Ceres sees at the present parameters, pixels."""
        return np.array(self.ceres.evaluate_residuals())

    def bundle(self) -> BundleProblem:
        """The problem at the present parameters; what nobody observes is unchanged."""
        cameras: Any = np.array(self.start.cameras, np.float64)
        poses, lenses = self.poses[self.seen], self.lenses[self.seen]
        cameras[self.seen] = np.hstack([bal_rotations(poses[:, :4]), poses[:, 4:] * FLIP, lenses[:, [0, 3, 4]]])
        return self.start.replace(cameras=cameras, points=self.points.copy())


def _parameters(problem: BundleProblem) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Poses, lenses and points, in arrays of their own."""
    cameras = np.asarray(problem.cameras, np.float64)
    lenses = np.zeros((len(cameras), LENS_SIZE))
    lenses[:, [0, 3, 4]] = cameras[:, 6:]
    poses = np.hstack([colmap_quaternions(cameras[:, :3]), cameras[:, 3:6] * FLIP])
    return poses, lenses, np.array(problem.points, np.float64, order="C")
