"""From the images of a sequence to tracks, and with poses to a problem."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from jaxba.io.notes import report as report_notes
from jaxba.kitti.assemble import Frames, assemble
from jaxba.kitti.features import EPIPOLAR_PIXELS, detect, essential, match
from jaxba.kitti.images import image_reader
from jaxba.kitti.odometry import visual_odometry
from jaxba.kitti.options import Build
from jaxba.kitti.sequence import Sequence
from jaxba.kitti.tracks import Tracks, choose, join_matches
from jaxba.kitti.triangulate import views_of_poses
from jaxba.problem.bundle_problem import BundleProblem, ProblemError

Report = Callable[[str], None]  # called with a stage when it begins


def build(
    sequence: Sequence,
    options: Build,
    poses_of_frames: Callable[[tuple[int, ...]], Float[np.ndarray, "frames 3 4"]] | None,
    report: Report,
) -> tuple[BundleProblem, Frames, int]:
    """Makes the problem of a sequence: it, its key-frames, and how many tracks they had.
    Repeatable.

    Notes say which frames could not be matched with the others, or placed by known points.
    `poses_of_frames` gives camera-to-world poses of frames by their numbers; it is needed where the
    initial poses are given. `report` is called with the progress. Raises ProblemError: an image
    cannot be read, frames share too little, or the camera does not move."""
    every, linked = link(sequence, options, report)
    numbers = tuple(sequence.numbers[i] for i in linked)
    chosen = choose(every, len(numbers), options.keyframes, sequence.calibration, numbers)
    frames = tuple(numbers[i] for i in chosen)
    tracks = every.restrict(chosen)
    restarts = ()
    if options.start == "vo":
        report(f"visual odometry ({len(frames)})")
        views, restarts = visual_odometry(
            tracks, len(frames), sequence.calibration, options, frames
        )
    else:
        assert poses_of_frames is not None
        views = views_of_poses(poses_of_frames(frames))
    report("triangulation")
    whole = assemble(tracks, views, sequence.calibration, frames, options)
    for words, left in (
        ("left out, too few matches", sorted(set(sequence.numbers) - set(numbers))),
        (
            "placed relative to the key-frame beside, without enough known points",
            [frames[i] for i in restarts],
        ),
    ):
        if left:
            report_notes([f"{words}: frame{'s'[: len(left) > 1]} {', '.join(map(str, left))}"])
    return whole, frames, tracks.count


def link(sequence: Sequence, options: Build, report: Report) -> tuple[Tracks, tuple[int, ...]]:
    """Tracks over the frames that are linked with the first one, and the positions of these in the
    sequence.

    The images of the tracks are positions among them. A frame not linked with one of the `reach`
    before it is left out. Raises ProblemError: an image cannot be read, or too many frames in a row
    are not linked: the message names them."""
    read = image_reader(sequence)
    calibration = sequence.calibration
    # descriptors of a whole sequence would fill gigabytes
    recent: deque[np.ndarray] = deque(maxlen=options.reach + 1)
    pixels: list[np.ndarray] = []
    matches: dict[tuple[int, int], np.ndarray] = {}
    report(f"key-points and matches ({len(sequence)})")
    for j in range(len(sequence)):
        found, descriptors = detect(read(j), options.keypoints)
        pixels.append(found)
        recent.append(descriptors)
        for i in range(max(j - options.reach, 0), j):
            pairs = match(recent[i - j - 1], recent[-1])
            first, second = (
                calibration.rays(pixels[k][own]) for k, own in ((i, pairs[:, 0]), (j, pairs[:, 1]))
            )
            matches[i, j] = pairs[essential(first, second, EPIPOLAR_PIXELS / calibration.fx)[1]]
    linked = [0]
    before = [0]
    for j in range(1, len(sequence)):
        before = [i for i in linked if j - i <= options.reach]
        if any(len(matches[i, j]) >= options.min_matches for i in before):
            linked.append(j)
        elif not before:
            break
    if len(linked) < 2 or not before:
        number = sequence.numbers
        last = linked[-1]
        counts = sorted((k, len(found)) for (i, k), found in matches.items() if i == last)
        shares = ", ".join(f"{count} with frame {number[k]}" for k, count in counts)
        raise ProblemError(
            f"too few matches: frame {number[last]} shares {shares}, at least "
            f"{options.min_matches} are needed; "
            f"choose other --frames, more --keypoints or fewer --min-matches"
        )
    position = {frame: at for at, frame in enumerate(linked)}
    strong = {
        (position[i], position[j]): found
        for (i, j), found in matches.items()
        if i in position and j in position and len(found) >= options.min_matches
    }
    return join_matches([pixels[i] for i in linked], strong), tuple(linked)
