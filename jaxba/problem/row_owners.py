"""Which cameras and points the rows of residuals belong to."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Int

from jaxba.problem.bundle_problem import BundleProblem, ProblemError
from jaxba.problem.residuals import LENS, POINT, SECOND, Rows


class Owners(NamedTuple):
    """Which cameras and points stand for each row of a residual: of one of both kinds, or two of
    one."""

    cameras: list[Int[np.ndarray, " rows"]]  # -1 for some camera that sees the point
    points: list[Int[np.ndarray, " rows"]]  # -1 for none


def block_groups(problem: BundleProblem) -> list[Int[np.ndarray, " cameras"]]:
    """For each block of residuals the row that each camera has, negative and different where it has
    none. Raises ProblemError: see `owners_of`."""
    residuals = problem.residuals
    count = problem.num_cameras
    found = []
    if residuals.groups:
        return [np.asarray(group) for group in residuals.groups]
    for name, block in zip(residuals.names, residuals.blocks, strict=True):
        group = np.arange(count) if len(block) == count else -1 - np.arange(count)
        for rows in residuals.rows if len(block) < count else ():
            for own, index in zip(rows.residual.unknowns, rows.index, strict=True):
                if own.removesuffix(SECOND) == name:
                    camera = _named_camera(problem, rows, own.removeprefix(name))
                    known = camera >= 0
                    group[camera[known]] = index[known]
                    other = camera[known][group[camera[known]] != index[known]]
                    if other.size:
                        raise ProblemError(
                            f"camera {other[0]} has two rows of the unknown {name}: give each its "
                            "own"
                        )
        found.append(group)
    return found


def _named_camera(problem: BundleProblem, rows: Rows, ending: str) -> Int[np.ndarray, " rows"]:
    """The camera of each row that a pose, a lens or a block with a row for each camera names; -1
    for none."""
    residuals = problem.residuals
    count = problem.num_cameras
    lens = np.arange(count) if problem.lenses is None else np.asarray(problem.lenses.index)
    first = np.full(count if problem.lenses is None else len(problem.lenses.free), -1)
    first[lens[::-1]] = np.arange(count)[::-1]
    shared = {
        name
        for name, block in zip(residuals.names, residuals.blocks, strict=True)
        if len(block) < count
    }
    found = np.full(len(rows), -1)
    pairs = zip(rows.residual.unknowns, rows.index, strict=True)
    # others say which camera it is
    for name, index in sorted(pairs, key=lambda pair: pair[0].startswith(LENS)):
        base = name.removesuffix(SECOND)
        if name != base + ending or base == POINT or base in shared:
            continue
        camera = np.where(found >= 0, found, first[index]) if base == LENS else np.asarray(index)
        bad = np.flatnonzero(
            (lens[camera] != index) if base == LENS else (found >= 0) & (found != camera)
        )
        if bad.size:
            where = f"row {bad[0]} of residual {rows.residual.name}"
            raise ProblemError(
                f"{where}: {name} {index[bad[0]]} is not that of its camera, {found[bad[0]]}"
            )
        found = camera
    return found


def owners_of(
    problem: BundleProblem, rows: Rows, groups: list[Int[np.ndarray, " cameras"]]
) -> Owners:
    """Cameras and points that stand for rows, for the `block_groups` of the problem. Raises
    ProblemError: unknowns of a row are not of one camera, or a row has more than can be laid
    out."""
    names = rows.residual.unknowns
    cameras = []
    blocks = problem.residuals.names
    of_cameras = (name for name in names if name.removesuffix(SECOND) != POINT)
    for ending in dict.fromkeys(SECOND * name.endswith(SECOND) for name in of_cameras):
        camera = _named_camera(problem, rows, ending)
        for name, index in zip(names, rows.index, strict=True):
            if name.removesuffix(ending) in blocks and (camera < 0).any():
                group = groups[blocks.index(name.removesuffix(ending))]
                holds = group[:, None] == index
                camera = np.where((camera < 0) & holds.any(axis=0), holds.argmax(axis=0), camera)
        if (camera < 0).any():
            raise ProblemError(
                f"residual {rows.residual.name}: no residual says which cameras have its unknowns; "
                "put all of them in "
                f"one block with a row for each of {problem.num_cameras} cameras"
            )
        cameras.append(camera)
    points = sum(name.removesuffix(SECOND) == POINT for name in names)
    if len(cameras) * points > 1:
        what = "a camera and two points" if points == 2 else "two cameras and a point"
        raise ProblemError(f"residual {rows.residual.name}: {what} in one row are not supported")
    return Owners(cameras or [np.full(len(rows), -1)], rows.points)
