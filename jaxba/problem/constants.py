"""What a solve leaves as it is: poses of cameras, whole or in part, and points."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool

from jaxba.problem.checks import plain_array
from jaxba.problem.intrinsics import POSE_SIZE
from jaxba.typing import AnyArray, ArrayRecord, register_pytree

# the numbers of a pose that are its rotation
ROTATION = np.array([True, True, True, False, False, False])


@register_pytree
@dataclass(frozen=True, eq=False, repr=False)
class Constants(ArrayRecord):
    """The numbers of poses and the points that are not optimised. They come back bit for bit."""

    poses: Bool[AnyArray, "cameras 6"]
    """Constant numbers of each pose: the rotation (all three or none), and each of the
    translation."""

    points: Bool[AnyArray, " points"]
    """Constant points."""

    def of(self, cameras: Any, points: Any) -> Constants:
        """The same for a subset of the cameras and points."""
        return Constants(np.asarray(self.poses)[cameras], np.asarray(self.points)[points])


def checked_constants(constants: Constants, cameras: int, points: int) -> Constants | None:
    """Checks constants and returns them as NumPy arrays; None if nothing is constant. Raises
    ValueError: shapes or types differ, or part of a rotation is constant; one line."""
    poses = plain_array("constant poses", constants.poses)
    fixed = plain_array("constant points", constants.points)
    for name, array, shape in (
        ("poses", poses, (cameras, POSE_SIZE)),
        ("points", fixed, (points,)),
    ):
        if array.dtype != bool or array.shape != shape:
            raise ValueError(
                f"constant {name} must be bool of shape {shape}, not {array.dtype}{array.shape}"
            )
    bad = np.flatnonzero(poses[:, :3].any(axis=1) != poses[:, :3].all(axis=1))
    if bad.size:
        raise ValueError(f"the rotation of camera {bad[0]} can only be constant as a whole")
    return Constants(poses, fixed) if poses.any() or fixed.any() else None


def constants_of(constants: Any, cameras: int, points: int) -> Constants:
    """The constants of a problem to be changed: copies, or new ones where nothing is constant."""
    if constants is None:
        return Constants(np.zeros((cameras, POSE_SIZE), bool), np.zeros(points, bool))
    return Constants(np.array(constants.poses), np.array(constants.points))
