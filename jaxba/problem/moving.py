"""A scene moved against what is measured and constant in it."""

from __future__ import annotations

import numpy as np

from jaxba.problem.bundle_problem import BundleProblem
from jaxba.problem.frames import in_frames
from jaxba.problem.intrinsics import POSE_SIZE
from jaxba.problem.similarity import Similarity, transformed


def moved(problem: BundleProblem, by: Similarity) -> BundleProblem:
    """The problem after a similarity; constants are copied exactly. Its residuals are not moved
    with it."""
    scene = transformed(problem, by)
    rigs = problem.rigs if has_size(problem) else scene.rigs
    scene = scene.replace(rigs=rigs, residuals=problem.residuals)
    constants = problem.constants
    if constants is None:
        return scene
    cameras = np.array(scene.cameras)
    held = np.asarray(constants.poses)
    cameras[:, :POSE_SIZE] = np.where(
        held, np.asarray(problem.cameras)[:, :POSE_SIZE], cameras[:, :POSE_SIZE]
    )
    points = np.where(np.asarray(constants.points)[:, None], problem.points, scene.points)
    return scene.replace(cameras=cameras, points=points)


def has_size(problem: BundleProblem) -> bool:
    """Whether a rig says how large the scene is: one with several cameras in a frame, of which one
    has a constant place away from the middle of the rig."""
    rigs = in_frames(problem).rigs
    if rigs is None:
        return False
    free = np.zeros(problem.num_cameras, bool) if rigs.free is None else np.asarray(rigs.free)
    return bool(np.asarray(rigs.translation)[~free].any())
