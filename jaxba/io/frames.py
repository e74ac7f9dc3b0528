"""The file beside a problem that says which frame of a sequence each camera is, and their calibration."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxba.io.encoding import parse_json, plain_text
from jaxba.io.files import StrPath, display_name, open_output, reason, sidecar_path
from jaxba.io.poses import Poses
from jaxba.problem.bundle_problem import ProblemError


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
