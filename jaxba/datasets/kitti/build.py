"""All of the way: from a sequence to problems with a start."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from jaxtyping import Float

from jaxba.datasets.kitti.assemble import Assembled, assemble
from jaxba.datasets.kitti.front import FrontOptions, Report, link
from jaxba.datasets.kitti.keyframes import choose
from jaxba.datasets.kitti.odometry import views_of_poses, visual_odometry
from jaxba.datasets.kitti.sequence import Sequence
from jaxba.datasets.kitti.starts import drift
from jaxba.datasets.kitti.triangulate import Filters
from jaxba.datasets.kitti.work import Work

Start = Literal["vo", "poses", "noisy-poses"]


@dataclass(frozen=True)
class BuildOptions:
    """What a problem depends on, beside the sequence."""

    front: FrontOptions = field(default_factory=FrontOptions)
    """Of the tracks."""

    keyframes: str = "auto"
    """`auto`, `all` or N for every N-th frame."""

    start: Start = "vo"
    """Where the poses come from."""

    rotation_sigma: float = 0.1
    """Of `noisy-poses`: degrees a key-frame."""

    translation_sigma: float = 0.05
    """Of `noisy-poses`: share of the motion's length."""

    filters: Filters = field(default_factory=Filters)
    """Of the points."""

    min_views: int = 2
    """Sightings that a point needs."""


@dataclass(frozen=True)
class Built:
    """A problem and how it came about."""

    whole: Assembled
    frames: int
    """Frames of the sequence's range."""

    dropped: tuple[int, ...]
    """Frame numbers that could not be linked with the others."""

    tracks: int
    """Tracks over the key-frames, of which not all became points."""

    restarts: tuple[int, ...] = ()
    """Frame numbers that visual odometry placed relative to the key-frame beside, without enough known points."""


def build(
    sequence: Sequence,
    options: BuildOptions,
    work: Work,
    poses_of_frames: Callable[[tuple[int, ...]], Float[np.ndarray, "frames 3 4"]] | None,
    report: Report,
) -> Built:
    """Makes the problem of a sequence. Equal arguments give equal numbers, whatever the work folder holds already.

    Args:
        sequence: the frames.
        options: how.
        work: where results of single frames are kept.
        poses_of_frames: camera-to-world poses of frames by their numbers; needed for starts from poses.
        report: told about progress.

    Raises:
        ProblemError: an image cannot be read, frames share too little, or the camera does not move.
    """
    linked = link(sequence, options.front, work, report)
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
