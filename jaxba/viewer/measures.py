"""How well a problem's points and images fit: reprojection errors, track lengths, the worst
images."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int, UInt8

from jaxba.problem import geometry
from jaxba.problem.bundle_problem import BundleProblem

# matplotlib's, at quarters
VIRIDIS = ((68, 1, 84), (59, 82, 139), (33, 145, 140), (94, 201, 98), (253, 231, 37))


class Measures(NamedTuple):
    """How well a problem fits. What is not observed, or not projected to a finite pixel, is NaN."""

    # measured minus predicted, pixels of the problem
    residuals: Float[np.ndarray, "observations 2"]
    of_point: Float[np.ndarray, " points"]  # root mean square length of its residuals, pixels
    of_image: Float[np.ndarray, " cameras"]  # the same of each image
    tracks: Int[np.ndarray, " points"]  # number of observations of each point
    seen: Int[np.ndarray, " cameras"]  # the same of each image

    @property
    def rmse(self) -> float:
        """Root mean square length of all residuals, pixels."""
        return float(np.sqrt(np.nanmean((self.residuals**2).sum(axis=1))))

    def worst(self) -> Int[np.ndarray, " images"]:
        """Observed images, the worst first."""
        order = np.argsort(-self.of_image, kind="stable")  # NaN comes last
        return order[np.isfinite(self.of_image[order])]


def measure(problem: BundleProblem) -> Measures:
    """The measures of a problem; whitening and robust losses do not enter."""
    residuals = np.asarray(problem.observations) - geometry.project(problem)
    residuals[~np.isfinite(residuals).all(axis=1)] = np.nan
    square = (residuals**2).sum(axis=1)

    def mean(index: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
        finite = np.isfinite(square)
        seen = np.bincount(index, minlength=count)
        total = np.bincount(index[finite], weights=square[finite], minlength=count)
        number = np.bincount(index[finite], minlength=count)
        return np.sqrt(np.where(number > 0, total / np.maximum(number, 1), np.nan)), seen

    of_point, tracks = mean(np.asarray(problem.point_index), problem.num_points)
    of_image, seen = mean(np.asarray(problem.camera_index), problem.num_cameras)
    return Measures(residuals, of_point, of_image, tracks, seen)


def limits(values: Float[np.ndarray, " n"]) -> tuple[float, float]:
    """Between which values colours change: most of the positive ones."""
    usable = values[np.isfinite(values) & (values > 0)]
    if not len(usable):
        return 1.0, 2.0
    low, high = np.percentile(usable, [5, 95])
    return float(low), float(max(high, 1.001 * low))


def colours(values: Float[np.ndarray, " n"], low: float, high: float) -> UInt8[np.ndarray, "n 3"]:
    """Colours of positive values on a logarithmic scale from `low` to `high`; the brightest where
    there is no value."""
    with np.errstate(divide="ignore", invalid="ignore"):
        place = np.log(values / low) / np.log(high / low)
    place = np.nan_to_num(place, nan=1.0, posinf=1.0, neginf=0.0)
    at = np.linspace(0, 1, len(VIRIDIS))
    return np.stack(
        [np.interp(place, at, channel) for channel in zip(*VIRIDIS, strict=True)], axis=1
    ).astype(np.uint8)
