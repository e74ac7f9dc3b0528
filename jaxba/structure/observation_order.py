"""Observations sorted by point, then by camera. Computed once per solve, for cost model, padding and layout."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Int

from jaxba.problem.bundle_problem import BundleProblem
from jaxba.structure.sum_trees import sorted_by


@dataclass(frozen=True)
class ObservationOrder:
    """The observations of a problem, sorted by point, then by camera."""

    order: Int[np.ndarray, " observations"]  # index in the problem of each sorted observation
    camera: Int[np.ndarray, " observations"]  # camera of each sorted observation
    point: Int[np.ndarray, " observations"]  # point of each sorted observation
    tracks: Int[np.ndarray, " points"]  # number of observations of each point
    num_cameras: int  # number of cameras, observed or not

    @classmethod
    def of(cls, problem: BundleProblem) -> ObservationOrder:
        """Sorts the observations of a problem in linear time; ties keep the order of the problem."""
        camera, point = np.asarray(problem.camera_index), np.asarray(problem.point_index)
        cameras, points = len(problem.cameras), len(problem.points)
        order = sorted_by(camera, cameras)
        order = order[sorted_by(point[order], points)]
        return cls(order, camera[order], point[order], np.bincount(point, minlength=points), cameras)

    @cached_property
    def start(self) -> Int[np.ndarray, " points_and_one"]:
        """Position of the first observation of each point; the last entry is the number of observations."""
        return np.concatenate([[0], np.cumsum(self.tracks)])

    @cached_property
    def num_pairs(self) -> int:
        """Number of unordered pairs of observations of one point, an observation with itself included."""
        tracks = self.tracks.astype(np.int64)
        return int(np.sum(tracks * (tracks + 1) // 2))

    @cached_property
    def num_repeated_pairs(self) -> int:
        """Number of pairs of different observations of one point by one camera."""
        new = np.ones(len(self.order), bool)
        new[1:] = (np.diff(self.point) != 0) | (np.diff(self.camera) != 0)
        times = np.diff(np.append(np.flatnonzero(new), len(new)))
        return int(np.sum(times * (times - 1) // 2))

    @property
    def num_listed_pairs(self) -> int:
        """Number of pairs as a layout lists them: if a camera sees a point twice, in both orders (covisibility.py)."""
        return self.num_pairs + self.num_repeated_pairs

    @cached_property
    def num_observed_points(self) -> int:
        """Number of points with at least one observation."""
        return int(np.count_nonzero(self.tracks))
