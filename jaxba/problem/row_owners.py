"""Which cameras and point the rows of residuals belong to."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Int

from jaxba.problem.bundle_problem import BundleProblem, ProblemError
from jaxba.problem.residuals import LENS, POINT, POSE, SECOND, Rows


class Owners(NamedTuple):
    """Which cameras and point stand for each row of a residual."""

    cameras: list[Int[np.ndarray, " rows"]]  # -1 for some camera that sees the point
    point: Int[np.ndarray, " rows"]  # -1 for none


def block_groups(problem: BundleProblem) -> list[Int[np.ndarray, " cameras"]]:
    """For each block of residuals the row that each camera has, negative and different where it has none.

    Raises:
        ProblemError: a camera would have two rows of one block.
    """
    if problem.residuals is None:
        return []
    return [_groups(problem, name) for name in problem.residuals.names]


def _groups(problem: BundleProblem, name: str) -> Int[np.ndarray, " cameras"]:
    assert problem.residuals is not None
    count = problem.num_cameras
    if len(problem.residuals.blocks[problem.residuals.names.index(name)]) == count:
        return np.arange(count)
    found = -1 - np.arange(count)
    for rows in problem.residuals.rows:
        for place, own in enumerate(rows.residual.unknowns):
            if own.removesuffix(SECOND) != name:
                continue
            camera, index = _named_camera(problem, rows, own.removeprefix(name)), np.asarray(rows.index[place])
            known = camera >= 0
            found[camera[known]] = index[known]
            other = np.flatnonzero(found[camera[known]] != index[known])
            if other.size:
                which = camera[known][other[0]]
                raise ProblemError(f"camera {which} has two rows of the unknown {name}: it needs one for each camera")
    return found


def _named_camera(problem: BundleProblem, rows: Rows, ending: str) -> Int[np.ndarray, " rows"]:
    """The camera of each row that a pose, a lens or a block with a row for each camera names; -1 for none."""
    residuals = problem.residuals
    assert residuals is not None
    lengths = dict(zip(residuals.names, map(len, residuals.blocks), strict=True))
    found = np.full(len(rows), -1)
    for name, index in zip(rows.residual.unknowns, rows.index, strict=True):
        base = name.removesuffix(SECOND)
        if (SECOND if name.endswith(SECOND) else "") != ending or base == POINT:
            continue
        if base == LENS and problem.lenses is not None:
            lens = np.asarray(problem.lenses.index)
            first = np.full(len(problem.lenses.free), -1)
            first[lens[::-1]] = np.arange(len(lens))[::-1]
            camera = np.where(found >= 0, found, first[index])
            agrees = lens[camera] == index
        elif base in (POSE, LENS) or lengths[base] == problem.num_cameras:
            camera = np.asarray(index)
            agrees = (found < 0) | (found == camera)
        else:
            continue
        bad = np.flatnonzero(~agrees)
        if bad.size:
            at = f"row {bad[0]} of residual {rows.residual.name}"
            raise ProblemError(f"{at}: {name} {index[bad[0]]} is not of camera {found[bad[0]]}, whose pose it has")
        found = camera
    return found


def owners_of(problem: BundleProblem, rows: Rows, groups: list[Int[np.ndarray, " cameras"]]) -> Owners:
    """Cameras and points that stand for rows.

    Raises:
        ProblemError: unknowns of a row are not of one camera, or a row has more than this can lay out.
    """
    names, residuals = rows.residual.unknowns, problem.residuals
    assert residuals is not None
    at = rows.of_point()
    point = np.full(len(rows), -1) if at is None else np.asarray(rows.index[at])
    cameras = []
    for ending in dict.fromkeys(SECOND if name.endswith(SECOND) else "" for name in names if name != POINT):
        camera = _named_camera(problem, rows, ending)
        for name, index in zip(names, rows.index, strict=True):
            base = name.removesuffix(SECOND)
            if base in residuals.names and name == base + ending:
                group = groups[residuals.names.index(base)]
                first = np.full(group.max(initial=-1) + 2, -1)
                named = np.flatnonzero(group >= 0)[::-1]
                first[group[named]] = named
                camera = np.where(camera >= 0, camera, first[np.minimum(index, len(first) - 1)])
                if (camera < 0).any():
                    raise ProblemError(f"no residual says which cameras have row {index.min()} of the unknown {base}")
        cameras.append(camera)
    if len(cameras) == 2 and at is not None:
        raise ProblemError(f"residual {rows.residual.name}: two cameras and a point in one row are not supported")
    return Owners(cameras or [np.full(len(rows), -1)], point)
