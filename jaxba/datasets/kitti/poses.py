"""Files of poses and of times.

A line of poses has 12 numbers, a 3 x 4 matrix row by row; line 0 is frame 0 (odometry benchmark). Lines of 13 or 17
numbers begin with the frame and have 3 x 4 or 4 x 4 numbers (KITTI-360's `poses.txt`, `cam0_to_world.txt`); frames may
be missing. Source: the readmes of both development kits.
"""

from __future__ import annotations

import re
from datetime import datetime
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxba.datasets.kitti.calibration import Calibration
from jaxba.datasets.kitti.text_files import lines_of, numbers_of
from jaxba.io.files import StrPath, display_name
from jaxba.problem.bundle_problem import ProblemError
from jaxba.problem.geometry import are_rotations

_STAMP = re.compile(r"(\d{4}-\d\d-\d\d[ T]\d\d:\d\d:\d\d)(\.\d+)?")
"""A time of the raw data, such as 2011-09-26 13:02:25.964389445."""


class Poses(NamedTuple):
    """Camera-to-world poses of frames."""

    numbers: Int[np.ndarray, " frames"]
    """Number of each frame, ascending."""

    matrices: Float[np.ndarray, "frames 3 4"]
    """`[R | c]` of each, metres."""

    name: str
    """Of the file, for messages."""

    one_a_line: bool = True
    """Whether the lines of the file are the frames, so that none can be missing before the last."""


def read_poses(path: StrPath) -> Poses:
    """Poses of camera 0, camera to world, in metres.

    Raises:
        ProblemError: the file cannot be read, a line is malformed or holds no rotation, or a frame comes twice.
    """
    name = display_name(path)
    lines = lines_of(Path(path))
    if not lines:
        raise ProblemError(f"{name}: holds no poses")
    width = len(lines[0][1].split())
    width = width if width in (13, 17) else 12
    table = np.array([numbers_of(line, width, f"{name} line {at}") for at, line in lines])
    numbers, matrices = np.arange(len(table)), table
    if width > 12:
        whole = (table[:, 0] == np.floor(table[:, 0])) & (table[:, 0] >= 0) & (table[:, 0] < 2**31)
        last = np.ones(len(table), bool) if width == 13 else (table[:, 13:] == [0, 0, 0, 1]).all(axis=1)
        for bad, complaint in (
            (~whole, "the first of 13 or 17 numbers is no number of a frame"),
            (~last, "the last row of the matrix is not 0 0 0 1"),
        ):
            if bad.any():
                raise ProblemError(f"{name} line {lines[bad.argmax()][0]}: {complaint}")
        numbers, matrices = table[:, 0].astype(np.int64), table[:, 1:13]
    poses = matrices.reshape(-1, 3, 4)
    bad = np.flatnonzero(~are_rotations(poses[:, :, :3]))
    if bad.size:
        raise ProblemError(f"{name} line {lines[bad[0]][0]}: the left 3 x 3 numbers are no rotation")
    order = np.argsort(numbers, kind="stable")
    twice = np.flatnonzero(np.diff(numbers[order]) == 0)
    if twice.size:
        raise ProblemError(f"{name}: has two poses for frame {numbers[order][twice[0]]}")
    u, _, vt = np.linalg.svd(poses[order, :, :3])  # to full precision
    return Poses(numbers[order], np.concatenate([u @ vt, poses[order, :, 3:]], axis=2), name, width == 12)


def poses_of(poses: Poses, numbers: tuple[int, ...], calibration: Calibration) -> Float[np.ndarray, "frames 3 4"]:
    """Camera-to-world poses of this camera at the frames with these numbers.

    The centre of camera 0 is at `offset` in the frame of this camera, so their paths differ.

    Raises:
        ProblemError: a frame has no pose.
    """
    there = np.isin(numbers, poses.numbers)
    if not there.all():
        raise ProblemError(f"{poses.name}: has {len(poses.numbers)} poses, none for frame {numbers[there.argmin()]}")
    chosen = poses.matrices[np.searchsorted(poses.numbers, numbers)].copy()
    chosen[:, :, 3] -= chosen[:, :, :3] @ np.array(calibration.offset)
    return chosen


def read_times(path: Path, numbers: list[int]) -> Float[np.ndarray, " frames"]:
    """Times of frames, seconds: line N of a file is that of frame N, seconds or a date with a time.

    Dates are counted from the first line, so that no digits are lost.

    Raises:
        ProblemError: the file cannot be read, has too few lines, or one of them is no time.
    """
    lines = lines_of(path)
    if max(numbers) >= len(lines):
        raise ProblemError(f"{display_name(path)}: has no time for frame {max(numbers)}")
    where = lambda at: f"{display_name(path)} line {lines[at][0]}"
    if not _STAMP.fullmatch(lines[0][1]):
        return np.array([numbers_of(lines[at][1], 1, where(at))[0] for at in numbers])
    start, fraction = _stamp(lines[0][1], where(0))
    stamps = [_stamp(lines[at][1], where(at)) for at in numbers]
    return np.array([(time - start).total_seconds() + (part - fraction) for time, part in stamps])


def _stamp(text: str, where: str) -> tuple[datetime, float]:
    """Whole seconds of a date with a time, and the fraction of the last one."""
    match = _STAMP.fullmatch(text)
    try:
        if match is not None:
            return datetime.fromisoformat(match[1]), float(match[2] or 0)
    except ValueError:  # a thirteenth month
        pass
    raise ProblemError(f"{where}: is no date and time")
