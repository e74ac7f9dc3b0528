"""The BAL camera on the host: rotations, centres, projection and cost in float64 NumPy.

Readers, scene generators and tests use this; the solver has its own code for devices
(`jaxba.model.camera`). Large problems are processed in chunks, so that memory beyond the result
stays small."""

from __future__ import annotations

from collections.abc import Iterator

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxba.problem.bundle_problem import BundleProblem
from jaxba.problem.camera_models import BAL

Array = np.ndarray | jax.Array
"""Arrays of a problem; every result here is a NumPy array."""

# observations processed at once: some 100 MB of temporaries, measured no slower than larger chunks
CHUNK = 1 << 19

COLMAP_FLIP = np.array([1.0, -1.0, -1.0])
"""Signs from BAL's axes (looks down -z, y upwards) to COLMAP's (+z, y downwards), and back; first
two: pixels."""

ROTATION_TOLERANCE = 1e-3
"""Largest entry of `R R^T - I` that counts as rounding in a file: Bundler writes 11 digits, KITTI
7, others fewer."""

# the rotation `diag(COLMAP_FLIP)` as a quaternion xyzw
_HALF_TURN_X = np.array([1.0, 0.0, 0.0, 0.0])


def rotation_matrices(vectors: Float[Array, "n 3"]) -> Float[np.ndarray, "n 3 3"]:
    """Rotation matrices of angle-axis vectors (radians), by Rodrigues' formula.

    `R = I + a [w] + b [w]^2` with `a = sin(t)/t` and `b = (1 - cos t)/t^2`, t the angle. Both are
    written with `sinc`, which is exact at zero and does not cancel near it. Every solve needs this,
    so it does not wait for SciPy's import."""
    w = np.asarray(vectors, dtype=np.float64)
    angle = np.linalg.norm(w, axis=1)
    first = np.sinc(angle / np.pi)[:, None, None]
    second = (0.5 * np.sinc(angle / (2 * np.pi)) ** 2)[:, None, None]
    cross = cross_matrices(w)
    return np.eye(3) + first * cross + second * (cross @ cross)


def cross_matrices(vectors: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3 3"]:
    """Matrices `[v]` with `[v] u = v x u`."""
    return np.cross(vectors[:, None], np.eye(3)).transpose(0, 2, 1)


def angle_axis(rotations: Float[Array, "n 3 3"]) -> Float[np.ndarray, "n 3"]:
    """Angle-axis vectors (radians, length at most pi) of rotation matrices, to full precision also
    near 0 and pi.

    At exactly pi either sign of the axis may come back. A matrix that is a rotation only to the
    digits of a file is replaced by a rotation near it. Raises ValueError: a determinant is not
    positive."""
    from scipy.spatial.transform import Rotation  # imported late: its import takes 0.05 s

    # SciPy takes no read-only arrays
    return Rotation.from_matrix(np.array(rotations, dtype=np.float64)).as_rotvec()


def are_rotations(matrices: Float[Array, "n 3 3"]) -> Bool[np.ndarray, " n"]:
    """Which matrices are rotations, but for the rounding in a file (`ROTATION_TOLERANCE`)."""
    matrices = np.asarray(matrices, dtype=np.float64)
    with np.errstate(over="ignore", invalid="ignore"):
        residual = np.abs(matrices @ matrices.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
        return (residual <= ROTATION_TOLERANCE) & (np.linalg.det(matrices) > 0)


def colmap_quaternions(vectors: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 4"]:
    """Unit quaternions xyzw of `diag(1, -1, -1) R(w)` for angle-axis vectors w: COLMAP's rotations
    of BAL's cameras."""
    from scipy.spatial.transform import Rotation

    return (Rotation.from_quat(_HALF_TURN_X) * Rotation.from_rotvec(np.array(vectors))).as_quat()


def bal_rotations(quaternions: Float[np.ndarray, "n 4"]) -> Float[np.ndarray, "n 3"]:
    """Angle-axis vectors, of length at most pi: the inverse of `colmap_quaternions`.

    The norm of a quaternion does not matter; where it is zero or not finite the vector is NaN."""
    from scipy.spatial.transform import Rotation

    norm = np.linalg.norm(quaternions, axis=1, keepdims=True)
    valid = np.isfinite(norm) & (norm > 0)
    rotations = Rotation.from_quat(_HALF_TURN_X) * Rotation.from_quat(
        np.where(valid, quaternions, _HALF_TURN_X)
    )
    return np.where(valid, rotations.as_rotvec(), np.nan)


def camera_centers(cameras: Float[Array, "cameras parameters"]) -> Float[np.ndarray, "cameras 3"]:
    """Positions of the cameras in the scene, `c = -R^T t`, in scene units."""
    cameras = np.asarray(cameras, dtype=np.float64)
    return -np.einsum("nji,nj->ni", rotation_matrices(cameras[:, :3]), cameras[:, 3:6])


def camera_poses(cameras: Float[Array, "cameras parameters"]) -> Float[np.ndarray, "cameras 3 4"]:
    """Camera-to-world poses `[R | c]` in COLMAP's and KITTI's axes: x to the right, y downwards, z
    forwards."""
    rotation = np.diag(COLMAP_FLIP) @ rotation_matrices(np.asarray(cameras)[:, :3])
    return np.concatenate(
        [rotation.transpose(0, 2, 1), camera_centers(cameras)[:, :, None]], axis=2
    )


def translations(
    rotations: Float[np.ndarray, "n 3 3"], centers: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 3"]:
    """Translations `t = -R c` of cameras with given rotations and centres."""
    return -np.einsum("nij,nj->ni", rotations, centers)


def perspective(local: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2"]:
    """Image plane coordinates `(X/Z, Y/Z)` of points in the frame of a camera, also behind it; not
    finite where Z is 0.

    BAL's camera looks down -z, so that its coordinates are the negative of these."""
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        return local[:, :2] / local[:, 2:]


def radial_distortion(
    square: np.ndarray | float, k1: np.ndarray | float, k2: np.ndarray | float
) -> np.ndarray | float:
    """Factor `1 + k1 r^2 + k2 r^4` at the squared radius r^2 in the image plane. Shapes
    broadcast."""
    return 1 + square * (k1 + square * k2)


def pixels(
    problem: BundleProblem, camera: Int[np.ndarray, " n"], local: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 2"]:
    """Pixels of points in cameras' frames, COLMAP's axes (x right, y down, z forwards), by the
    lenses' models."""
    numbers = np.asarray(problem.cameras, dtype=np.float64)[:, 6:][camera]
    lenses = problem.lenses
    models = (BAL,) if lenses is None else lenses.models
    own = [np.arange(len(camera))]
    result = np.empty((len(camera), 2))
    if lenses is not None and lenses.model is not None:
        model_of = np.asarray(lenses.model)[np.asarray(lenses.index)[camera]]
        own = [np.flatnonzero(model_of == number) for number in range(len(models))]
    for model, at in zip(models, own, strict=False):
        result[at] = np.stack(
            model.project(list(numbers[at, : len(model)].T), *local[at].T), axis=1
        )
    return result


def project(problem: BundleProblem) -> Float[np.ndarray, "observations 2"]:
    """Predicted pixels of every observation.

    Points behind a camera are projected by the same formula, as BAL does; depth zero is not
    finite."""
    predicted = np.empty((problem.num_observations, 2))
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
        for part, camera, local in _camera_frames(problem):
            predicted[part] = pixels(problem, camera, local * COLMAP_FLIP)
    return predicted


def depths(problem: BundleProblem) -> Float[np.ndarray, " observations"]:
    """Distance of every observed point along its camera's view, `-P.z` in scene units; positive in
    front."""
    result = np.empty(problem.num_observations)
    for part, _, local in _camera_frames(problem):
        result[part] = -local[:, 2]
    return result


def residuals(problem: BundleProblem) -> Float[np.ndarray, "observations 2"]:
    """`Sigma^(-1/2) (z_obs - z_pred)` of every observation; pixels where the problem has no
    whitening."""
    difference = np.asarray(problem.observations, dtype=np.float64) - project(problem)
    if problem.whitening is None:
        return difference
    return np.einsum("nij,nj->ni", np.asarray(problem.whitening, dtype=np.float64), difference)


def cost(problem: BundleProblem) -> float:
    """Half the sum of squared residuals, in pixels squared where the problem has no whitening."""
    r = residuals(problem).ravel()
    return 0.5 * float(r @ r)


def _camera_frames(problem: BundleProblem) -> Iterator[tuple[slice, np.ndarray, np.ndarray]]:
    """Observations in chunks: their slice, their cameras (n,), and their points in these frames `R
    X + t` (n, 3)."""
    cameras = np.asarray(problem.cameras, dtype=np.float64)
    points = np.asarray(problem.points, dtype=np.float64)
    camera_index = np.asarray(problem.camera_index)
    point_index = np.asarray(problem.point_index)
    rotation = rotation_matrices(cameras[:, :3])
    for start in range(0, problem.num_observations, CHUNK):
        part = slice(start, start + CHUNK)
        camera = camera_index[part]
        yield (
            part,
            camera,
            np.einsum("nij,nj->ni", rotation[camera], points[point_index[part]])
            + cameras[camera, 3:6],
        )
