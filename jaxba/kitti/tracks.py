"""Tracks: key-points of several images that are the same point of the scene; and the key-frames to
choose by them."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import Rotation

from jaxba.io.frames import Calibration
from jaxba.problem.bundle_problem import ProblemError
from jaxba.problem.geometry import perspective


@dataclass(frozen=True)
class Tracks:
    """A table of observations, sorted by track and then by image; no track has two in one image."""

    image: Int[np.ndarray, " n"]  # image of each observation: an index into a list of images
    track: Int[np.ndarray, " n"]  # track of each observation, numbered from 0 without gaps
    pixels: Float[np.ndarray, "n 2"]  # from the centre of the first pixel, x to the right, y down

    @property
    def count(self) -> int:
        """Number of tracks."""
        return int(self.track[-1]) + 1 if len(self.track) else 0

    @cached_property
    def _by_image(self) -> tuple[np.ndarray, np.ndarray]:
        """Rows sorted by image, and the first one of each image (one more entry than images)."""
        order = np.argsort(self.image, kind="stable")
        return order, np.searchsorted(
            self.image[order], np.arange(int(self.image.max(initial=-1)) + 2)
        )

    def rows_of_image(self, image: int) -> Int[np.ndarray, " m"]:
        """Rows of the observations in an image, in the order of their tracks."""
        order, start = self._by_image
        return order[start[image] : start[image + 1]] if 0 <= image < len(start) - 1 else order[:0]

    def rows_of_tracks(self, tracks: Int[np.ndarray, " k"]) -> Int[np.ndarray, " m"]:
        """Rows of all observations of some tracks (in ascending order), in the order of the
        table."""
        first, end = (np.searchsorted(self.track, tracks, side=side) for side in ("left", "right"))
        sizes = end - first
        return np.repeat(first - np.cumsum(sizes) + sizes, sizes) + np.arange(sizes.sum())

    def shared(self, a: int, b: int) -> tuple[Int[np.ndarray, " m"], Int[np.ndarray, " m"]]:
        """Rows of the tracks that both images see: those in image a, those in image b, in the same
        order."""
        rows_a = self.rows_of_image(a)
        rows_b = self.rows_of_image(b)
        _, at_a, at_b = np.intersect1d(self.track[rows_a], self.track[rows_b], return_indices=True)
        return rows_a[at_a], rows_b[at_b]

    def keep(self, rows: np.ndarray) -> Tracks:
        """The observations that a mask selects, of tracks that then still have two; tracks are
        renumbered."""
        image = self.image[rows]
        track = self.track[rows]
        pixels = self.pixels[rows]
        long = np.bincount(track, minlength=self.count)[track] >= 2
        return Tracks(image[long], np.unique(track[long], return_inverse=True)[1], pixels[long])

    def restrict(self, images: Sequence[int]) -> Tracks:
        """The observations of some images, renumbered 0, 1, ...; tracks with fewer than two are
        dropped."""
        new = np.full(int(self.image.max(initial=-1)) + 1, -1)
        wanted = np.asarray(images, int)
        new[wanted[wanted < len(new)]] = np.flatnonzero(wanted < len(new))
        kept = self.keep(new[self.image] >= 0)
        return Tracks(new[kept.image], kept.track, kept.pixels)


def make_tracks(image: np.ndarray, track: np.ndarray, pixels: np.ndarray) -> Tracks:
    """Tracks of two observations or more, from those in any order, with any numbers of tracks."""
    order = np.lexsort((image, track))
    track = np.unique(track[order], return_inverse=True)[1]
    table = Tracks(np.asarray(image)[order], track, np.asarray(pixels, np.float64)[order])
    return table.keep(np.ones(len(track), bool))


def join_matches(
    pixels: Sequence[Float[np.ndarray, "_ 2"]],
    matches: Mapping[tuple[int, int], Int[np.ndarray, "_ 2"]],
) -> Tracks:
    """Tracks from matches of pairs of images: the connected components of matched key-points.

    A component with two key-points of one image cannot be one point. It is split into the chains of
    matches between images next to each other: these are one to one, so a chain has no two
    key-points of one image. `pixels` are the key-points of every image; `matches` of a pair of
    images (i < j) are pairs of key-points, one to one."""
    sizes = [len(points) for points in pixels]
    first = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
    image = np.repeat(np.arange(len(pixels)), sizes)
    edges = {
        pair: first[list(pair)] + np.asarray(found, np.int64).reshape(-1, 2)
        for pair, found in matches.items()
    }
    label = _components(len(image), list(edges.values()))
    order = np.lexsort((image, label))
    twice = (np.diff(label[order]) == 0) & (np.diff(image[order]) == 0)
    bad = np.isin(label, label[order][1:][twice])
    chain = _components(len(image), [edge for (i, j), edge in edges.items() if j == i + 1])
    label = np.where(bad, len(image) + chain, label)
    return make_tracks(image, label, np.concatenate([np.empty((0, 2)), *pixels]))


def _components(count: int, edges: Sequence[np.ndarray]) -> np.ndarray:
    pairs = np.concatenate([np.empty((0, 2), np.int64), *edges])
    graph = coo_matrix(
        (np.ones(len(pairs), np.int8), (pairs[:, 0], pairs[:, 1])), shape=(count, count)
    )
    return connected_components(graph, directed=False)[1]


# median parallax of a key-frame of `auto`, pixels. VINS-Mono (Qin et al. 2018): 10 at focal length
# 460
PARALLAX = 10.0
SHARE = 0.5  # ... as it does when less than this share of the tracks of the last key-frame is left
MIN_SHARED = 20  # tracks that neighbouring key-frames must share, to estimate their relative pose


def parallax(
    first: Float[np.ndarray, "m 2"], second: Float[np.ndarray, "m 2"], focal: float
) -> float:
    """Median image motion in pixels that no rotation of the camera explains; zero for a camera that
    only rotates.

    The rotation is the least-squares fit to the rays, which absorbs a little of a translation where
    the scene is far.

    Rays are `(X / Z, Y / Z)`, the focal length is in pixels."""
    rotated = np.column_stack([first, np.ones(len(first))]) @ relative_rotation(first, second).T
    return float(focal * np.median(np.linalg.norm(perspective(rotated) - second, axis=1)))


def relative_rotation(
    first: Float[np.ndarray, "m 2"], second: Float[np.ndarray, "m 2"]
) -> Float[np.ndarray, "3 3"]:
    """The least-squares rotation from the rays of one view to those of another."""
    a, b = (np.column_stack([rays, np.ones(len(rays))]) for rays in (first, second))
    a, b = (rays / np.linalg.norm(rays, axis=1, keepdims=True) for rays in (a, b))
    return Rotation.align_vectors(b, a)[0].as_matrix()


def choose(
    tracks: Tracks, images: int, choice: str, calibration: Calibration, numbers: tuple[int, ...]
) -> list[int]:
    """Which of so many images are key-frames. The choice is `auto` (by parallax and by the share of
    tracks left), `all`, or a number N for every N-th; `numbers` are the frame numbers of the
    images, for messages. Raises ProblemError: the choice is none of these, the camera does not
    move, or neighbours share too few tracks."""
    if choice != "auto":
        step = 1 if choice == "all" else int(choice) if re.fullmatch(r"[1-9]\d{0,8}", choice) else 0
        if not step:
            raise ProblemError(
                f"--keyframes must be auto, all or a number such as 2, is {choice!r}"
            )
        chosen = list(range(0, images, step))
    else:
        chosen = [0]
        rays = calibration.rays(tracks.pixels)
        for i in range(1, images):
            a, b = tracks.shared(chosen[-1], i)
            own = len(tracks.rows_of_image(chosen[-1]))
            if (
                len(a) < max(SHARE * own, MIN_SHARED)
                or parallax(rays[a], rays[b], calibration.fx) >= PARALLAX
            ):
                chosen.append(i)
    if len(chosen) < 2:
        where = f"frames {numbers[0]} to {numbers[images - 1]}"
        if choice == "auto":
            raise ProblemError(f"the camera hardly moves in {where}: one key-frame")
        raise ProblemError(
            f"--keyframes {choice} leaves one key-frame of {images} in {where}, not 2"
        )
    for i, j in pairwise(chosen):
        shared = len(tracks.shared(i, j)[0])
        if shared < MIN_SHARED:
            raise ProblemError(
                f"too few matches: key-frames {numbers[i]} and {numbers[j]} share {shared} tracks, "
                f"at least {MIN_SHARED} are needed; choose --keyframes all, or other --frames"
            )
    return chosen
