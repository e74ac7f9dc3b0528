"""Key-frames: the frames that enter the problem."""

from __future__ import annotations

import re
from itertools import pairwise

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from jaxba.io.frames import Calibration
from jaxba.kitti.tracks import Tracks
from jaxba.problem.bundle_problem import ProblemError
from jaxba.problem.geometry import perspective

PARALLAX = 10.0
"""Median parallax in pixels of a key-frame of `auto`. VINS-Mono (Qin et al. 2018): 10 at focal length 460."""

SHARE = 0.5  # ... as it does when less than this share of the tracks of the last key-frame is left
MIN_SHARED = 20  # tracks that neighbouring key-frames must share, to estimate their relative pose


def parallax(first: Float[np.ndarray, "m 2"], second: Float[np.ndarray, "m 2"], focal: float) -> float:
    """Median image motion in pixels that no rotation of the camera explains; zero for a camera that only rotates.

    The rotation is the least-squares fit to the rays, which absorbs a little of a translation where the scene is far.

    Rays are `(X / Z, Y / Z)`, the focal length is in pixels.
    """
    rotated = np.column_stack([first, np.ones(len(first))]) @ relative_rotation(first, second).T
    return float(focal * np.median(np.linalg.norm(perspective(rotated) - second, axis=1)))


def relative_rotation(first: Float[np.ndarray, "m 2"], second: Float[np.ndarray, "m 2"]) -> Float[np.ndarray, "3 3"]:
    """The least-squares rotation from the rays of one view to those of another."""
    a, b = (np.column_stack([rays, np.ones(len(rays))]) for rays in (first, second))
    a, b = (rays / np.linalg.norm(rays, axis=1, keepdims=True) for rays in (a, b))
    return Rotation.align_vectors(b, a)[0].as_matrix()


def choose(tracks: Tracks, images: int, choice: str, calibration: Calibration, numbers: tuple[int, ...]) -> list[int]:
    """Which of so many images are key-frames. The choice is `auto` (by parallax and by the share of tracks left),
    `all`, or a number N for every N-th; `numbers` are the frame numbers of the images, for messages. Raises
    ProblemError: the choice is none of these, the camera does not move, or neighbours share too few tracks."""
    if choice != "auto":
        step = 1 if choice == "all" else int(choice) if re.fullmatch(r"[1-9]\d{0,8}", choice) else 0
        if not step:
            raise ProblemError(f"--keyframes must be auto, all or a number such as 2, is {choice!r}")
        chosen = list(range(0, images, step))
    else:
        chosen = [0]
        rays = calibration.rays(tracks.pixels)
        for i in range(1, images):
            a, b = tracks.shared(chosen[-1], i)
            own = len(tracks.rows_of_image(chosen[-1]))
            if len(a) < max(SHARE * own, MIN_SHARED) or parallax(rays[a], rays[b], calibration.fx) >= PARALLAX:
                chosen.append(i)
    if len(chosen) < 2:
        where = f"frames {numbers[0]} to {numbers[images - 1]}"
        if choice == "auto":
            raise ProblemError(f"the camera hardly moves in {where}: one key-frame")
        raise ProblemError(f"--keyframes {choice} leaves one key-frame of {images} in {where}, not 2")
    for i, j in pairwise(chosen):
        shared = len(tracks.shared(i, j)[0])
        if shared < MIN_SHARED:
            raise ProblemError(
                f"too few matches: key-frames {numbers[i]} and {numbers[j]} share {shared} tracks, "
                f"at least {MIN_SHARED} are needed; choose --keyframes all, or other --frames"
            )
    return chosen
