"""A gauge: constants that fix the position, orientation and scale of a scene, as far as they are
free."""

from __future__ import annotations

import functools
import warnings
from typing import Literal

import numpy as np
from jaxtyping import Float

from jaxba.problem.bundle_problem import BundleProblem, ProblemError, ProblemWarning
from jaxba.problem.constants import Constants, constants_of
from jaxba.problem.frames import free_poses, in_frames
from jaxba.problem.freedoms import SIMILARITY, fixed_freedoms, freedoms
from jaxba.problem.geometry import camera_centers
from jaxba.problem.intrinsics import POSE_SIZE
from jaxba.problem.options import check_known
from jaxba.problem.preprocess import far_middle, observed, shift

Gauge = Literal["free", "two-cameras", "three-points"]

# smallest step of a number (radians, extents of the scene) by which it fixes a direction
LEVER = 1e-6


def with_gauge(problem: BundleProblem, gauge: Gauge) -> BundleProblem:
    """The problem with its position, orientation and scale fixed, as far as constants, rigs and
    residuals leave them.

    `two-cameras`: as many numbers are constant as directions are free, so the minimum stays as it
    is. They are of the pose of a constant camera, or of the one nearest to the middle, and of the
    translation of the one farthest from it. Where these do not suffice, as in a single frame of a
    rig, three points are. `three-points`: up to three points that many images see and that are far
    apart are constant; three are two numbers more than are free. `free`: no more than is. A
    `ProblemWarning` says that all is fixed already, that points stand for cameras, or that still
    more is held.

    In a scene far from the origin (`preprocess.FAR`) the numbers of a translation are those of the
    scene shifted to it. Raises ValueError: no such gauge. Raises ProblemError: too few points are
    observed. Source: COLMAP, `FixGaugeWithTwoCamsFromWorld`, `FixGaugeWithThreePoints`."""
    check_known("gauge", gauge, Gauge)
    gauged = fixed_gauge(problem, gauge)
    if gauged is problem and gauge != "free":
        fixed = "constants and priors fix position, orientation and scale already"
        warnings.warn(f"the gauge {gauge} is not needed: {fixed}", ProblemWarning, stacklevel=2)
    return gauged


def fixed_gauge(problem: BundleProblem, gauge: Gauge) -> BundleProblem:
    """`with_gauge`, silent where nothing is left to fix: then the problem itself comes back."""
    if gauge == "free":
        return problem
    note = functools.partial(warnings.warn, category=ProblemWarning, stacklevel=3)
    directions, steps, *_ = freedoms(shift(problem, -far_middle(problem)))
    free = directions.shape[1]
    if not free:
        return problem
    usual = free
    found = (
        _two_cameras(problem, steps[:, :POSE_SIZE] @ directions) if gauge == "two-cameras" else None
    )
    if found is None:
        if gauge == "two-cameras":
            note(
                "two cameras cannot fix position, orientation and scale: the gauge holds three "
                "points"
            )
        usual = free + 2
        found = _three_points(problem)
    held = _held_numbers(found) - _held_numbers(problem.constants)
    if held > usual:
        known = f"{SIMILARITY - free} of {SIMILARITY} directions of the scene are fixed already"
        note(
            f"{known}: the gauge holds more than is free, {held} numbers; hold poses or points "
            "instead"
        )
    return problem.replace(constants=found)


def _held_numbers(constants: Constants | None) -> int:
    """How many numbers of poses and points are constant."""
    return 0 if constants is None else int(constants.poses.sum() + 3 * constants.points.sum())


def _two_cameras(
    problem: BundleProblem, steps: Float[np.ndarray, "cameras 6 directions"]
) -> Constants | None:
    """The constants, with numbers of two cameras that fix all directions; None if there are none.
    `steps` are those of poses along the directions, radians and extents of the scene, zero for what
    is constant."""
    here = in_frames(problem)
    constants = constants_of(problem.constants, problem.num_cameras, problem.num_points)
    free = free_poses(here)
    turned = np.zeros(problem.num_cameras, bool)
    # whose place in a rig is constant
    seen = np.flatnonzero(observed(problem)[0] & ~free[:, POSE_SIZE:].any(axis=1))
    # of one frame only one, and with the axes of the frame if there are such
    if here.rigs is not None:
        turned = here.rigs.turned
        seen = seen[np.argsort(turned[seen], kind="stable")]
        seen = seen[np.unique(np.asarray(here.rigs.frame)[seen], return_index=True)[1]]
    if not len(seen):
        return None
    centers = camera_centers(problem.cameras)[seen]

    def away(x):
        return np.linalg.norm(centers - x, axis=1)

    whole = ~free[seen, :POSE_SIZE].any(axis=1)  # a constant pose is the first, if there is one
    first = int(np.argmin(np.where(whole | ~whole.any(), away(np.median(centers, axis=0)), np.inf)))
    second = int(np.argmax(np.where(turned[seen], -1.0, away(centers[first]))))
    left = np.eye(steps.shape[2])  # the directions that are free
    # numbers, or the one of the translation that fixes most; how many it has to fix
    blocks = [(first, [0, 1, 2], 3)]
    for at in (first, second):
        blocks += [(at, [3, 4, 5], 3)] if turned[seen[at]] else 3 * [(at, None, 1)]
    for at, block, least in (*blocks, (first, [0, 1, 2], 1)):
        along = steps[seen[at]] @ left
        held = [3 + int(np.argmax(np.linalg.norm(along[3:], axis=1)))] if block is None else block
        _, values, basis = np.linalg.svd(along[held])
        if (fixed := int(np.sum(values > LEVER))) >= least:
            constants.poses[seen[at], held] = True
            left = left @ basis[fixed:].T
    return None if left.shape[1] else constants


def _three_points(problem: BundleProblem) -> Constants:
    """The constants, with points that fix all directions, three at most. Raises ProblemError: there
    are too few."""
    constants = constants_of(problem.constants, problem.num_cameras, problem.num_points)
    tracks = np.bincount(problem.point_index, minlength=problem.num_points)
    points = np.asarray(problem.points)
    often = tracks >= max(2, int(np.median(tracks[tracks > 0])) if tracks.any() else 0)
    held = np.flatnonzero(constants.points & (tracks > 0)).tolist()
    for _ in range(3):
        if fixed_freedoms(problem.replace(constants=constants)) == SIMILARITY:
            break
        seen = np.flatnonzero(often & ~constants.points)
        if not len(seen):
            raise ProblemError("a gauge of three points needs three that two images see")
        away = points[seen] - (points[held[0]] if held else np.median(points[seen], axis=0))
        if len(held) > 1:  # from their line, times its length
            away = np.cross(away, points[held[1]] - points[held[0]])
        # far from those that are held, but not the farthest, which are the least certain
        nearest = np.argsort(np.linalg.norm(away, axis=1))
        held.append(int(seen[nearest[len(seen) * 3 // 4 if held else 0]]))
        constants.points[held[-1]] = True
    return constants
