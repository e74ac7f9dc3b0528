"""The least-squares similarity between two sets of positions, whole or as far as a line determines
it."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxba.problem.bundle_problem import BundleProblem, ProblemError
from jaxba.problem.geometry import angle_axis, camera_poses, rotation_matrices

Poses = Float[np.ndarray, "poses 3 4"]
"""Camera-to-world poses `[R | c]`."""

# second singular value of the covariance over the first, below which positions lie on a line
LEAST_SPREAD = 1e-12
SAME_LINE = 1e-12  # sine of the angle below which two unit vectors are taken to lie on one line


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


def upright(problem: BundleProblem) -> Similarity:
    """The similarity to a scene around the origin, of a size of about one, with cameras' mean up
    along +z."""
    poses = camera_poses(problem.cameras)
    points = np.asarray(problem.points)
    places = np.concatenate([poses[:, :, 3], points])
    places = places[np.isfinite(places).all(axis=1)]
    middle = np.median(points if len(points) else places, axis=0)
    size = float(np.percentile(np.linalg.norm(places - middle, axis=1), 80)) or 1.0
    up = -poses[:, :, 1].mean(axis=0)
    length = np.linalg.norm(up)
    up = up / length if length > 0 else np.array([0.0, 0.0, 1.0])
    ahead = poses[:, :, 2].mean(axis=0)
    side = np.cross(ahead, up)
    if np.linalg.norm(side) < 1e-6:
        side = np.cross(np.eye(3)[np.abs(up).argmin()], up)
    side /= np.linalg.norm(side)
    rotation = np.stack([side, np.cross(up, side), up])
    return Similarity(1 / size, rotation, -rotation @ middle / size)


def transformed(
    problem: BundleProblem, by: Similarity, seen: Any = slice(None), placed: Any = slice(None)
) -> BundleProblem:
    """A problem moved with the cameras and points that are chosen. Residuals stay as they are."""
    scale, rotation, shift = by
    cameras, points = (np.array(x, np.float64) for x in (problem.cameras, problem.points))
    rigs = problem.rigs
    matrices = rotation_matrices(cameras[seen, :3])
    if (rotation != np.eye(3)).any():
        matrices = matrices @ rotation.T
        cameras[seen, :3] = angle_axis(matrices)
    cameras[seen, 3:6] = scale * cameras[seen, 3:6] - matrices @ shift
    points[placed] = by.points(points[placed])
    rigs = rigs if rigs is None or scale == 1.0 else rigs.scaled(scale)
    return problem.replace(
        cameras=cameras, points=points, rigs=rigs, residuals=problem.residuals.moved(*by)
    )


def umeyama(
    source: Float[np.ndarray, "n 3"],
    target: Float[np.ndarray, "n 3"],
    weights: Float[np.ndarray, " n"] | None = None,
) -> Similarity:
    """The least-squares similarity from `source` to `target`, with weights of the squared
    distances. Raises ProblemError: fewer than three points, or all of them at one position or on
    one line.

    Source: Umeyama 1991, eqs. 38-42; evo's `geometry.umeyama_alignment` is the same."""
    if len(source) < 3:
        raise ProblemError(f"an alignment needs 3 poses, not {len(source)}")
    shares = np.full(len(source), 1 / len(source)) if weights is None else weights / weights.sum()
    mean_source = shares @ source
    mean_target = shares @ target
    a = source - mean_source
    b = target - mean_target
    with np.errstate(over="ignore", invalid="ignore"):
        covariance = (shares[:, None] * b).T @ a
        square = shares @ (a * a).sum(axis=1)
    if not (np.isfinite(covariance).all() and np.isfinite(square)):
        raise ProblemError(
            "the trajectories cannot be aligned: positions are too far apart to be squared"
        )
    u, d, vt = np.linalg.svd(covariance)
    if not d[1] > LEAST_SPREAD * d[0]:
        raise ProblemError(
            "the trajectories cannot be aligned: the positions of one lie on a straight line"
        )
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    rotation = (u * sign) @ vt
    scale = float((d * sign).sum() / square)
    return Similarity(scale, rotation, mean_target - scale * rotation @ mean_source)


def along_line(
    source: Float[np.ndarray, "n 3"],
    target: Float[np.ndarray, "n 3"],
    weights: Float[np.ndarray, " n"],
) -> Similarity:
    """The similarity that takes the line through `source` to that through `target`, by the smallest
    rotation, without a turn about it. Arguments as for `umeyama`; the points of neither may be at
    one place."""
    shares = weights / weights.sum()
    mean_source = shares @ source
    mean_target = shares @ target
    a = source - mean_source
    line = np.linalg.svd(np.sqrt(shares)[:, None] * a, full_matrices=False)[2][0]
    along = a @ line
    slope = (shares * along) @ (target - mean_target) / (shares @ along**2)
    scale = float(np.linalg.norm(slope))
    rotation = smallest_rotation(line, slope / scale)
    return Similarity(scale, rotation, mean_target - scale * rotation @ mean_source)


def smallest_rotation(
    source: Float[np.ndarray, "3"], target: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "3 3"]:
    """The rotation by the smallest angle that takes one unit vector to another; where they are
    opposite, one of them.

    SciPy's `Rotation.align_vectors` is wrong by 1e-5 between vectors that are so far from opposite,
    on some processors."""
    cosine = source @ target
    across = target - cosine * source
    if np.linalg.norm(across) < SAME_LINE:
        across = np.eye(3)[np.argmin(np.abs(source))]  # any direction across the line
    for _ in range(2):  # the second time for what was lost where the first difference is small
        across = across - (across @ source) * source
        across = across / np.linalg.norm(across)
    sine = target @ across
    plane = np.stack([source, across], axis=1)
    turn = np.array([[cosine, -sine], [sine, cosine]])
    return np.eye(3) + plane @ (turn - np.eye(2)) @ plane.T
