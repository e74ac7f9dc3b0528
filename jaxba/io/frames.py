"""Frames of a sequence: text files of their poses, and the file beside a problem that says which frame each camera is.

A line of poses has 12 numbers, a 3 x 4 matrix row by row; line 0 is frame 0 (KITTI's odometry benchmark). Lines of 13
or 17 numbers begin with the frame and have 3 x 4 or 4 x 4 numbers (KITTI-360's `poses.txt`, `cam0_to_world.txt`);
frames may be missing. Source: the readmes of both development kits."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxba.io.encoding import parse_json, plain_text, read_characters
from jaxba.io.files import StrPath, display_name, open_output, reason, sidecar_path
from jaxba.io.text import finite_numbers
from jaxba.problem.bundle_problem import ProblemError
from jaxba.problem.geometry import are_rotations


class Poses(NamedTuple):
    """Camera-to-world poses of frames."""

    numbers: Int[np.ndarray, " frames"]  # number of each frame, ascending
    matrices: Float[np.ndarray, "frames 3 4"]  # `[R | c]` of each, metres
    name: str  # of the file, for messages
    one_a_line: bool = True  # whether lines are frames, so that none can be missing before the last


def read_poses(path: StrPath) -> Poses:
    """Poses of camera 0 to world, metres. Raises ProblemError: unreadable, malformed, no rotation, or a frame twice."""
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


def lines_of(path: Path) -> list[tuple[int, str]]:
    """Lines of a file that are not blank, and their numbers from 1. Raises ProblemError: unreadable, or no text."""
    text = read_characters(path)
    return [(at, line.strip()) for at, line in enumerate(text.split("\n"), 1) if line.strip()]


def numbers_of(text: str, count: int, where: str) -> np.ndarray:
    """The finite numbers of a line, shape (count,). Raises ProblemError, beginning with `where`: not so many."""
    numbers = finite_numbers(text.split(), [f"number {at}" for at in range(1, len(text.split()) + 1)], where)
    if len(numbers) != count:
        raise ProblemError(f"{where}: has {len(numbers)} numbers instead of {count}")
    return np.array(numbers)


@dataclass(frozen=True)
class Calibration:
    """A pinhole camera without distortion, as rectified images have it."""

    fx: float  # focal length in pixels, horizontally
    fy: float  # the same, vertically
    cx: float  # principal point in pixels from the centre of the first pixel, to the right
    cy: float  # the same, downwards
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)  # camera 0 in this camera's frame, metres: `K^-1 P[:, 3]`

    def rays(self, pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Directions `(X / Z, Y / Z)` of pixels; x to the right, y down, z forward."""
        return (np.asarray(pixels, np.float64) - [self.cx, self.cy]) / [self.fx, self.fy]


@dataclass(frozen=True)
class Sidecar:
    """Data of a problem that are not in its arrays."""

    frames: tuple[int, ...]  # frame number of every camera
    calibration: Calibration  # calibration of the images


def poses_of(poses: Poses, numbers: tuple[int, ...], calibration: Calibration) -> Float[np.ndarray, "frames 3 4"]:
    """Camera-to-world poses of this camera at the frames with these numbers.

    The centre of camera 0 is at `offset` in the camera's frame: paths differ. Raises ProblemError: no pose."""
    there = np.isin(numbers, poses.numbers)
    if not there.all():
        raise ProblemError(f"{poses.name}: has {len(poses.numbers)} poses, none for frame {numbers[there.argmin()]}")
    chosen = poses.matrices[np.searchsorted(poses.numbers, numbers)].copy()
    chosen[:, :, 3] -= chosen[:, :, :3] @ np.array(calibration.offset)
    return chosen


def write_sidecar(path: StrPath, contents: Mapping[str, Any]) -> None:
    """Writes the sidecar file of a problem. Raises ProblemError."""
    with open_output(sidecar_path(path)) as file:
        file.write((json.dumps(contents, indent=1, allow_nan=False) + "\n").encode())


def read_sidecar(path: StrPath) -> Sidecar:
    """Reads the sidecar file of a problem. Raises ProblemError: there is none, or `jaxba-kitti` did not write it."""
    side = sidecar_path(path)
    try:
        contents = parse_json(plain_text(side.read_bytes()).decode())
        calibration = Calibration(**{**contents["calibration"], "offset": tuple(contents["calibration"]["offset"])})
        frames = tuple(int(number) for number in contents["frames"])
    except OSError as error:
        raise ProblemError(f"{display_name(side)}: cannot be read: {reason(error)}; jaxba-kitti writes it") from None
    except (ValueError, KeyError, TypeError):
        raise ProblemError(f"{display_name(side)}: is not a sidecar file of jaxba-kitti") from None
    return Sidecar(frames, calibration)
