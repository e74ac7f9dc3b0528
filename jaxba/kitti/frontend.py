"""The front end: tracks over the frames of a sequence. The result of every frame and pair is cached on disk."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import numpy as np

from jaxba.kitti.features import KeyPoints, Verified, detect, epipolar_inliers, match
from jaxba.kitti.images import image_reader, spare_bits, stamp
from jaxba.kitti.klt import TrackedPoints, detect_corners, track
from jaxba.kitti.opencv import cv2
from jaxba.kitti.options import BuildOptions
from jaxba.kitti.result_cache import cached, digest
from jaxba.kitti.sequence import Sequence
from jaxba.kitti.tracks import Tracks, join_matches, make_tracks
from jaxba.problem.bundle_problem import ProblemError

Report = Callable[[str, int, int], None]
"""Called with the name of a stage, how much of it is done, and how much there is."""


def link(sequence: Sequence, options: BuildOptions, work: Path, report: Report) -> tuple[Tracks, tuple[int, ...]]:
    """Tracks over the frames that are linked with the first one, and the positions of these in the sequence.

    The images of the tracks are positions among them. A frame that cannot be linked with one of the `reach` frames
    before it is left out; too many such frames in a row are an error.

    Raises:
        ProblemError: an image cannot be read, or frames cannot be linked: the message names them.
    """
    stamps = [stamp(path) for path in sequence.images]
    return (_track_points if options.features == "klt" else _match_features)(sequence, options, work, report, stamps)


def _match_features(
    sequence: Sequence, options: BuildOptions, work: Path, report: Report, stamps: list[str]
) -> tuple[Tracks, tuple[int, ...]]:
    read = image_reader(sequence)
    kind = (options.features, options.keypoints, cv2.__version__, spare_bits(sequence))
    recent: deque[KeyPoints] = deque(maxlen=options.reach + 1)  # descriptors of a whole sequence would fill gigabytes
    pixels: list[np.ndarray] = []
    matches: dict[tuple[int, int], np.ndarray] = {}
    for j, number in enumerate(sequence.numbers):
        report("key-points and matches", j, len(sequence))
        key = digest("points", kind, stamps[j])
        recent.append(cached(work, f"points-{number:06d}-{key}", KeyPoints, lambda j=j: detect(read(j), *kind[:2])))
        pixels.append(recent[-1].pixels)
        for i in range(max(j - options.reach, 0), j):
            key = digest("match", kind, stamps[i], stamps[j], asdict(sequence.calibration), options.seed)
            name = f"match-{sequence.numbers[i]:06d}-{number:06d}-{key}"
            make = lambda a=recent[i - j - 1], b=recent[-1]: _verify(a, b, sequence, options.seed)
            matches[i, j] = np.stack(cached(work, name, Verified, make), axis=1)
    linked = [0]
    for j in range(1, len(sequence)):
        before = [i for i in linked if j - i <= options.reach]
        if not before:
            _fail(sequence, options, linked[-1], {k: len(matches[i, k]) for i, k in matches if i == linked[-1]})
        if any(len(matches[i, j]) >= options.min_matches for i in before):
            linked.append(j)
    if len(linked) < 2:
        _fail(sequence, options, 0, {k: len(matches[i, k]) for i, k in matches if i == 0})
    position = {frame: at for at, frame in enumerate(linked)}
    strong = {
        (position[i], position[j]): found
        for (i, j), found in matches.items()
        if i in position and j in position and len(found) >= options.min_matches
    }
    return join_matches([pixels[i] for i in linked], strong), tuple(linked)


def _verify(a: KeyPoints, b: KeyPoints, sequence: Sequence, seed: int) -> Verified:
    pairs = match(a, b)
    good = epipolar_inliers(a.pixels[pairs[:, 0]], b.pixels[pairs[:, 1]], sequence.calibration, seed)
    return Verified(*pairs[good].T)


def _track_points(
    sequence: Sequence, options: BuildOptions, work: Path, report: Report, stamps: list[str]
) -> tuple[Tracks, tuple[int, ...]]:
    read = image_reader(sequence)
    count, calibration = options.keypoints, sequence.calibration
    own = (count, options.reach, options.min_matches, options.seed)
    key = digest("klt", own, asdict(calibration), cv2.__version__, stamps[0])
    name = f"klt-{sequence.numbers[0]:06d}-{key}"
    points = cached(work, name, TrackedPoints, lambda: detect_corners(read(0), count))
    linked, seen, failed = [0], [points], {}
    for j in range(1, len(sequence)):
        report("tracking", j, len(sequence))
        i = linked[-1]
        key = digest(key, stamps[i], stamps[j])
        make = lambda i=i, j=j, points=points: track(read(i), read(j), points, count, calibration, options.seed)
        found = cached(work, f"klt-{sequence.numbers[j]:06d}-{key}", TrackedPoints, make)
        if int(found.old) < options.min_matches:
            failed[j] = int(found.old)
            if j - i >= options.reach or (j == len(sequence) - 1 and len(linked) == 1):
                _fail(sequence, options, i, failed)
            continue
        points = found
        linked.append(j)
        seen.append(points)
        failed = {}
    image = np.repeat(np.arange(len(seen)), [len(p.tracks) for p in seen])
    tracks = np.concatenate([p.tracks for p in seen])
    return make_tracks(image, tracks, np.concatenate([p.pixels for p in seen])), tuple(linked)


def _fail(sequence: Sequence, options: BuildOptions, frame: int, counts: dict[int, int]) -> None:
    number = sequence.numbers
    shares = ", ".join(f"{count} with frame {number[j]}" for j, count in sorted(counts.items()))
    raise ProblemError(
        f"too few matches: frame {number[frame]} shares {shares}, at least {options.min_matches} are needed; "
        f"choose other --frames or --features, more --keypoints or fewer --min-matches"
    )
