"""A part of a problem: some of its images, as after each new image of an incremental
reconstruction.

Everything keeps its place and its labels, so that the whole can be written with what was found."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Int

from jaxba.problem.bundle_problem import BundleProblem, NothingObserved
from jaxba.problem.hold import Which, every_lens, hold, mask_of
from jaxba.problem.options import check_count
from jaxba.problem.preprocess import observed

FEW = 0.5
"""Share of observed cameras, or points, below which a problem is solved without the others: their
rows in the reduced camera system, and their places in the arrays, cost more than the copies."""


def part(
    problem: BundleProblem,
    *,
    images: Which = "all",
    points: Which = (),
    ignored: Which = (),
    min_track: int = 0,
) -> BundleProblem:
    """The problem of some images, with all else as it is.

    What `images` see counts, and what others see of `points`; those others are constant, and so are
    lenses that no chosen image has. A point that is seen by more images than count is constant,
    unless it is one of `points`. Source: COLMAP, `BundleAdjustmentConfig` and `AddImageToProblem`,
    `AddPointToProblem`.

    Args:
        problem: any problem; its other residuals stay.
        images: the images whose poses are optimised.
        points: points that are optimised with all that is seen of them.
        ignored: points that do not count.
        min_track: fewest observations of a point, in all of the problem, with which it counts.

    Raises ValueError: no such image or point, or no count. Raises NothingObserved, a ProblemError:
        nothing is left."""
    check_count("min_track", min_track, 0)
    camera = np.asarray(problem.camera_index)
    point = np.asarray(problem.point_index)
    mine = mask_of(problem, images, problem.num_cameras, "image")
    whole, dropped = (
        mask_of(problem, which, problem.num_points, "point") for which in (points, ignored)
    )
    tracks = np.bincount(point, minlength=problem.num_points)
    counts = (mine[camera] | whole[point]) & ~dropped[point] & (tracks >= min_track)[point]
    if not counts.any():
        raise NothingObserved("no observation is left of this part of the problem")
    left = np.bincount(point[counts], minlength=problem.num_points)
    lenses = every_lens(problem)
    used = np.bincount(np.asarray(lenses.index)[mine], minlength=len(lenses.free)) > 0
    poses = ~mine
    rigs = problem.rigs
    if rigs is not None:  # frames without a chosen image, by what says where they are
        poses = ~np.isin(rigs.frame, np.asarray(rigs.frame)[mine])
        poses &= True if rigs.free is None else ~np.asarray(rigs.free)
    away = {"poses": poses, "lenses": ~used, "extrinsics": ~used}
    return hold(problem.subset(counts), points=(left < tracks) & (left > 0) & ~whole, **away)


class Observed(NamedTuple):
    """The cameras and points of a problem with which it is solved."""

    problem: BundleProblem
    cameras: Int[np.ndarray, " observed"]  # where they are in the whole
    points: Int[np.ndarray, " seen"]

    def whole(self, of: BundleProblem, found: BundleProblem) -> BundleProblem:
        """The whole problem with the parameters found of this one. Cameras that nothing sees follow
        their lens."""
        if self.problem is of:
            return found
        cameras = np.array(of.cameras, np.float64)
        points = np.array(of.points, np.float64)
        cameras[self.cameras], points[self.points] = found.cameras, found.points
        lens = np.asarray(every_lens(of).index)
        used, first = np.unique(lens[self.cameras], return_index=True)
        follows = np.isin(lens, used)
        cameras[follows, 6:] = cameras[
            self.cameras[first[np.searchsorted(used, lens[follows])]], 6:
        ]
        return of.replace(cameras=cameras, points=points)


def observed_part(problem: BundleProblem) -> Observed:
    """The observed part of a problem, if that is few of its cameras or points; all of it otherwise,
    and with rigs and residuals, which say more of cameras than pixels do."""
    every = Observed(
        problem, *(np.arange(count) for count in (problem.num_cameras, problem.num_points))
    )
    if problem.rigs is not None or problem.residuals:
        return every
    cameras, points = map(np.flatnonzero, observed(problem))
    if len(cameras) >= FEW * problem.num_cameras and len(points) >= FEW * problem.num_points:
        return every
    labels = None if problem.labels is None else problem.labels.of(cameras, points)
    found = problem.subset(np.ones(problem.num_observations, bool), cameras, points)
    return Observed(found.replace(labels=labels), cameras, points)
