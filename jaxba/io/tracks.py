"""Points with lists of their views, as Bundler and VisualSFM write them.

A point is its position, its colour, the number of its views, and for each view a camera, a key-point, x and y.
"""

from __future__ import annotations

from bisect import bisect_right
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxba.io.text import Text
from jaxba.problem.bundle_problem import ProblemError
from jaxba.typing import LARGEST_COUNT

POINT_FIELDS = ("x", "y", "z", "red", "green", "blue", "number of views")
VIEW_FIELDS = ("camera index", "key", "x", "y")


class Tracks(NamedTuple):
    """Points and their views, in the order of the file."""

    points: Float[np.ndarray, "points 3"]
    camera_index: Int[np.ndarray, " observations"]
    point_index: Int[np.ndarray, " observations"]
    pixels: Float[np.ndarray, "observations 2"]
    end: int
    """Position after the last number of the last view."""


def read_tracks(text: Text, start: int, count: int, num_cameras: int) -> Tracks:
    """Reads `count` points from the position of the first one's x among the numbers of a text, whose `field` describes
    those before the points. Raises ProblemError: the file ends early, or something is no number or out of range; or
    there are no views."""
    values, before, starts, end = text.values, text.field, [], start

    def field(ordinal: int) -> str:
        point = bisect_right(starts, ordinal) - 1
        return before(ordinal) if point < 0 else _point_field(point, ordinal - starts[point])

    text.field = field
    for _ in range(count):
        starts.append(end)
        text.need(end + len(POINT_FIELDS))
        views = float(values[end + 6])
        if not 0 <= views <= LARGEST_COUNT or not views.is_integer():
            text.integers([end + 6], 0, LARGEST_COUNT)
        end += len(POINT_FIELDS) + len(VIEW_FIELDS) * int(views)
        text.need(end)
    first_view = np.array(starts, dtype=np.int64) + len(POINT_FIELDS)
    views = values[first_view - 1].astype(np.int64)
    at = np.repeat(first_view - 4 * (np.cumsum(views) - views), views) + 4 * np.arange(views.sum())
    camera_index = text.integers(at, 0, num_cameras - 1)
    if not camera_index.size:
        raise ProblemError(f"{text.name}: no camera sees a point")
    points = values[first_view[:, None] - len(POINT_FIELDS) + np.arange(3)]
    return Tracks(points, camera_index, np.repeat(np.arange(count), views), values[at[:, None] + [2, 3]], end)


def _point_field(point: int, at: int) -> str:
    if at < len(POINT_FIELDS):
        return f"{POINT_FIELDS[at]} of point {point}"
    view, part = divmod(at - len(POINT_FIELDS), len(VIEW_FIELDS))
    return f"{VIEW_FIELDS[part]} of view {view} of point {point}"


def numbered(index: Int[np.ndarray, " n"]) -> Int[np.ndarray, " n"]:
    """For each entry how many of the same value stand before it: numbers of key-points, from an index of cameras."""
    order, counts = np.argsort(index, kind="stable"), np.bincount(index)
    numbers = np.empty(len(index), np.int64)
    numbers[order] = np.arange(len(order)) - np.repeat(np.cumsum(counts) - counts, counts)
    return numbers
