"""The BAL camera on the host: rotations, centres, projection and cost in float64 NumPy.

This is the reference that readers, generators and tests use; the solver has its own code for devices.
Large problems are worked through in pieces, so that memory beyond the result stays small.
"""

from __future__ import annotations

from collections.abc import Iterator

import jax
import numpy as np
from jaxtyping import Float

from jaxba.problem.bundle_problem import BundleProblem

Array = np.ndarray | jax.Array
"""What a problem may hold; every result here is a NumPy array."""

CHUNK = 1 << 19
"""Observations handled at once: some 100 MB of temporaries, measured no slower than larger pieces."""

COLMAP_FLIP = np.array([1.0, -1.0, -1.0])
"""BAL's axes of a camera to COLMAP's, which looks down +z with y downwards; for pixels its first two."""


def rotation_matrices(vectors: Float[Array, "n 3"]) -> Float[np.ndarray, "n 3 3"]:
    """Rotation matrices of angle-axis vectors (radians), by Rodrigues' formula.

    `R = I + a [w] + b [w]^2` with `a = sin(t)/t` and `b = (1 - cos t)/t^2`, t the angle. Both are
    written with `sinc`, which is exact at zero and does not cancel near it.
    """
    w = np.asarray(vectors, dtype=np.float64)
    angle = np.linalg.norm(w, axis=1)
    first = np.sinc(angle / np.pi)[:, None, None]
    second = (0.5 * np.sinc(angle / (2 * np.pi)) ** 2)[:, None, None]
    x, y, z = w.T
    cross = np.zeros((len(w), 3, 3))
    cross[:, 0, 1], cross[:, 0, 2], cross[:, 1, 2] = -z, y, -x
    cross[:, 1, 0], cross[:, 2, 0], cross[:, 2, 1] = z, -y, x
    return np.eye(3) + first * cross + second * (cross @ cross)


def angle_axis(rotations: Float[Array, "n 3 3"]) -> Float[np.ndarray, "n 3"]:
    """Angle-axis vectors (radians, length at most pi) of rotation matrices.

    Goes by the unit quaternion, taken from its largest component (Shepperd 1978), so it keeps full
    precision near the angles 0 and pi. At exactly pi either sign of the axis may come back.
    """
    r = np.asarray(rotations, dtype=np.float64)
    quaternion = _quaternions(r)
    quaternion *= np.where(quaternion[:, :1] < 0, -1.0, 1.0)
    sine = np.linalg.norm(quaternion[:, 1:], axis=1)
    angle = 2 * np.arctan2(sine, quaternion[:, 0])
    scale = np.divide(angle, sine, out=np.full(len(r), 2.0), where=sine > 0)  # 2 is the limit at zero
    return scale[:, None] * quaternion[:, 1:]


def _quaternions(r: np.ndarray) -> np.ndarray:
    """Unit quaternions (w, x, y, z) of rotation matrices; the sign is arbitrary."""
    trace = np.trace(r, axis1=1, axis2=2)
    # Row i of the symmetric matrix 4 q q^T is q scaled by 4 q_i; the one with the largest q_i is safe to normalise.
    outer = np.empty((len(r), 4, 4))
    outer[:, 0, 0] = 1 + trace
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        outer[:, 1 + i, 1 + i] = 1 + 2 * r[:, i, i] - trace
        outer[:, 0, 1 + i] = outer[:, 1 + i, 0] = r[:, k, j] - r[:, j, k]
        outer[:, 1 + i, 1 + j] = outer[:, 1 + j, 1 + i] = r[:, i, j] + r[:, j, i]
    largest = np.argmax(np.diagonal(outer, axis1=1, axis2=2), axis=1)
    rows = outer[np.arange(len(r)), largest]
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def colmap_quaternions(vectors: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 4"]:
    """Unit quaternions xyzw of `diag(1, -1, -1) R(w)` for angle-axis vectors w: `i q`, where i turns by pi about x."""
    half = 0.5 * vectors
    angle = np.linalg.norm(half, axis=1)
    x, y, z = (np.sinc(angle / np.pi)[:, None] * half).T
    return np.column_stack([np.cos(angle), -z, y, -x])


def bal_rotations(quaternions: Float[np.ndarray, "n 4"]) -> Float[np.ndarray, "n 3"]:
    """Angle-axis vectors, of length pi at most: the inverse of `colmap_quaternions`."""
    x, y, z, w = np.where(quaternions[:, :1] < 0, -1.0, 1.0).T * quaternions.T
    vector = np.column_stack([-w, z, -y])
    sine = np.linalg.norm(vector, axis=1)
    scale = np.divide(2 * np.arctan2(sine, x), sine, out=np.full(len(sine), 2.0), where=sine > 0)  # 2: limit at zero
    return scale[:, None] * vector


def camera_centers(cameras: Float[Array, "cameras 9"]) -> Float[np.ndarray, "cameras 3"]:
    """Positions of the cameras in the scene, `c = -R^T t`, in scene units."""
    cameras = np.asarray(cameras, dtype=np.float64)
    return -np.einsum("nji,nj->ni", rotation_matrices(cameras[:, :3]), cameras[:, 3:6])


def translations(rotations: Float[np.ndarray, "n 3 3"], centers: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Translations `t = -R c` of cameras with given rotations and centres."""
    return -np.einsum("nij,nj->ni", rotations, centers)


def distort(plane: Float[np.ndarray, "n 2"], intrinsics: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2"]:
    """Pixels of directions `p = -P.xy / P.z` under the intrinsics `(f, k1, k2)`: `f (1 + k1 |p|^2 + k2 |p|^4) p`."""
    square = np.einsum("ni,ni->n", plane, plane)
    focal, k1, k2 = intrinsics.T
    return (focal * (1 + square * (k1 + k2 * square)))[:, None] * plane


def project(problem: BundleProblem) -> Float[np.ndarray, "observations 2"]:
    """Predicted pixels of every observation.

    Points behind a camera are projected by the same formula, as BAL does; a point at depth zero gives
    a result that is not finite.
    """
    predicted = np.empty((problem.num_observations, 2))
    intrinsics = np.asarray(problem.cameras, dtype=np.float64)[:, 6:]
    for part, camera, local in _camera_frames(problem):
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            predicted[part] = distort(local[:, :2] / -local[:, 2:], intrinsics[camera])
    return predicted


def depths(problem: BundleProblem) -> Float[np.ndarray, " observations"]:
    """Distance of every observed point along its camera's view, `-P.z` in scene units; positive in front."""
    result = np.empty(problem.num_observations)
    for part, _, local in _camera_frames(problem):
        result[part] = -local[:, 2]
    return result


def residuals(problem: BundleProblem) -> Float[np.ndarray, "observations 2"]:
    """`Sigma^(-1/2) (z_obs - z_pred)` of every observation; pixels where the problem has no whitening."""
    difference = np.asarray(problem.observations, dtype=np.float64) - project(problem)
    if problem.whitening is None:
        return difference
    return np.einsum("nij,nj->ni", np.asarray(problem.whitening, dtype=np.float64), difference)


def cost(problem: BundleProblem) -> float:
    """Half the sum of squared residuals, in pixels squared where the problem has no whitening."""
    r = residuals(problem).ravel()
    return 0.5 * float(r @ r)


def _camera_frames(problem: BundleProblem) -> Iterator[tuple[slice, np.ndarray, np.ndarray]]:
    """Observations in pieces: their slice, their camera (n,), and their point in its frame `R X + t` (n, 3)."""
    cameras = np.asarray(problem.cameras, dtype=np.float64)
    points = np.asarray(problem.points, dtype=np.float64)
    camera_index, point_index = np.asarray(problem.camera_index), np.asarray(problem.point_index)
    rotation = rotation_matrices(cameras[:, :3])
    for start in range(0, problem.num_observations, CHUNK):
        part = slice(start, start + CHUNK)
        camera = camera_index[part]
        yield part, camera, np.einsum("nij,nj->ni", rotation[camera], points[point_index[part]]) + cameras[camera, 3:6]
