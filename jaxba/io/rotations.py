"""Rotations of camera files, in NumPy: matrices to angle-axis vectors, and turning vectors by these."""

from __future__ import annotations

import numpy as np


def angle_axis_from_matrix(matrices: np.ndarray) -> np.ndarray:
    """Angle-axis vectors (radians, length at most pi) of rotation matrices; accurate at 0 and at pi.

    Goes through the quaternion whose largest component is found without cancellation.
    Source: Shepperd 1978, "Quaternion from rotation matrix".

    Args:
        matrices: shape (n, 3, 3), orthonormal up to rounding, determinant 1.

    Returns:
        Shape (n, 3).
    """
    m = np.moveaxis(matrices, 0, -1)
    x, y, z = m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]
    xy, xz, yz = m[1, 0] + m[0, 1], m[0, 2] + m[2, 0], m[2, 1] + m[1, 2]
    a, b, c = m[0, 0], m[1, 1], m[2, 2]
    # Row i is the quaternion (w, x, y, z) times 4 times its component i.
    candidates = np.array(
        [
            [1 + a + b + c, x, y, z],
            [x, 1 + a - b - c, xy, xz],
            [y, xy, 1 - a + b - c, yz],
            [z, xz, yz, 1 - a - b + c],
        ]
    )
    best = np.argmax(np.einsum("iin->in", candidates), axis=0)
    quaternion = candidates[best, :, np.arange(len(matrices))]
    quaternion /= np.linalg.norm(quaternion, axis=1, keepdims=True)
    quaternion *= np.where(quaternion[:, :1] < 0, -1.0, 1.0)
    sine = np.linalg.norm(quaternion[:, 1:], axis=1)
    angle = 2 * np.arctan2(sine, quaternion[:, 0])
    factor = np.divide(angle, sine, out=np.full_like(sine, 2.0), where=sine > 0)
    return quaternion[:, 1:] * factor[:, None]


def rotate(angle_axis: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Each vector, shape (n, 3), turned by its angle-axis vector (radians), shape (n, 3): Rodrigues' formula."""
    angle = np.linalg.norm(angle_axis, axis=1, keepdims=True)
    once = np.cross(angle_axis, vectors)
    twice = np.cross(angle_axis, once)
    # numpy.sinc(x) is sin(pi x) / (pi x): no case for small angles is needed.
    return vectors + np.sinc(angle / np.pi) * once + 0.5 * np.sinc(angle / (2 * np.pi)) ** 2 * twice
