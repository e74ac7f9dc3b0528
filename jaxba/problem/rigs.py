"""Rigs: cameras that move together.

A *frame* is what the cameras of a rig took at one moment. The pose of its camera c follows from that of the frame r:

    R_c = M R_r,    t_c = M t_r + m,

with the rotation M and the translation m of the camera in the rig, which are constant in a solve. A left perturbation w
of R_r and a change d of t_r are the perturbations M w and M d of the camera: the pose step of all cameras of a frame is
one unknown, seen through M.

Source: COLMAP 3.12 and later, `Rig` and `Frame`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from jaxba.typing import AnyArray, register_pytree

LARGEST_DISAGREEMENT = 1e-6
"""Of the rotations (radians) and relative translations of a frame's cameras, beyond which they are no rig."""


@register_pytree
@dataclass(frozen=True)
class Rigs:
    """The frame of each camera of a problem, and its place in the rig.

    A solve then adds rotations on the manifold, and makes no camera rounds and pattern moves, which would take cameras
    of a frame apart.
    """

    frame: Int[AnyArray, " cameras"]
    """Frame of each camera, int32. A camera alone in its frame has M = I and m = 0, whatever is said of it."""

    rotation: Float[AnyArray, "cameras 3 3"]
    """M: from the rig to the camera (BAL's axes)."""

    translation: Float[AnyArray, "cameras 3"]
    """m, scene units."""

    def scaled(self, scale: float) -> Rigs:
        """The same for a scene that is `scale` times as large."""
        return Rigs(self.frame, self.rotation, scale * np.asarray(self.translation))

    def of(self, cameras: Int[np.ndarray, " kept"]) -> Rigs:
        """The same for a subset of the cameras; the numbering of frames is unchanged."""
        return Rigs(*(np.asarray(part)[cameras] for part in (self.frame, self.rotation, self.translation)))


def checked_rigs(rigs: Rigs, cameras: np.ndarray) -> Rigs:
    """Checks rigs and returns them as NumPy arrays.

    Args:
        rigs: of a problem.
        cameras: its cameras.

    Raises:
        ValueError: shapes differ, or cameras of a frame are not where their rig has them; one line.
    """
    from scipy.spatial.transform import Rotation  # imported late: its import takes 0.05 s

    frame = np.asarray(rigs.frame)
    rotation, translation = np.asarray(rigs.rotation, np.float64), np.asarray(rigs.translation, np.float64)
    count = len(cameras)
    if (frame.shape, rotation.shape, translation.shape) != ((count,), (count, 3, 3), (count, 3)):
        raise ValueError(f"rigs must say of each of {count} cameras its frame and its place in the rig")
    rotations = Rotation.from_rotvec(cameras[:, :3]).as_matrix()
    _, first, group = np.unique(frame, return_index=True, return_inverse=True)
    rig_rotation = np.einsum("nji,njk->nik", rotation, rotations)
    rig_translation = np.einsum("nji,nj->ni", rotation, cameras[:, 3:6] - translation)
    turned = np.abs(rig_rotation - rig_rotation[first][group]).max(axis=(1, 2), initial=0.0)
    size = np.linalg.norm(cameras[:, 3:6], axis=1) + np.linalg.norm(translation, axis=1) + np.finfo(float).tiny
    moved = np.linalg.norm(rig_translation - rig_translation[first][group], axis=1) / size
    bad = np.flatnonzero(np.maximum(turned, moved) > LARGEST_DISAGREEMENT)
    if bad.size:
        raise ValueError(f"cameras {first[group[bad[0]]]} and {bad[0]} of one frame are not where their rig has them")
    return Rigs(np.ascontiguousarray(frame, np.int32), rotation, translation)


def with_unseen_of_frames(
    rigs: Rigs, cameras: Float[np.ndarray, "cameras parameters"], seen: Int[np.ndarray, " seen"]
) -> Float[np.ndarray, "cameras parameters"]:
    """Cameras, of which those that nothing sees are where their rig has them from the first seen one of their frame."""
    from scipy.spatial.transform import Rotation

    frame = np.asarray(rigs.frame)
    unseen = np.setdiff1d(np.arange(len(cameras)), seen)
    known, first = np.unique(frame[seen], return_index=True)
    unseen = unseen[np.isin(frame[unseen], known)]
    if not len(unseen):
        return cameras
    of = seen[first[np.searchsorted(known, frame[unseen])]]
    rotation, translation = np.asarray(rigs.rotation), np.asarray(rigs.translation)
    found = np.array(cameras)
    back = np.einsum("nij,nkj->nik", rotation[unseen], rotation[of])  # M_unseen M_seen^T
    found[unseen, :3] = Rotation.from_matrix(back @ Rotation.from_rotvec(cameras[of, :3]).as_matrix()).as_rotvec()
    found[unseen, 3:6] = np.einsum("nij,nj->ni", back, cameras[of, 3:6] - translation[of]) + translation[unseen]
    return found
