"""What of a problem is optimised: `hold` and `release` say it, `with_gauge` fixes position, orientation and scale.

What is constant comes back bit for bit.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from dataclasses import replace
from typing import Literal

import jax
import numpy as np
from jaxtyping import Bool, Int

from jaxba.problem import geometry
from jaxba.problem.bundle_problem import BundleProblem, ProblemError, ProblemWarning
from jaxba.problem.checks import shown
from jaxba.problem.constants import ROTATION, Constants, constants_of
from jaxba.problem.freedoms import SIMILARITY, fixed_freedoms
from jaxba.problem.intrinsics import LENS_SIZE, Lenses
from jaxba.problem.options import check_known
from jaxba.problem.preprocess import observed
from jaxba.problem.residuals import Residuals

Which = Literal["all"] | Iterable[int] | Iterable[str] | np.ndarray | jax.Array
"""Positions, names of images, a mask, or all of them."""

Gauge = Literal["free", "two-cameras", "three-points"]

GROUPS = ("focal", "principal_point", "distortion")
"""Groups of the numbers of a lens, as COLMAP's options name them."""


def hold(
    problem: BundleProblem,
    *,
    poses: Which = (),
    rotations: Which = (),
    points: Which = (),
    lenses: Which = (),
    numbers: Iterable[str] = (),
    extrinsics: Which = (),
) -> BundleProblem:
    """The problem with more of it constant. Raises ValueError: no such image, lens, point or number; one line.

    Args:
        problem: any problem.
        poses: images whose pose is constant.
        rotations: images whose rotation is constant; they still move.
        points: constant points.
        lenses: constant lenses: positions in `problem.lenses`, or of cameras where every camera has its own.
        numbers: what is constant in every lens: `focal`, `principal_point`, `distortion`, or the name of a number of a
            camera model such as `k2`.
        extrinsics: lenses whose place in their rig is constant; of no effect without rigs.
    """
    constants = constants_of(problem.constants, problem.num_cameras, problem.num_points)
    constants.poses[_mask(problem, poses, problem.num_cameras, "image")] = True
    constants.poses[np.ix_(_mask(problem, rotations, problem.num_cameras, "image"), ROTATION)] = True
    constants.points[_mask(problem, points, problem.num_points, "point")] = True
    changed = _with_constants(problem, constants)
    own = every_lens(problem)
    free = np.array(own.free)
    free[_mask(problem, lenses, len(free), "lens")] = False
    free &= ~number_columns(own, numbers)
    placed = _mask(problem, extrinsics, len(free), "lens")
    if problem.rigs is not None and problem.rigs.free is not None:
        moves = np.asarray(problem.rigs.free) & ~placed[np.asarray(own.index)]
        changed = changed.replace(rigs=replace(problem.rigs, free=moves if moves.any() else None))
    return changed if (free == own.free).all() else changed.replace(lenses=replace(own, free=free))


def release(problem: BundleProblem, *, numbers: Iterable[str]) -> BundleProblem:
    """The problem with numbers of all its lenses optimised. Arguments and errors as for `hold`.

    The principal point of a BAL lens is no number of it: read COLMAP models with `refine_principal_point=True`.
    """
    own = every_lens(problem)
    return problem.replace(lenses=replace(own, free=np.asarray(own.free) | number_columns(own, numbers)))


def with_gauge(problem: BundleProblem, gauge: Gauge) -> BundleProblem:
    """The problem with its position, orientation and scale fixed.

    A cost of pixels alone does not change when the whole scene is moved, turned and scaled. `two-cameras`: the pose of
    the observed camera that is nearest to the middle of all, and one number of the translation of the one that is
    farthest from it, are constant: the seven degrees of freedom of a similarity, and nothing else; where rigs or scale
    bars give the scene its scale, the first pose alone. `three-points`: three points that many images see and that are
    far apart are constant. `free`: no more than is. Nothing becomes constant, with a `ProblemWarning`, where constants
    and priors fix the seven already; there is one, too, where more becomes constant than is free. Source: COLMAP,
    `BundleAdjustmentGauge`.

    In a scene far from the origin (`preprocess.FAR`) the number of a translation is that of the scene shifted to it.
    Raises ValueError: no such gauge. Raises ProblemError: fewer than two cameras, or three points, are observed."""
    check_known("gauge", gauge, Gauge)
    if gauge == "free":
        return problem
    constants = constants_of(problem.constants, problem.num_cameras, problem.num_points)
    scaled = fixed_freedoms(problem.replace(constants=None, residuals=Residuals())) > 0  # by rigs alone
    if fixed_freedoms(problem) == SIMILARITY:
        note = f"the gauge {gauge} is not needed: constants and priors fix position, orientation and scale already"
        warnings.warn(note, ProblemWarning, stacklevel=2)
        return problem
    known = fixed_freedoms(problem.replace(constants=None))
    if scaled and gauge == "three-points":
        raise ProblemError("the rigs give the scene its scale: use the gauge of two cameras, which then holds one")
    if known and gauge == "two-cameras":
        seen, one = _placed(problem), constants_of(constants, problem.num_cameras, problem.num_points)
        one.poses[seen[np.argmin(_from_middle(geometry.camera_centers(problem.cameras)[seen]))]] = True
        if scaled or fixed_freedoms(problem.replace(constants=one)) == SIMILARITY:
            if known > 1:
                _warn_of_more_than_is_free(known)
            return _with_constants(problem, one)
    if known:
        _warn_of_more_than_is_free(known)
    if gauge == "two-cameras":
        _fix_two_cameras(problem, constants)
    else:
        _fix_three_points(problem, constants)
    return _with_constants(problem, constants)


def _warn_of_more_than_is_free(known: int) -> None:
    note = f"residuals fix {known} of {SIMILARITY} directions of the scene already: the gauge holds more than is free"
    warnings.warn(f"{note}; hold poses or points instead", ProblemWarning, stacklevel=3)


def _placed(problem: BundleProblem) -> Int[np.ndarray, " cameras"]:
    """The cameras with pixels or rows of residuals, without those whose place in their rig is optimised."""
    seen = np.flatnonzero(observed(problem)[0])
    if problem.rigs is None or problem.rigs.free is None:
        return seen
    return seen[~np.asarray(problem.rigs.free)[seen]]


def _from_middle(positions: np.ndarray) -> np.ndarray:
    """Distances from the middle of all."""
    return np.linalg.norm(positions - np.median(positions, axis=0), axis=1)


def _fix_two_cameras(problem: BundleProblem, constants: Constants) -> None:
    seen = _placed(problem)
    if problem.rigs is not None:  # of one frame only one, and with the axes of the frame if there are such
        seen = seen[np.unique(np.asarray(problem.rigs.frame)[seen], return_index=True)[1]]
    if len(seen) < 2:
        raise ProblemError("a gauge of two cameras needs two that see points")
    centers = geometry.camera_centers(problem.cameras)[seen]
    whole = constants.poses[seen].all(axis=1)  # a constant pose is the first, if there is one
    first = int(np.argmin(np.where(whole | ~whole.any(), _from_middle(centers), np.inf)))
    second = int(np.argmax(np.linalg.norm(centers - centers[first], axis=1)))
    constants.poses[seen[first]] = True
    # its distance from the first camera along the axis of its own on which that is largest
    rotation = geometry.rotation_matrices(np.asarray(problem.cameras)[seen[second : second + 1], :3])[0]
    axis = int(np.argmax(np.abs(rotation @ (centers[second] - centers[first]))))
    constants.poses[seen[second], 3 + axis] = True


def _fix_three_points(problem: BundleProblem, constants: Constants) -> None:
    tracks = np.bincount(problem.point_index, minlength=problem.num_points)
    seen = np.flatnonzero(tracks >= max(2, int(np.median(tracks[tracks > 0])) if tracks.any() else 0))
    if len(seen) < 3:
        raise ProblemError("a gauge of three points needs three that two images see")
    points = np.asarray(problem.points)[seen]
    away = lambda at: np.linalg.norm(points - points[at], axis=1)
    first = int(np.argmin(_from_middle(points)))
    # far, but not the farthest, which are the least certain
    second = int(np.argsort(away(first))[len(seen) * 3 // 4])
    line = (points[second] - points[first]) / max(away(first)[second], np.finfo(float).tiny)
    off_line = np.linalg.norm(np.cross(points - points[first], line), axis=1)
    off_line[[first, second]] = -1.0
    third = int(np.argsort(off_line)[max(2, len(seen) * 3 // 4)])
    constants.points[seen[[first, second, third]]] = True


def _with_constants(problem: BundleProblem, constants: Constants) -> BundleProblem:
    anything = constants.poses.any() or constants.points.any()
    return problem.replace(constants=constants if anything else None)


def every_lens(problem: BundleProblem) -> Lenses:
    """The lenses of a problem, also where every camera has its own BAL lens."""
    if problem.lenses is not None:
        return problem.lenses
    count = problem.num_cameras
    return Lenses(np.arange(count, dtype=np.int32), np.ones((count, LENS_SIZE), bool))


def _mask(problem: BundleProblem, which: Which, count: int, what: str) -> Bool[np.ndarray, " n"]:
    mask = np.zeros(count, bool)
    if isinstance(which, str) and which != "all":
        raise ValueError(f"which {what} must be 'all' or a list, not {which!r}")
    mask[slice(None) if isinstance(which, str) else positions_of(problem, which, what, count)] = True
    return mask


def positions_of(
    problem: BundleProblem, which: Iterable[int] | Iterable[str] | np.ndarray, what: str, count: int | None = None
) -> Int[np.ndarray, " n"]:
    """Positions of `image`, `point` or `lens`, from positions, a mask, or the names of images. `count` is how many
    there are; None: as images. Raises ValueError: it is none of these, or there are fewer; one line."""
    count = problem.num_cameras if count is None else count
    try:
        chosen = np.asarray(which if isinstance(which, np.ndarray | jax.Array) else list(which))
    except (TypeError, ValueError):  # no list, or a list of lists
        chosen = np.asarray(None)
    if chosen.ndim != 1:
        raise ValueError(f"which {what} must be a list of positions or names, not {shown(which)}")
    if chosen.dtype == bool:
        if chosen.shape != (count,):
            raise ValueError(f"a mask for every {what} has shape {(count,)}, not {chosen.shape}")
        return np.flatnonzero(chosen)
    if chosen.dtype.kind in "US":
        if problem.labels is None or what != "image":
            raise ValueError(f"this problem has no names for a {what}: give positions")
        return problem.labels.positions("image", chosen.tolist())
    if chosen.size and chosen.dtype.kind not in "iu":
        raise ValueError(f"each {what} is given by its position, not by {shown(chosen.tolist()[0])}")
    bad = chosen[(chosen < 0) | (chosen >= count)]
    if len(bad):
        raise ValueError(f"there is no {what} {bad[0]}: there are {count}")
    return chosen.astype(np.int64)


def number_columns(lenses: Lenses, numbers: Iterable[str]) -> Bool[np.ndarray, "lenses numbers"]:
    """The numbers of each lens that names or groups mean. Raises ValueError: no lens has such a number; one line."""
    free = np.asarray(lenses.free)
    meant = np.zeros(free.shape, bool)
    if not isinstance(numbers, Iterable):
        raise ValueError(f"numbers of a lens are given by a list of names, not {shown(numbers)}")
    for name in (numbers,) if isinstance(numbers, str) else numbers:
        of_models = [
            getattr(model, name)
            if name in GROUPS
            else tuple(k for k, parameter in enumerate(model.parameters) if parameter == name)
            for model in lenses.models
        ]
        if name not in GROUPS and not any(of_models):
            known = dict.fromkeys(parameter for model in lenses.models for parameter in model.parameters)
            raise ValueError(f"no lens has a number {shown(name)}; there are {', '.join([*GROUPS, *known])}")
        for number, columns in enumerate(of_models):
            own = np.zeros(len(free), int) == number if lenses.model is None else np.asarray(lenses.model) == number
            meant[np.ix_(own, columns)] = True
    return meant
