"""The whole pipeline: from a sequence to a problem with initial poses and points."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from jaxtyping import Float

from jaxba.kitti.assemble import Assembled, assemble
from jaxba.kitti.frontend import FrontEndOptions, Report, link
from jaxba.kitti.initial_poses import drift
from jaxba.kitti.keyframes import choose
from jaxba.kitti.odometry import views_of_poses, visual_odometry
from jaxba.kitti.result_cache import ResultCache
from jaxba.kitti.sequence import Sequence
from jaxba.kitti.triangulate import Filters

Start = Literal["vo", "poses", "noisy-poses"]


@dataclass(frozen=True)
class BuildOptions:
    """Options of `build`."""

    front: FrontEndOptions = field(default_factory=FrontEndOptions)
    """Options of the tracks."""

    keyframes: str = "auto"
    """`auto`, `all` or N for every N-th frame."""

    start: Start = "vo"
    """Source of the initial poses."""

    rotation_sigma: float = 0.1
    """Of `noisy-poses`: degrees per key-frame."""

    translation_sigma: float = 0.05
    """Of `noisy-poses`: relative to the length of the motion."""

    filters: Filters = field(default_factory=Filters)
    """Options of the points."""

    min_views: int = 2
    """Observations that a point needs."""


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
    cache: ResultCache,
    poses_of_frames: Callable[[tuple[int, ...]], Float[np.ndarray, "frames 3 4"]] | None,
    report: Report,
) -> Built:
    """Makes the problem of a sequence. Equal arguments give equal numbers, whatever the cache holds.

    Args:
        sequence: the frames.
        options: of tracks, key-frames, poses and points.
        cache: of the results of single frames.
        poses_of_frames: camera-to-world poses of frames by their numbers; needed where the initial poses are given.
        report: called with the progress.

    Raises:
        ProblemError: an image cannot be read, frames share too little, or the camera does not move.
    """
    linked = link(sequence, options.front, cache, report)
    numbers = tuple(sequence.numbers[i] for i in linked.frames)
    chosen = choose(linked.tracks, len(numbers), options.keyframes, sequence.calibration, numbers)
    frames = tuple(numbers[i] for i in chosen)
    tracks = linked.tracks.restrict(chosen)
    restarts: tuple[int, ...] = ()
    moved = None
    if options.start == "vo":
        placed = visual_odometry(
            tracks,
            len(frames),
            sequence.calibration,
            options.filters,
            options.front.seed,
            frames,
            lambda done: report("visual odometry", done, len(frames)),
        )
        views, restarts = placed.views, tuple(frames[i] for i in placed.restarts)
    else:
        assert poses_of_frames is not None
        poses = poses_of_frames(frames)
        views = views_of_poses(poses)
        if options.start == "noisy-poses":
            noisy = drift(poses, options.rotation_sigma, options.translation_sigma, options.front.seed)
            moved = views_of_poses(noisy)
    report("triangulation", 0, 1)
    whole = assemble(tracks, views, sequence.calibration, frames, options.filters, options.min_views, moved)
    dropped = tuple(sorted(set(sequence.numbers) - set(numbers)))
    return Built(whole, len(sequence), dropped, tracks.count, restarts)
