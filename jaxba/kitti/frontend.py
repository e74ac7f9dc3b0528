"""The front end: tracks over the frames of a sequence. The result of every frame and pair is cached on disk."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import NamedTuple

import numpy as np

from jaxba.kitti.features import Features, KeyPoints, Verified, detect, epipolar_inliers, match
from jaxba.kitti.images import image_reader, spare_bits, stamp
from jaxba.kitti.klt import TrackedPoints, detect_corners, track
from jaxba.kitti.opencv import cv2
from jaxba.kitti.result_cache import ResultCache, digest
from jaxba.kitti.sequence import Sequence
from jaxba.kitti.tracks import Tracks, join_matches, make_tracks
from jaxba.problem.bundle_problem import ProblemError

Report = Callable[[str, int, int], None]
"""Called with the name of a stage, how much of it is done, and how much there is."""

MIN_MATCHES = 40
"""Verified matches that link two frames: random matches of textured images reach some 15 inliers."""


@dataclass(frozen=True)
class FrontEndOptions:
    """Options of the tracks."""

    features: Features = "sift"
    """Kind of key-points, or `klt` for points tracked by Lucas-Kanade."""

    keypoints: int = 2000
    """Largest number of key-points of a frame."""

    reach: int = 3
    """Number of earlier frames that a frame is matched with; for KLT, of bad frames in a row after which it fails."""

    min_matches: int = MIN_MATCHES
    """Verified matches that link two frames."""

    seed: int = 0
    """Seed of every random sample."""


class Linked(NamedTuple):
    """Tracks over the frames that are linked with the first one."""

    tracks: Tracks  # images are positions in `frames`
    frames: tuple[int, ...]  # positions in the sequence


class _Step(NamedTuple):
    """Result of tracking points from one frame to the next."""

    tracks: np.ndarray
    pixels: np.ndarray
    next_track: np.ndarray
    old: np.ndarray  # how many points were tracked, shape ()


def link(sequence: Sequence, options: FrontEndOptions, cache: ResultCache, report: Report) -> Linked:
    """Tracks over a sequence.

    A frame that cannot be linked with one of the `reach` frames before it is left out; too many such frames in a row
    are an error.

    Raises:
        ProblemError: an image cannot be read, or frames cannot be linked: the message names them.
    """
    stamps = [stamp(path) for path in sequence.images]
    return (_track_points if options.features == "klt" else _match_features)(sequence, options, cache, report, stamps)


def _match_features(
    sequence: Sequence, options: FrontEndOptions, cache: ResultCache, report: Report, stamps: list[str]
) -> Linked:
    read = image_reader(sequence)
    kind = (options.features, options.keypoints, cv2.__version__, spare_bits(sequence))
    recent: deque[KeyPoints] = deque(maxlen=options.reach + 1)  # descriptors of a whole sequence would fill gigabytes
    pixels: list[np.ndarray] = []
    matches: dict[tuple[int, int], np.ndarray] = {}
    for j, number in enumerate(sequence.numbers):
        report("key-points and matches", j, len(sequence))
        key = digest("points", kind, stamps[j])
        recent.append(cache.get(f"points-{number:06d}-{key}", KeyPoints, lambda j=j: detect(read(j), *kind[:2])))
        pixels.append(recent[-1].pixels)
        for i in range(max(j - options.reach, 0), j):
            key = digest("match", kind, stamps[i], stamps[j], asdict(sequence.calibration), options.seed)
            name = f"match-{sequence.numbers[i]:06d}-{number:06d}-{key}"
            make = lambda a=recent[i - j - 1], b=recent[-1]: _verify(a, b, sequence, options.seed)
            matches[i, j] = np.stack(cache.get(name, Verified, make), axis=1)
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
    return Linked(join_matches([pixels[i] for i in linked], strong), tuple(linked))


def _verify(a: KeyPoints, b: KeyPoints, sequence: Sequence, seed: int) -> Verified:
    pairs = match(a, b)
    good = epipolar_inliers(a.pixels[pairs[:, 0]], b.pixels[pairs[:, 1]], sequence.calibration, seed)
    return Verified(*pairs[good].T)


def _track_points(
    sequence: Sequence, options: FrontEndOptions, cache: ResultCache, report: Report, stamps: list[str]
) -> Linked:
    read = image_reader(sequence)
    count, calibration = options.keypoints, sequence.calibration
    key = digest("klt", asdict(options), asdict(calibration), cv2.__version__, stamps[0])
    name = f"klt-{sequence.numbers[0]:06d}-{key}"
    points = cache.get(name, TrackedPoints, lambda: detect_corners(read(0), count))
    linked, seen, failed = [0], [points], {}
    for j in range(1, len(sequence)):
        report("tracking", j, len(sequence))
        i = linked[-1]
        key = digest(key, stamps[i], stamps[j])

        def make(i: int = i, j: int = j, points: TrackedPoints = points) -> _Step:
            found, old = track(read(i), read(j), points, count, calibration, options.seed)
            return _Step(*found, np.array(old))

        step = cache.get(f"klt-{sequence.numbers[j]:06d}-{key}", _Step, make)
        if int(step.old) < options.min_matches:
            failed[j] = int(step.old)
            if j - i >= options.reach or (j == len(sequence) - 1 and len(linked) == 1):
                _fail(sequence, options, i, failed)
            continue
        points = TrackedPoints(*step[:3])
        linked.append(j)
        seen.append(points)
        failed = {}
    image = np.repeat(np.arange(len(seen)), [len(p.tracks) for p in seen])
    tracks = np.concatenate([p.tracks for p in seen])
    return Linked(make_tracks(image, tracks, np.concatenate([p.pixels for p in seen])), tuple(linked))


def _fail(sequence: Sequence, options: FrontEndOptions, frame: int, counts: dict[int, int]) -> None:
    number = sequence.numbers
    shares = ", ".join(f"{count} with frame {number[j]}" for j, count in sorted(counts.items()))
    raise ProblemError(
        f"too few matches: frame {number[frame]} shares {shares}, at least {options.min_matches} are needed; "
        f"choose other --frames or --features, more --keypoints or fewer --min-matches"
    )
