"""The whole pipeline: from a sequence to a problem with initial poses and points."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxba.kitti.assemble import Assembled, assemble
from jaxba.kitti.frontend import Report, link
from jaxba.kitti.initial_poses import drift
from jaxba.kitti.keyframes import choose
from jaxba.kitti.odometry import views_of_poses, visual_odometry
from jaxba.kitti.options import BuildOptions
from jaxba.kitti.sequence import Sequence
from jaxba.kitti.triangulate import Filters


@dataclass(frozen=True)
class Built:
    """A problem, and what `build` has to report of it."""

    whole: Assembled
    frames: int
    """Frames of the sequence's range."""

    dropped: tuple[int, ...]
    """Frame numbers that could not be matched with the others."""

    tracks: int
    """Tracks over the key-frames, of which not all became points."""

    restarts: tuple[int, ...] = ()
    """Frame numbers whose pose comes from the neighbouring key-frame alone, for lack of known points."""


def build(
    sequence: Sequence,
    options: BuildOptions,
    work: Path,
    poses_of_frames: Callable[[tuple[int, ...]], Float[np.ndarray, "frames 3 4"]] | None,
    report: Report,
) -> Built:
    """Makes the problem of a sequence. Equal arguments give equal numbers, whatever that folder holds.

    Args:
        sequence: the frames.
        options: of tracks, key-frames, poses and points.
        work: folder of the results of single frames.
        poses_of_frames: camera-to-world poses of frames by their numbers; needed where the initial poses are given.
        report: called with the progress.

    Raises:
        ProblemError: an image cannot be read, frames share too little, or the camera does not move.
    """
    every, linked = link(sequence, options, work, report)
    numbers = tuple(sequence.numbers[i] for i in linked)
    chosen = choose(every, len(numbers), options.keyframes, sequence.calibration, numbers)
    frames = tuple(numbers[i] for i in chosen)
    tracks, filters = every.restrict(chosen), Filters(options.min_angle, options.max_error)
    restarts: tuple[int, ...] = ()
    moved = None
    if options.start == "vo":
        placed = visual_odometry(
            tracks,
            len(frames),
            sequence.calibration,
            filters,
            options.seed,
            frames,
            lambda done: report("visual odometry", done, len(frames)),
        )
        views, restarts = placed.views, tuple(frames[i] for i in placed.restarts)
    else:
        assert poses_of_frames is not None
        poses = poses_of_frames(frames)
        views = views_of_poses(poses)
        if options.start == "noisy-poses":
            noisy = drift(poses, options.rotation_sigma, options.translation_sigma, options.seed)
            moved = views_of_poses(noisy)
    report("triangulation", 0, 1)
    whole = assemble(tracks, views, sequence.calibration, frames, filters, options.min_views, moved)
    dropped = tuple(sorted(set(sequence.numbers) - set(numbers)))
    return Built(whole, len(sequence), dropped, tracks.count, restarts)
