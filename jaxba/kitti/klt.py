"""Points tracked from image to image: Shi-Tomasi corners on a grid, pyramidal Lucas-Kanade, forward-backward check."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxba.io.frames import Calibration
from jaxba.kitti.features import epipolar_inliers
from jaxba.kitti.opencv import cv2

WINDOW = 21
"""Side of the tracked window, pixels. Source: OpenCV's default."""

LEVELS = 4
"""Levels of the image pyramid above the image: for motions of up to some 150 pixels between frames."""

ROUND_TRIP = 0.7
"""Largest distance in pixels of a point from itself tracked forward and backward. Source: Kalal et al. 2010,
"Forward-backward error"."""

CELL = 48
"""Side of a grid cell, pixels. Every cell has the same number of corners."""

DISTANCE = 8
"""Least distance between points, pixels."""

QUALITY = 0.003
"""Least eigenvalue of a corner, as a share of the image's largest."""


class TrackedPoints(NamedTuple):
    """Points in an image."""

    tracks: Int[np.ndarray, " n"]  # numbers of their tracks, ascending
    pixels: Float[np.ndarray, "n 2"]
    next_track: np.ndarray  # number of the next new track, shape ()
    old: np.ndarray  # how many of the points were tracked from the image before, shape ()


def detect_corners(image: np.ndarray, count: int) -> TrackedPoints:
    """Corners of the first image."""
    return _replenish(image, TrackedPoints(np.empty(0, np.int64), np.empty((0, 2)), np.array(0), np.array(0)), count)


def track(
    before: np.ndarray, after: np.ndarray, points: TrackedPoints, count: int, calibration: Calibration, seed: int
) -> TrackedPoints:
    """The points in the next image, with new corners in empty cells of the grid.

    Args:
        before: grey image of `points`.
        after: the next one.
        points: in `before`.
        count: number of points wanted in an image.
        calibration: for the check against the epipolar geometry.
        seed: of its samples.
    """
    found, good = _lucas_kanade(before, after, points.pixels)
    kept = np.flatnonzero(good)
    kept = kept[epipolar_inliers(points.pixels[kept], found[kept], calibration, seed)]
    old = TrackedPoints(points.tracks[kept], found[kept], points.next_track, np.array(len(kept)))
    return _replenish(after, old, count)


def _lucas_kanade(before: np.ndarray, after: np.ndarray, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    if not len(pixels):
        return pixels, np.zeros(0, bool)
    options = {
        "winSize": (WINDOW, WINDOW),
        "maxLevel": LEVELS,
        "criteria": (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 30, 0.01),
    }
    origin = pixels.astype(np.float32)[:, None]
    there, ok, _ = cv2.calcOpticalFlowPyrLK(before, after, origin, None, **options)  # type: ignore[call-overload]
    back, ok_back, _ = cv2.calcOpticalFlowPyrLK(after, before, there, None, **options)  # type: ignore[call-overload]
    found = np.asarray(there)[:, 0].astype(np.float64)
    trip = np.linalg.norm(np.asarray(back)[:, 0] - origin[:, 0], axis=1)
    height, width = after.shape
    inside = ((found >= 0) & (found <= [width - 1, height - 1])).all(axis=1)
    return found, (ok.ravel() > 0) & (ok_back.ravel() > 0) & (trip <= ROUND_TRIP) & inside


def _replenish(image: np.ndarray, points: TrackedPoints, count: int) -> TrackedPoints:
    """Adds corners in cells that have too few, none near an existing point."""
    height, width = image.shape
    response = np.asarray(cv2.cornerMinEigenVal(image, 3))
    peak = np.asarray(cv2.dilate(response, np.ones((2 * DISTANCE + 1, 2 * DISTANCE + 1), np.uint8)))
    corner = (response == peak) & (response > max(QUALITY * float(response.max()), 0.0))
    taken = np.ones((height, width), np.uint8)
    for x, y in np.rint(points.pixels).astype(int).tolist():
        cv2.circle(taken, (x, y), DISTANCE, 0, -1)
    corner &= taken > 0
    margin = WINDOW // 2
    corner[:margin], corner[-margin:], corner[:, :margin], corner[:, -margin:] = False, False, False, False
    y, x = np.nonzero(corner)
    columns = -(-width // CELL)
    cells = columns * -(-height // CELL)
    share = -(-count // cells)
    cell = (y // CELL) * columns + x // CELL
    order = np.lexsort((x, y, -response[y, x], cell))
    rank = np.arange(len(order)) - np.searchsorted(cell[order], cell[order])  # within its cell, the strongest first
    old = np.rint(points.pixels).astype(int)
    load = np.bincount((old[:, 1] // CELL) * columns + old[:, 0] // CELL, minlength=cells)
    new = order[rank < (share - load)[cell[order]]]
    first = int(points.next_track)
    return TrackedPoints(
        np.concatenate([points.tracks, first + np.arange(len(new))]),
        np.concatenate([points.pixels, np.stack([x[new], y[new]], axis=1).astype(np.float64)]),
        np.array(first + len(new)),
        points.old,
    )
