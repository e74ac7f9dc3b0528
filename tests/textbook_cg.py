"""Conjugate gradients as in a textbook, in NumPy, and small systems to try them on."""

from __future__ import annotations

import numpy as np

SIZE = 24


def spd(condition: float, seed: int = 0) -> np.ndarray:
    """A dense symmetric positive definite matrix with eigenvalues from 1 down to 1 / condition."""
    basis = np.linalg.qr(np.random.default_rng(seed).normal(size=(SIZE, SIZE)))[0]
    return basis * np.geomspace(1, 1 / condition, SIZE) @ basis.T


def right(seed: int = 1) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(SIZE // 3, 3))


def by_hand(matrix, b, inverse, count: int) -> list[np.ndarray]:
    """Iterates of textbook preconditioned conjugate gradients in NumPy."""
    x = np.zeros(b.size)
    r = b.reshape(-1).copy()
    p = z = inverse @ r
    found = []
    for _ in range(count):
        q = matrix @ p
        alpha = (r @ z) / (p @ q)
        x = x + alpha * p
        after = r - alpha * q
        found.append(x)
        z_after = inverse @ after
        p = z_after + (after @ z_after) / (r @ z) * p
        r = after
        z = z_after
    return found


PRECONDITIONERS = {
    "none": lambda a: np.eye(SIZE),
    "diagonal": lambda a: np.diag(1 / np.diag(a)),
    "blocks": lambda a: np.kron(np.eye(SIZE // 3), np.ones((3, 3))) * np.linalg.inv(a),
}
