"""Initial poses with errors that accumulate, as those of odometry do."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from jaxba.problem.bundle_problem import ProblemError


def drift(
    poses: Float[np.ndarray, "views 3 4"], rotation_sigma: float, translation_sigma: float, seed: int
) -> Float[np.ndarray, "views 3 4"]:
    """Poses with an independent error in every relative motion, so that the path drifts away from the true one.

    The motion from one view to the next, `(R, t)`, becomes `(exp(w) R, t + e)`: w has `rotation_sigma` on every
    component, e has `translation_sigma` times the length of t. Variances grow linearly with the number of motions.

    Args:
        poses: camera to world.
        rotation_sigma: degrees per motion.
        translation_sigma: relative to the length of the motion.
        seed: the same seed gives the same numbers.

    Raises:
        ProblemError: a sigma is negative or not finite.
    """
    for name, sigma in (("rotation-sigma", rotation_sigma), ("translation-sigma", translation_sigma)):
        if not (np.isfinite(sigma) and sigma >= 0):
            raise ProblemError(f"--{name} must not be negative, is {sigma}")
    random = np.random.default_rng(seed)
    count = max(len(poses) - 1, 0)
    turns = Rotation.from_rotvec(np.deg2rad(rotation_sigma) * random.standard_normal((count, 3))).as_matrix()
    errors = translation_sigma * random.standard_normal((count, 3))
    moved = poses.copy()
    for i in range(count):
        rotation = poses[i, :, :3].T @ poses[i + 1, :, :3]
        step = poses[i, :, :3].T @ (poses[i + 1, :, 3] - poses[i, :, 3])
        step = step + errors[i] * np.linalg.norm(step)
        moved[i + 1, :, :3] = moved[i, :, :3] @ turns[i] @ rotation
        moved[i + 1, :, 3] = moved[i, :, 3] + moved[i, :, :3] @ step
    return moved
