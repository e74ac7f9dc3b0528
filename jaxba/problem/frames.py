"""From cameras in rigs to frames, on which a solve works, and back (problem/rigs.py)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from jaxba.problem.bundle_problem import BundleProblem
from jaxba.problem.intrinsics import POSE_SIZE
from jaxba.problem.rigs import EXTRINSICS_SIZE, Rigs


def in_frames(problem: BundleProblem) -> BundleProblem:
    """The problem with the poses of frames, and the extrinsics of each camera after its lens.

    Without rigs, or where no two observed cameras are of one frame, it is the problem itself, without rigs.
    """
    rigs = problem.rigs
    if rigs is None:
        return problem
    from scipy.spatial.transform import Rotation  # imported late: its import takes 0.05 s

    frame, cameras = np.asarray(rigs.frame), np.asarray(problem.cameras)
    seen = np.unique(problem.camera_index)
    if len(np.unique(frame[seen])) == len(seen):
        return problem.replace(rigs=None)
    rotation, translation = np.asarray(rigs.rotation), np.asarray(rigs.translation)
    moved = cameras[:, 3:6] - translation
    of_frame = rotation.transpose(0, 2, 1) @ Rotation.from_rotvec(cameras[:, :3]).as_matrix()
    poses = np.hstack([Rotation.from_matrix(of_frame).as_rotvec(), np.einsum("nji,nj->ni", rotation, moved)])
    known, first = np.unique(frame[seen], return_index=True)
    at, leader = np.isin(frame, known), np.arange(len(frame))
    leader[at] = seen[first[np.searchsorted(known, frame[at])]]
    poses = poses[leader]  # bit for bit the same in a frame
    extrinsics = np.hstack([Rotation.from_matrix(rotation).as_rotvec(), translation])
    return problem.replace(cameras=np.hstack([poses, cameras[:, POSE_SIZE:], extrinsics]))


def out_of_frames(
    problem: BundleProblem, cameras: Float[np.ndarray, "cameras more"]
) -> tuple[Float[np.ndarray, "cameras parameters"], Rigs]:
    """Cameras and rigs for cameras of a problem as `in_frames` has them. Constant extrinsics are copied exactly."""
    from scipy.spatial.transform import Rotation

    assert problem.rigs is not None
    rigs, extrinsics = problem.rigs, cameras[:, -EXTRINSICS_SIZE:]
    free = np.zeros(len(cameras), bool) if rigs.free is None else np.asarray(rigs.free)
    rotation = np.where(free[:, None, None], Rotation.from_rotvec(extrinsics[:, :3]).as_matrix(), rigs.rotation)
    translation = np.where(free[:, None], extrinsics[:, 3:], rigs.translation)
    turned = rotation @ Rotation.from_rotvec(cameras[:, :3]).as_matrix()
    moved = np.einsum("nij,nj->ni", rotation, cameras[:, 3:6]) + translation
    own = cameras[:, POSE_SIZE:-EXTRINSICS_SIZE]
    cameras = np.hstack([Rotation.from_matrix(turned).as_rotvec(), moved, own])
    return cameras, replace(rigs, rotation=rotation, translation=translation)
