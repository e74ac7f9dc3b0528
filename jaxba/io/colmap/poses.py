"""Poses of a COLMAP model.

COLMAP's camera looks down +z with y downwards, BAL's down -z with y upwards: poses of a problem are
BAL's."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from jaxba.problem.geometry import COLMAP_FLIP, bal_rotations, colmap_quaternions

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

# transform from the world (of a sensor: its rig): quaternion wxyz of any norm, translation
Pose = tuple[float, ...]
# from the order of `jaxba.problem.geometry` to COLMAP's, and back
_WXYZ = [3, 0, 1, 2]
_XYZW = [1, 2, 3, 0]
_LARGEST_EXPONENT = 500  # squares of larger numbers overflow float64, whose exponents end at 1023
_SAME = 1e-6  # poses that differ by less, relatively, are the same


def quaternions(poses: Sequence[Pose]) -> Float[np.ndarray, "n 4"]:
    """Quaternions xyzw of poses, scaled by a power of two where their norm could over- or
    underflow."""
    found = np.array(poses).reshape(-1, 7)[:, _XYZW]
    _, exponents = np.frexp(np.abs(found).max(axis=1, initial=0.0, keepdims=True))
    return np.ldexp(found, np.where(np.abs(exponents) > _LARGEST_EXPONENT, -exponents, 0))


def translations(poses: Sequence[Pose]) -> Float[np.ndarray, "n 3"]:
    """Translations of poses."""
    return np.array(poses).reshape(-1, 7)[:, 4:]


def rotations(poses: Sequence[Pose]) -> Rotation:
    """Rotations of poses."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_quat(quaternions(poses))


def bal_poses(poses: Sequence[Pose]) -> Float[np.ndarray, "n 6"]:
    """Poses as those of BAL's cameras."""
    return np.hstack([bal_rotations(quaternions(poses)), translations(poses) * COLMAP_FLIP])


def colmap_poses(cameras: Float[np.ndarray, "n numbers"]) -> list[Pose]:
    """COLMAP's poses of BAL's, the first six numbers of cameras."""
    turns = colmap_quaternions(cameras[:, :3])[:, _WXYZ]
    return list(map(tuple, np.hstack([turns, cameras[:, 3:6] * COLMAP_FLIP]).tolist()))


def composed(outer: Pose | None, inner: Pose) -> Pose:
    """The transform `outer` after `inner`; exactly the inner one for None."""
    if outer is None:
        return inner
    first = rotations([inner])[0]
    second = rotations([outer])[0]
    moved = second.apply(inner[4:]) + np.array(outer[4:])
    return *(second * first).as_quat()[_WXYZ].tolist(), *moved.tolist()


def inverse(pose: Pose) -> Pose:
    """The inverse transform."""
    back = rotations([pose])[0].inv()
    return *back.as_quat()[_WXYZ].tolist(), *(-back.apply(pose[4:])).tolist()


def differ(one: Pose, other: Pose) -> bool:
    """Whether two poses are not the same to the digits of a file."""
    if one == other:
        return False
    first, second = quaternions([one, other])
    parallel = abs(first @ second) >= (1 - _SAME) * np.linalg.norm(first) * np.linalg.norm(second)
    return not (parallel and np.allclose(one[4:], other[4:], rtol=_SAME, atol=_SAME))
