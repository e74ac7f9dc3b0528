"""A gauge: constants that fix the position, orientation and scale of a scene, as far as they are free.

A cost of pixels alone does not change when the whole scene is moved, turned and scaled. The gauge of two cameras makes
as many numbers constant as directions are free, where that is possible, and so leaves the minimum where it is. Three
points are nine numbers for seven directions.

Source: COLMAP, `FixGaugeWithTwoCamsFromWorld`, `FixGaugeWithThreePoints`.
"""

from __future__ import annotations

import warnings
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float

from jaxba.problem import geometry
from jaxba.problem.bundle_problem import BundleProblem, ProblemError, ProblemWarning
from jaxba.problem.constants import Constants, constants_of
from jaxba.problem.frames import free_poses, in_frames
from jaxba.problem.freedoms import SIMILARITY, fixed_freedoms, free_steps
from jaxba.problem.hold import with_constants
from jaxba.problem.intrinsics import POSE_SIZE
from jaxba.problem.options import check_known
from jaxba.problem.preprocess import observed

Gauge = Literal["free", "two-cameras", "three-points"]

LEVER = 1e-6
"""Smallest step of a number (radians, extents of the scene) by which it fixes a direction."""

SURPLUS = 2
"""Numbers of three points beyond the seven directions of a similarity."""


def with_gauge(problem: BundleProblem, gauge: Gauge) -> BundleProblem:
    """The problem with its position, orientation and scale fixed.

    What constants, rigs, priors and other residuals fix already counts. `two-cameras`: of the pose of the camera that
    is nearest to the middle of all, or of one that is constant, and of the translation of the camera farthest from it,
    as many numbers are constant as there are free directions: seven, and a free minimum stays one. Where these do not
    suffice, as in a single frame of a rig, three points are. `three-points`: up to three points that many images see
    and that are far apart are constant; three are two numbers more than are free, so the minimum is higher. `free`: no
    more than is. A `ProblemWarning` says that all is fixed already, that points replace cameras, or that more becomes
    constant than that.

    In a scene far from the origin (`preprocess.FAR`) the numbers of a translation are those of the scene shifted to it.
    Raises ValueError: no such gauge. Raises ProblemError: too few points are observed."""
    check_known("gauge", gauge, Gauge)
    if gauge == "free":
        return problem
    steps = free_steps(problem)
    free = steps.shape[2]
    if not free:
        _note(f"the gauge {gauge} is not needed: constants and priors fix position, orientation and scale already")
        return problem
    found = _two_cameras(problem, steps) if gauge == "two-cameras" else None
    if gauge == "two-cameras" and found is None:
        _note("two cameras cannot fix position, orientation and scale: the gauge holds three points")
    surplus = SURPLUS if found is None else 0
    found = _three_points(problem) if found is None else found
    held = _count(found) - _count(constants_of(problem.constants, problem.num_cameras, problem.num_points))
    if held > free + surplus:
        known = f"{SIMILARITY - free} of {SIMILARITY} directions of the scene are fixed already"
        _note(f"{known}: the gauge holds more than is free, {held} numbers; hold poses or points instead")
    return with_constants(problem, found)


def _note(text: str) -> None:
    warnings.warn(text, ProblemWarning, stacklevel=3)


def _count(constants: Constants) -> int:
    return int(constants.poses.sum() + 3 * constants.points.sum())


def _two_cameras(problem: BundleProblem, steps: Float[np.ndarray, "cameras 6 directions"]) -> Constants | None:
    """The constants, with numbers of two cameras that fix all directions; None if there are none."""
    here, constants = in_frames(problem), constants_of(problem.constants, problem.num_cameras, problem.num_points)
    free = free_poses(here)
    seen = np.flatnonzero(observed(problem)[0] & ~free[:, POSE_SIZE:].any(axis=1))  # whose place in a rig is constant
    turned = np.zeros(len(free), bool)
    if here.rigs is not None:  # of one frame only one, and with the axes of the frame if there are such
        turned = here.rigs.turned
        seen = seen[np.argsort(turned[seen], kind="stable")]
        seen = seen[np.unique(np.asarray(here.rigs.frame)[seen], return_index=True)[1]]
    if not len(seen):
        return None
    centers = geometry.camera_centers(problem.cameras)[seen]
    whole = ~free[seen, :POSE_SIZE].any(axis=1)  # a constant pose is the first, if there is one
    first = int(np.argmin(np.where(whole | ~whole.any(), _from_middle(centers), np.inf)))
    second = int(np.argmax(np.where(turned[seen], -1.0, np.linalg.norm(centers - centers[first], axis=1))))
    left = np.eye(steps.shape[2])
    chosen, left = _fixing(steps[seen[first], :3], left, whole=True)
    constants.poses[seen[first], :3] |= chosen
    for at in dict.fromkeys((first, second)):
        chosen, left = _fixing(steps[seen[at], 3:], left, whole=bool(turned[seen[at]]))
        constants.poses[seen[at], 3:] |= chosen
    if left.shape[1]:  # directions that turn the camera, of which others are fixed
        _, values, basis = np.linalg.svd(steps[seen[first], :3] @ left)
        constants.poses[seen[first], :3] = True
        left = left @ basis[np.sum(values > LEVER) :].T
    return None if left.shape[1] else constants


def _fixing(
    rows: Float[np.ndarray, "numbers directions"], left: Float[np.ndarray, "directions free"], *, whole: bool
) -> tuple[Bool[np.ndarray, " numbers"], Float[np.ndarray, "directions left"]]:
    """Which numbers to hold, each of which fixes one of the directions that are free, one by one or as a `whole`; and a
    basis of those that are then left. `rows` are the steps of the numbers along all directions."""
    chosen = np.zeros(len(rows), bool)
    while left.shape[1] >= (len(rows) if whole else 1):
        along = rows @ left
        some = whole | (np.arange(len(rows)) == np.argmax(np.linalg.norm(along, axis=1)))
        _, values, basis = np.linalg.svd(along[some])
        if values.min() <= LEVER:
            break
        chosen, left = chosen | some, left @ basis[len(values) :].T
    return chosen, left


def _from_middle(positions: np.ndarray) -> np.ndarray:
    """Distances from the middle of all."""
    return np.linalg.norm(positions - np.median(positions, axis=0), axis=1)


def _three_points(problem: BundleProblem) -> Constants:
    """The constants, with points that fix all directions, three at most. Raises ProblemError: there are too few."""
    constants = constants_of(problem.constants, problem.num_cameras, problem.num_points)
    tracks, points = np.bincount(problem.point_index, minlength=problem.num_points), np.asarray(problem.points)
    often = tracks >= max(2, int(np.median(tracks[tracks > 0])) if tracks.any() else 0)
    held = np.flatnonzero(constants.points & (tracks > 0)).tolist()
    for _ in range(3):
        if fixed_freedoms(with_constants(problem, constants)) == SIMILARITY:
            break
        seen = np.flatnonzero(often & ~constants.points)
        if not len(seen):
            raise ProblemError("a gauge of three points needs three that two images see")
        away = points[seen] - points[held[0]] if held else points[seen] - np.median(points[seen], axis=0)
        if len(held) > 1:  # from their line
            line = points[held[1]] - points[held[0]]
            away = np.cross(away, line / max(float(np.linalg.norm(line)), np.finfo(float).tiny))
        # far from those that are held, but not the farthest, which are the least certain
        nearest = np.argsort(np.linalg.norm(away, axis=1))
        held.append(int(seen[nearest[len(seen) * 3 // 4 if held else 0]]))
        constants.points[held[-1]] = True
    return constants
