"""Observations sorted by point, then by camera. Computed once per solve, for cost model, padding
and layout."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Int

from jaxba.problem.bundle_problem import BundleProblem
from jaxba.problem.frames import free_poses
from jaxba.problem.hold import every_lens
from jaxba.structure.sum_trees import sorted_by


@dataclass(frozen=True)
class ObservationOrder:
    """The observations of a problem, sorted by point, then by camera."""

    order: Int[np.ndarray, " observations"]  # index in the problem of each sorted observation
    camera: Int[np.ndarray, " observations"]  # camera of each sorted observation
    point: Int[np.ndarray, " observations"]  # point of each sorted observation
    tracks: Int[np.ndarray, " points"]  # number of observations of each point
    num_cameras: int  # number of cameras, observed or not
    # whether something of the camera of each sorted observation is optimised
    moves: Bool[np.ndarray, " observations"]

    @classmethod
    def of(cls, problem: BundleProblem) -> ObservationOrder:
        """Sorts the observations of a problem in linear time; ties keep the order of the
        problem."""
        camera = np.asarray(problem.camera_index)
        point = np.asarray(problem.point_index)
        cameras = len(problem.cameras)
        points = len(problem.points)
        order = sorted_by(camera, cameras)
        order = order[sorted_by(point[order], points)]
        tracks = np.bincount(point, minlength=points)
        return cls(
            order,
            camera[order],
            point[order],
            tracks,
            cameras,
            _moving_cameras(problem)[camera[order]],
        )

    @cached_property
    def moving_tracks(self) -> Int[np.ndarray, " points"]:
        """Number of observations of each point by cameras of which something is optimised."""
        return np.bincount(self.point[self.moves], minlength=len(self.tracks))

    @cached_property
    def num_pairs(self) -> int:
        """Number of unordered pairs of observations of one point by cameras of which something is
        optimised, an observation with itself included. Others add nothing to the reduced camera
        system."""
        tracks = self.moving_tracks.astype(np.int64)
        return int(np.sum(tracks * (tracks + 1) // 2))

    @cached_property
    def num_repeated_pairs(self) -> int:
        """Number of these pairs that are different observations of one point by one camera."""
        point = self.point[self.moves]
        camera = self.camera[self.moves]
        new = np.ones(len(point), bool)
        new[1:] = (np.diff(point) != 0) | (np.diff(camera) != 0)
        times = np.diff(np.append(np.flatnonzero(new), len(new)))
        return int(np.sum(times * (times - 1) // 2))

    @property
    def num_listed_pairs(self) -> int:
        """Number of pairs as a layout lists them: if a camera sees a point twice, in both orders
        (covisibility.py)."""
        return self.num_pairs + self.num_repeated_pairs

    @cached_property
    def num_observed_points(self) -> int:
        """Number of points with at least one observation."""
        return int(np.count_nonzero(self.tracks))


def _moving_cameras(problem: BundleProblem) -> Bool[np.ndarray, " cameras"]:
    """Of which cameras something is optimised, of a problem `in_frames`: of pose, lens, or a block
    of a residual."""
    if problem.residuals.sizes:
        return np.ones(len(problem.cameras), bool)
    lenses = every_lens(problem)
    lens_of_camera = np.asarray(lenses.index)
    free_lenses = np.any(lenses.free, axis=1, keepdims=True)
    free = np.hstack([free_poses(problem), free_lenses[lens_of_camera]])
    return np.logical_or.reduce(free, axis=1)
