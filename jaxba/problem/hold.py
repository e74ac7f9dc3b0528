"""What of a problem is optimised: `hold` and `release` say it.

What is constant comes back bit for bit."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Literal

import jax
import numpy as np
from jaxtyping import Bool, Int

from jaxba.problem.bundle_problem import BundleProblem
from jaxba.problem.checks import shown
from jaxba.problem.constants import ROTATION, constants_of
from jaxba.problem.intrinsics import LENS_SIZE, Lenses
from jaxba.problem.labels import part_name

Which = Literal["all"] | Iterable[int] | Iterable[str] | np.ndarray | jax.Array
"""Positions, names of images, a mask, or all of them."""

# groups of the numbers of a lens, as COLMAP's options name them
GROUPS = ("focal", "principal_point", "distortion")


def hold(
    problem: BundleProblem,
    *,
    poses: Which | Literal["frames"] = (),
    rotations: Which | Literal["frames"] = (),
    points: Which = (),
    lenses: Which = (),
    numbers: Iterable[str] = (),
    extrinsics: Which = (),
) -> BundleProblem:
    """The problem with more of it constant. Raises ValueError: no such image, lens, point or
    number, or `frames` of which one has no image of a camera with a constant place in its rig; one
    line.

    Args:
        problem: any problem.
        poses: images whose pose is constant; `frames`: of all frames of rigs, in which cameras
            still move (COLMAP's `refine_rig_from_world=False`).
        rotations: images whose rotation is constant; they still move. `frames` as for poses.
        points: constant points.
        lenses: constant lenses: positions in `problem.lenses`, or of cameras where every camera has
            its own.
        numbers: what is constant in every lens: `focal`, `principal_point`, `distortion`, or the
            name of a number of a camera model such as `k2`.
        extrinsics: lenses whose place in their rig is constant; of no effect without rigs."""
    constants = constants_of(problem.constants, problem.num_cameras, problem.num_points)
    constants.poses[_images(problem, poses)] = True
    constants.poses[np.ix_(_images(problem, rotations), ROTATION)] = True
    constants.points[mask_of(problem, points, problem.num_points, "point")] = True
    anything = constants.poses.any() or constants.points.any()
    changed = problem.replace(constants=constants if anything else None)
    own = every_lens(problem)
    free = np.array(own.free)
    free[mask_of(problem, lenses, len(free), "lens")] = False
    free &= ~number_columns(own, numbers)
    placed = mask_of(problem, extrinsics, len(free), "lens")
    if problem.rigs is not None and problem.rigs.free is not None:
        moves = np.asarray(problem.rigs.free) & ~placed[np.asarray(own.index)]
        changed = changed.replace(rigs=replace(problem.rigs, free=moves if moves.any() else None))
    return changed if (free == own.free).all() else changed.replace(lenses=replace(own, free=free))


def release(problem: BundleProblem, *, numbers: Iterable[str]) -> BundleProblem:
    """The problem with numbers of all its lenses optimised. Arguments and errors as for `hold`.

    The principal point of a BAL lens is no number of it: read COLMAP models with
    `refine_principal_point=True`."""
    own = every_lens(problem)
    return problem.replace(
        lenses=replace(own, free=np.asarray(own.free) | number_columns(own, numbers))
    )


def every_lens(problem: BundleProblem) -> Lenses:
    """The lenses of a problem, also where every camera has its own BAL lens."""
    if problem.lenses is not None:
        return problem.lenses
    count = problem.num_cameras
    return Lenses(np.arange(count, dtype=np.int32), np.ones((count, LENS_SIZE), bool))


def _images(
    problem: BundleProblem, which: Which | Literal["frames"]
) -> Bool[np.ndarray, " cameras"]:
    """A mask of images; of `frames` those whose camera has a constant place in its rig."""
    if not isinstance(which, str) or which != "frames":
        return mask_of(problem, which, problem.num_cameras, "image")
    rigs = problem.rigs
    if rigs is None or rigs.free is None:
        return np.ones(problem.num_cameras, bool)
    known = ~np.asarray(rigs.free)
    frame = np.asarray(rigs.frame)
    lost = np.flatnonzero(~np.isin(frame, frame[known]))
    if len(lost):
        name = part_name(problem.labels, "image", int(lost[0]))
        raise ValueError(
            f"the frame of {name} has no image of a camera with a constant place in its rig"
        )
    return known


def mask_of(problem: BundleProblem, which: Which, count: int, what: str) -> Bool[np.ndarray, " n"]:
    """Which of `count` images, points or lenses are meant. Raises ValueError as `positions_of`."""
    mask = np.zeros(count, bool)
    if isinstance(which, str) and which != "all":
        raise ValueError(f"which {what} must be 'all' or a list, not {which!r}")
    mask[slice(None) if isinstance(which, str) else positions_of(problem, which, what, count)] = (
        True
    )
    return mask


def positions_of(
    problem: BundleProblem,
    which: Iterable[int] | Iterable[str] | np.ndarray,
    what: str,
    count: int | None = None,
) -> Int[np.ndarray, " n"]:
    """Positions of `image`, `point` or `lens`, from positions, a mask, or the names of images.
    `count` is how many there are; None: as images. Raises ValueError: it is none of these, or there
    are fewer; one line."""
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
        raise ValueError(
            f"each {what} is given by its position, not by {shown(chosen.tolist()[0])}"
        )
    bad = chosen[(chosen < 0) | (chosen >= count)]
    if len(bad):
        raise ValueError(f"there is no {what} {bad[0]}: there are {count}")
    return chosen.astype(np.int64)


def number_columns(lenses: Lenses, numbers: Iterable[str]) -> Bool[np.ndarray, "lenses numbers"]:
    """The numbers of each lens that names or groups mean. Raises ValueError: no lens has such a
    number; one line."""
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
            known = dict.fromkeys(
                parameter for model in lenses.models for parameter in model.parameters
            )
            raise ValueError(
                f"no lens has a number {shown(name)}; there are {', '.join([*GROUPS, *known])}"
            )
        for number, columns in enumerate(of_models):
            own = (
                np.zeros(len(free), int) == number
                if lenses.model is None
                else np.asarray(lenses.model) == number
            )
            meant[np.ix_(own, columns)] = True
    return meant
