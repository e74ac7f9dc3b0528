"""Marks: surveyed points that a problem gets besides its own, with observations, and loses before
it is written."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxba.problem import geometry
from jaxba.problem.bundle_problem import BundleProblem
from jaxba.typing import ArrayRecord


@dataclass(frozen=True, eq=False, repr=False)
class Marks(ArrayRecord):
    """Surveyed points of a problem: its last ones."""

    names: tuple[str, ...]
    """What they are called."""

    places: Float[np.ndarray, "marks 3"]
    """Measured positions, scene units."""

    stddev: Float[np.ndarray, "marks 3"]
    """Standard deviations of these along x, y and z."""

    check: Bool[np.ndarray, " marks"]
    """Which do not count in the solve, and check it."""

    def without(self, problem: BundleProblem) -> BundleProblem:
        """The problem without them, as it was before `with_marks`."""
        kept = np.arange(problem.num_points - len(self.names))
        labels = problem.labels
        found = problem.subset(np.asarray(problem.point_index) < len(kept), points=kept)
        return found.replace(labels=None if labels is None else labels.of(slice(None), kept))


def of_marks(problem: BundleProblem) -> Bool[np.ndarray, " observations"]:
    """Which observations are pixels of marks."""
    count = 0 if problem.labels is None else len(problem.labels.marks)
    return np.asarray(problem.point_index) >= problem.num_points - count


def whitening_of(problem: BundleProblem) -> Float[np.ndarray, "observations 2 2"]:
    """`BundleProblem.whitening`, also where that is the identity."""
    if problem.whitening is None:
        return np.tile(np.eye(2), (problem.num_observations, 1, 1))
    return np.asarray(problem.whitening)


class Found(NamedTuple):
    """How a problem has surveyed points."""

    difference: Float[np.ndarray, "n 3"]  # position less the measured one, scene units
    images: Int[np.ndarray, " n"]  # how many see each
    pixels: Float[np.ndarray, " n"]  # RMS residual; NaN where nothing sees it
    whitened: Float[np.ndarray, " n"]  # RMS of x, y and z in standard deviations


def found_at(
    problem: BundleProblem,
    at: Int[np.ndarray, " n"],
    places: Float[np.ndarray, "n 3"],
    stddev: Float[np.ndarray, "n 3"],
) -> Found:
    """How a problem has points that were measured at some places, to standard deviations along x, y
    and z."""
    own = np.isin(np.asarray(problem.point_index), at)
    seen = problem.subset(own)
    squares = np.sum((np.asarray(seen.observations) - geometry.project(seen)) ** 2, axis=1)
    images = np.bincount(seen.point_index, minlength=problem.num_points)[at]
    total = np.bincount(seen.point_index, squares, problem.num_points)[at]
    difference = np.asarray(problem.points)[at] - places
    pixels = np.sqrt(total / np.where(images, images, np.nan))
    return Found(difference, images, pixels, np.sqrt(np.mean((difference / stddev) ** 2, axis=1)))


def with_marks(
    problem: BundleProblem,
    image: Int[np.ndarray, " pixels"],
    mark: Int[np.ndarray, " pixels"],
    pixels: Float[np.ndarray, "pixels 2"],
    sigma: float,
    names: tuple[str, ...],
) -> BundleProblem:
    """A problem without constants with marks of some names as its last points, seen by images at
    pixels.

    They start in the middle of what the first of their images sees.

    Args:
        problem: what the marks are added to.
        image: image of each pixel.
        mark: mark of each pixel, a position in `names`.
        pixels: as in `observations`.
        sigma: standard deviation of each number of a pixel, pixels.
        names: names of the marks."""
    count = len(names)
    points, camera, point = map(
        np.asarray, (problem.points, problem.camera_index, problem.point_index)
    )
    seen = [points[point[camera == image[mark == one][0]]] for one in range(count)]
    starts = np.stack([np.median(own if len(own) else points, axis=0) for own in seen])

    def joined(old, new):
        return np.concatenate([np.asarray(old), np.asarray(new)]).astype(np.asarray(old).dtype)

    changes: dict[str, Any] = {
        "points": joined(points, starts),
        "observations": joined(problem.observations, pixels),
    }
    changes |= {
        "camera_index": joined(camera, image),
        "point_index": joined(point, mark + len(points)),
    }
    if problem.whitening is not None or sigma != 1.0:
        changes["whitening"] = joined(
            whitening_of(problem), np.tile(np.eye(2) / sigma, (len(pixels), 1, 1))
        )
    if (labels := problem.labels) is not None:
        ids = labels.points.max(initial=0) + 1 + np.arange(count)
        changes["labels"] = replace(labels, points=joined(labels.points, ids), marks=names)
    return problem.replace(**changes)
