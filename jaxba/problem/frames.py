"""From cameras in rigs to frames, on which a solve works, and back (problem/rigs.py)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from jaxba.problem.bundle_problem import BundleProblem
from jaxba.problem.geometry import angle_axis
from jaxba.problem.hold import every_lens
from jaxba.problem.intrinsics import POSE_SIZE
from jaxba.problem.preprocess import observed
from jaxba.problem.rigs import EXTRINSICS_SIZE, Rigs, first_of_group, frame_poses, poses_in_frames


def in_frames(problem: BundleProblem) -> BundleProblem:
    """The problem with the poses of frames, and the extrinsics of each camera after its lens.

    Without rigs, or where no two observed cameras are of one frame, it is the problem itself,
    without rigs."""
    rigs = problem.rigs
    if rigs is None:
        return problem
    frame = np.asarray(rigs.frame)
    cameras = np.asarray(problem.cameras)
    seen = np.flatnonzero(observed(problem)[0])
    if len(np.unique(frame[seen])) == len(seen):
        held = problem.constants  # also by cameras of a frame that nothing sees
        held = held and replace(held, poses=~free_poses(problem)[:, :POSE_SIZE])
        return problem.replace(rigs=None, constants=held)
    rotation = np.asarray(rigs.rotation)
    translation = np.asarray(rigs.translation)
    of_frame, at = frame_poses(rotation, translation, cameras)
    poses = np.hstack([angle_axis(of_frame), at])
    poses = poses[first_of_group(frame, seen)]  # bit for bit the same in a frame
    extrinsics = np.hstack([angle_axis(rotation), translation])
    return problem.replace(cameras=np.hstack([poses, cameras[:, POSE_SIZE:], extrinsics]))


def free_poses(problem: BundleProblem) -> Bool[np.ndarray, "cameras numbers"]:
    """Which numbers of poses are optimised, and in rigs of extrinsics, of a problem `in_frames`.

    Constant numbers of one camera are constant in its frame, also of one that nothing sees. The
    extrinsics of a lens are constant where the pose of some camera of it is."""
    constants = problem.constants
    rigs = problem.rigs
    shape = problem.num_cameras, POSE_SIZE
    held = np.zeros(shape, bool) if constants is None else np.asarray(constants.poses)
    if rigs is None:
        return ~held
    places = np.zeros(shape, bool)
    if rigs.free is not None:
        assert problem.lenses is not None
        of_lens = _any_of_group(np.asarray(problem.lenses.index), held)
        of_lens = of_lens | of_lens[:, 3:].any(axis=1, keepdims=True)  # M turns t_r, too
        places = np.asarray(rigs.free)[:, None] & ~of_lens
    return np.hstack([~_any_of_group(np.asarray(rigs.frame), held), places])


def num_unknowns(problem: BundleProblem) -> int:
    """How many numbers of a problem are optimised: of poses, lenses, places in rigs, observed
    points and blocks of residuals, each once. Source: Ceres, `num_effective_parameters_reduced`."""
    here = in_frames(problem)
    (cameras, points) = observed(problem)
    free = free_poses(here)
    seen = np.flatnonzero(cameras)
    lenses = every_lens(problem)
    lens = np.asarray(lenses.index)
    frame = np.arange(len(free)) if here.rigs is None else np.asarray(here.rigs.frame)
    frames, images = (seen[np.unique(group[seen], return_index=True)[1]] for group in (frame, lens))
    points = points if problem.constants is None else points & ~np.asarray(problem.constants.points)
    blocks = sum(block.size for block in problem.residuals.blocks)
    of_cameras = (
        free[frames, :POSE_SIZE].sum()
        + free[images, POSE_SIZE:].sum()
        + lenses.free[lens[images]].sum()
    )
    return int(of_cameras + 3 * points.sum() + blocks)


def _any_of_group(
    group: np.ndarray, values: Bool[np.ndarray, "cameras 6"]
) -> Bool[np.ndarray, "cameras 6"]:
    """Whether a value is true of any camera of the same group."""
    _, own = np.unique(group, return_inverse=True)
    found = np.zeros(values.shape, bool)
    np.logical_or.at(found, own, values)
    return found[own]


def out_of_frames(
    problem: BundleProblem, cameras: Float[np.ndarray, "cameras more"]
) -> tuple[Float[np.ndarray, "cameras parameters"], Rigs]:
    """Cameras and rigs for cameras of a problem as `in_frames` has them. Constant extrinsics are
    copied exactly."""
    from scipy.spatial.transform import Rotation

    assert problem.rigs is not None

    def turns(vectors):
        return Rotation.from_rotvec(vectors).as_matrix()

    rigs = problem.rigs
    extrinsics = cameras[:, -EXTRINSICS_SIZE:]
    free = free_poses(problem)[:, POSE_SIZE:]
    rotation = np.where(free[:, :1, None], turns(extrinsics[:, :3]), rigs.rotation)
    translation = np.where(free[:, 3:], extrinsics[:, 3:], rigs.translation)
    poses = poses_in_frames(rotation, translation, turns(cameras[:, :3]), cameras[:, 3:6])
    own = cameras[:, POSE_SIZE:-EXTRINSICS_SIZE]
    return np.hstack([poses, own]), replace(rigs, rotation=rotation, translation=translation)
