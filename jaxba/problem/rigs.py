"""Rigs: cameras that move together.

A *frame* is what the cameras of a rig took at one moment. The pose of its camera c follows from
that of the frame r:

    R_c = M R_r,    t_c = M t_r + m,

with the rotation M and the translation m of the camera in the rig: its extrinsics. A solve works on
frames (problem/frames.py): a camera is `[pose of its frame, lens, angle-axis of M, m]`. Cameras of
a frame share its pose, and extrinsics are shared and free or constant as the numbers of a lens are.

Source: COLMAP 3.12 and later, `Rig` and `Frame`."""

from __future__ import annotations

from dataclasses import dataclass, replace

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxba.problem.checks import plain_array, real_numbers
from jaxba.problem.intrinsics import Lenses
from jaxba.typing import AnyArray, ArrayRecord, register_pytree

# numbers of the extrinsics of a camera: angle-axis (radians) of M and m (scene units)
EXTRINSICS_SIZE = 6

LARGEST_DISAGREEMENT = 1e-6
"""Of the rotations (radians) and relative translations of a frame's cameras, beyond which they are
no rig."""


@register_pytree
@dataclass(frozen=True, eq=False, repr=False)
class Rigs(ArrayRecord):
    """The frame of each camera of a problem, and its place in the rig.

    A solve then adds rotations on the manifold, without camera rounds and pattern moves, which part
    frames."""

    frame: Int[AnyArray, " cameras"]
    """Frame of each camera, int32."""

    rotation: Float[AnyArray, "cameras 3 3"]
    """M: from the rig to the camera (BAL's axes)."""

    translation: Float[AnyArray, "cameras 3"]
    """m, scene units."""

    free: Bool[AnyArray, " cameras"] | None = None
    """Whether M and m are optimised; None: of no camera. Cameras with the same lens then have the
    same, as those of a sensor in COLMAP. One camera of each rig should be constant: it says where
    the frame is."""

    def scaled(self, scale: float) -> Rigs:
        """The same for a scene that is `scale` times as large."""
        return replace(self, translation=scale * np.asarray(self.translation))

    def of(self, cameras: Int[np.ndarray, " kept"]) -> Rigs:
        """The same for a subset of the cameras; the numbering of frames is unchanged."""
        return jax.tree.map(lambda x: np.asarray(x)[cameras], self)

    @property
    def turned(self) -> Bool[np.ndarray, " cameras"]:
        """Whether the axes of a camera are not those of its frame, but for their signs."""
        diagonal = np.abs(np.diagonal(np.asarray(self.rotation), axis1=1, axis2=2)) > 1 - 1e-12
        return np.logical_not(diagonal.all(axis=1))


def checked_rigs(rigs: Rigs, cameras: np.ndarray, lenses: Lenses | None) -> Rigs:
    """Checks the rigs of cameras with checked lenses and returns them as NumPy arrays. Raises
    ValueError: shapes differ, cameras of a frame are not where their rig has them, or cameras of a
    lens with free extrinsics are in different places; one line."""
    frame = plain_array("frames of rigs", rigs.frame)
    rotation = real_numbers("rotations of rigs", rigs.rotation)
    translation = real_numbers("translations of rigs", rigs.translation)
    count = len(cameras)
    if (frame.shape, rotation.shape, translation.shape) != ((count,), (count, 3, 3), (count, 3)):
        raise ValueError(
            f"rigs must say of each of {count} cameras its frame and its place in the rig"
        )
    if frame.dtype.kind not in "iu":
        raise ValueError(f"frames of rigs must be integers, not {frame.dtype}")
    finite = np.logical_and.reduce(
        np.isfinite(np.hstack([rotation.reshape(-1, 9), translation])), axis=1
    )
    known = np.where(finite[:, None, None], rotation, 0.0)
    away = np.abs(known @ known.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2), initial=0.0)
    proper = finite & (away <= LARGEST_DISAGREEMENT) & (np.linalg.det(known) > 0)
    if not proper.all():
        raise ValueError(
            f"the place of camera {np.argmin(proper)} in its rig is no rotation and translation"
        )
    _, first, group = np.unique(frame, return_index=True, return_inverse=True)
    rig_rotation, rig_translation = frame_poses(rotation, translation, cameras)
    turned = np.abs(rig_rotation - rig_rotation[first][group]).max(axis=(1, 2), initial=0.0)
    size = (
        np.linalg.norm(cameras[:, 3:6], axis=1)
        + np.linalg.norm(translation, axis=1)
        + np.finfo(float).tiny
    )
    moved = np.linalg.norm(rig_translation - rig_translation[first][group], axis=1) / size
    bad = np.flatnonzero(np.maximum(turned, moved) > LARGEST_DISAGREEMENT)
    if bad.size:
        raise ValueError(
            f"cameras {first[group[bad[0]]]} and {bad[0]} of one frame are not where their rig has "
            "them"
        )
    free = _checked_free(rigs, rotation, translation, lenses)
    return Rigs(np.ascontiguousarray(frame, np.int32), rotation, translation, free)


def _checked_free(
    rigs: Rigs, rotation: np.ndarray, translation: np.ndarray, lenses: Lenses | None
) -> Bool[np.ndarray, " cameras"] | None:
    if rigs.free is None:
        return None
    free = plain_array("free extrinsics of rigs", rigs.free)
    if not free.any():
        return None
    if free.dtype != bool or free.shape != (len(rotation),):
        raise ValueError(
            f"rigs must say of each of {len(rotation)} cameras whether its extrinsics are free"
        )
    if lenses is None:
        raise ValueError(
            "free extrinsics of rigs need lenses, which say what images are of one camera"
        )
    _, first, group = np.unique(np.asarray(lenses.index), return_index=True, return_inverse=True)
    of_lens = np.hstack([rotation.reshape(-1, 9), translation, free[:, None]])
    bad = np.flatnonzero(
        (free | free[first][group]) & (of_lens != of_lens[first][group]).any(axis=1)
    )
    if bad.size:
        pair = f"{first[group[bad[0]]]} and {bad[0]}"
        raise ValueError(
            f"cameras {pair} share a lens, but are in different places of their rigs, which are "
            "free"
        )
    return free


def frame_poses(
    rotation: Float[np.ndarray, "cameras 3 3"],
    translation: Float[np.ndarray, "cameras 3"],
    cameras: Float[np.ndarray, "cameras parameters"],
) -> tuple[Float[np.ndarray, "cameras 3 3"], Float[np.ndarray, "cameras 3"]]:
    """R_r and t_r of the frame of each camera, from M and m of its place."""
    from scipy.spatial.transform import Rotation  # imported late: its import takes 0.05 s

    # SciPy takes no read-only arrays
    turned = Rotation.from_rotvec(np.array(cameras[:, :3])).as_matrix()
    return rotation.transpose(0, 2, 1) @ turned, np.einsum(
        "nji,nj->ni", rotation, cameras[:, 3:6] - translation
    )


def poses_in_frames(
    rotation: Float[np.ndarray, "n 3 3"],
    translation: Float[np.ndarray, "n 3"],
    of_frame: Float[np.ndarray, "n 3 3"],
    at: Float[np.ndarray, "n 3"],
) -> Float[np.ndarray, "n 6"]:
    """Poses of cameras, from M and m of their places, and R_r and t_r of their frames."""
    from scipy.spatial.transform import Rotation

    turned = Rotation.from_matrix(rotation @ of_frame).as_rotvec()
    return np.hstack([turned, np.einsum("nij,nj->ni", rotation, at) + translation])


def first_of_group(
    group: Int[np.ndarray, " cameras"], chosen: Int[np.ndarray, " chosen"]
) -> Int[np.ndarray, " cameras"]:
    """For each camera the first chosen one of its group; itself if there is none."""
    known, first = np.unique(group[chosen], return_index=True)
    at = np.isin(group, known)
    found = np.arange(len(group))
    found[at] = chosen[first[np.searchsorted(known, group[at])]]
    return found


def with_unseen_of_frames(
    rigs: Rigs, cameras: Float[np.ndarray, "cameras parameters"], seen: Int[np.ndarray, " seen"]
) -> Float[np.ndarray, "cameras parameters"]:
    """Cameras, with unobserved ones placed by their rig relative to the first observed camera of
    the frame."""
    of = first_of_group(np.asarray(rigs.frame), seen)
    unseen = np.setdiff1d(np.flatnonzero(of != np.arange(len(cameras))), seen)
    if not len(unseen):
        return cameras
    rotation = np.asarray(rigs.rotation)
    translation = np.asarray(rigs.translation)
    frames = frame_poses(rotation, translation, cameras)
    found = np.array(cameras)
    found[unseen, :6] = poses_in_frames(
        rotation[unseen], translation[unseen], *(x[of[unseen]] for x in frames)
    )
    return found
