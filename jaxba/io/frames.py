"""Frames of a sequence: text files of their poses, and the file beside a problem that says which
frame each camera is.

A line of poses has 12 numbers, a 3 x 4 matrix row by row; line 0 is frame 0. Source: the readme of
the development kit of KITTI's odometry benchmark."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxba.io.encoding import parse_json, plain_text, read_characters
from jaxba.io.files import StrPath, display_name, open_output, reason, sidecar_path
from jaxba.io.text import finite_numbers
from jaxba.problem.bundle_problem import ProblemError
from jaxba.problem.geometry import are_rotations


class Poses(NamedTuple):
    """Camera-to-world poses of all frames."""

    matrices: Float[np.ndarray, "frames 3 4"]  # `[R | c]` of each, metres
    name: str  # of the file, for messages


def read_poses(path: StrPath) -> Poses:
    """Poses of camera 0 to world, metres. Raises ProblemError: unreadable, malformed, or no
    rotation."""
    name = display_name(path)
    lines = lines_of(Path(path))
    if not lines:
        raise ProblemError(f"{name}: holds no poses")
    poses = np.array([numbers_of(line, 12, f"{name} line {at}") for at, line in lines]).reshape(
        -1, 3, 4
    )
    bad = np.flatnonzero(~are_rotations(poses[:, :, :3]))
    if bad.size:
        raise ProblemError(
            f"{name} line {lines[bad[0]][0]}: the left 3 x 3 numbers are no rotation"
        )
    u, _, vt = np.linalg.svd(poses[:, :, :3])  # to full precision
    return Poses(np.concatenate([u @ vt, poses[:, :, 3:]], axis=2), name)


def lines_of(path: Path) -> list[tuple[int, str]]:
    """Lines of a file that are not blank, and their numbers from 1. Raises ProblemError:
    unreadable, or no text."""
    text = read_characters(path)
    return [(at, line.strip()) for at, line in enumerate(text.split("\n"), 1) if line.strip()]


def numbers_of(text: str, count: int, where: str) -> np.ndarray:
    """The finite numbers of a line, shape (count,). Raises ProblemError, beginning with `where`:
    not so many."""
    numbers = finite_numbers(
        text.split(), [f"number {at}" for at in range(1, len(text.split()) + 1)], where
    )
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
    # camera 0 in this camera's frame, metres: `K^-1 P[:, 3]`
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def rays(self, pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Directions `(X / Z, Y / Z)` of pixels; x to the right, y down, z forward."""
        return (np.asarray(pixels, np.float64) - [self.cx, self.cy]) / [self.fx, self.fy]


@dataclass(frozen=True)
class Sidecar:
    """Data of a problem that are not in its arrays."""

    frames: tuple[int, ...]  # frame number of every camera
    calibration: Calibration  # calibration of the images


def poses_of(
    poses: Poses, numbers: tuple[int, ...], calibration: Calibration
) -> Float[np.ndarray, "frames 3 4"]:
    """Camera-to-world poses of this camera at the frames with these numbers.

    The centre of camera 0 is at `offset` in the camera's frame: paths differ. Raises ProblemError:
    no pose."""
    if max(numbers) >= len(poses.matrices):
        missing = next(number for number in numbers if number >= len(poses.matrices))
        raise ProblemError(
            f"{poses.name}: has {len(poses.matrices)} poses, none for frame {missing}"
        )
    chosen = poses.matrices[list(numbers)]
    chosen[:, :, 3] -= chosen[:, :, :3] @ np.array(calibration.offset)
    return chosen


def write_sidecar(path: StrPath, contents: Mapping[str, Any]) -> None:
    """Writes the sidecar file of a problem. Raises ProblemError."""
    with open_output(sidecar_path(path)) as file:
        file.write((json.dumps(contents, indent=1, allow_nan=False) + "\n").encode())


def read_sidecar(path: StrPath) -> Sidecar:
    """Reads the sidecar file of a problem. Raises ProblemError: there is none, or `jaxba-kitti` did
    not write it."""
    side = sidecar_path(path)
    try:
        contents = parse_json(plain_text(side.read_bytes()).decode())
        calibration = Calibration(
            **{**contents["calibration"], "offset": tuple(contents["calibration"]["offset"])}
        )
        frames = tuple(int(number) for number in contents["frames"])
    except OSError as error:
        raise ProblemError(
            f"{display_name(side)}: cannot be read: {reason(error)}; jaxba-kitti writes it"
        ) from None
    except (ValueError, KeyError, TypeError):
        raise ProblemError(f"{display_name(side)}: is not a sidecar file of jaxba-kitti") from None
    return Sidecar(frames, calibration)
