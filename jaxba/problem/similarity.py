"""The least-squares similarity between two sets of positions."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxba.problem.bundle_problem import ProblemError

Poses = Float[np.ndarray, "poses 3 4"]
"""Camera-to-world poses `[R | c]`."""

LEAST_SPREAD = 1e-12
"""Second singular value of the covariance, as a share of the first, below which the positions lie on a line, so that
the rotation about it is undetermined."""


class Similarity(NamedTuple):
    """`x -> scale R x + t`."""

    scale: float
    rotation: Float[np.ndarray, "3 3"]
    translation: Float[np.ndarray, "3"]

    def points(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Transforms points."""
        return self.scale * points @ self.rotation.T + self.translation

    def poses(self, poses: Poses) -> Poses:
        """Transforms camera-to-world poses: centres as points, orientations by the rotation."""
        centers = self.points(poses[:, :, 3])
        return np.concatenate([self.rotation @ poses[:, :, :3], centers[:, :, None]], axis=2)


def umeyama(source: Float[np.ndarray, "n 3"], target: Float[np.ndarray, "n 3"]) -> Similarity:
    """The least-squares similarity from `source` to `target`.

    Raises:
        ProblemError: fewer than three points, or all of them at one position or on one line.

    Source: Umeyama 1991, eqs. 38-42; evo's `geometry.umeyama_alignment` is the same.
    """
    if len(source) < 3:
        raise ProblemError(f"an alignment needs 3 poses, not {len(source)}")
    mean_source, mean_target = source.mean(axis=0), target.mean(axis=0)
    a, b = source - mean_source, target - mean_target
    with np.errstate(over="ignore", invalid="ignore"):
        covariance, square = b.T @ a / len(a), (a * a).sum()
    if not (np.isfinite(covariance).all() and np.isfinite(square)):
        raise ProblemError("the trajectories cannot be aligned: positions are too far apart to be squared")
    u, d, vt = np.linalg.svd(covariance)
    if not d[1] > LEAST_SPREAD * d[0]:
        raise ProblemError("the trajectories cannot be aligned: the positions of one lie on a straight line")
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    rotation = (u * sign) @ vt
    scale = float((d * sign).sum() / square * len(a))
    return Similarity(scale, rotation, mean_target - scale * rotation @ mean_source)
