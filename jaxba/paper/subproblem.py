"""Sub-problems: some cameras of a problem, and the points that at least two of them observe."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Int
from scipy.sparse import csr_matrix

from jaxba.bench.sources import Source
from jaxba.problem.bundle_problem import BundleProblem, ProblemError
from jaxba.problem.preprocess import MIN_TRACK


def sub_problem(
    problem: BundleProblem,
    cameras: Sequence[int] | Int[np.ndarray, " kept"],
    points: Sequence[int] | None = None,
) -> BundleProblem:
    """The problem restricted to some cameras and to those points, of the given ones or of all, that
    at least two of them observe, in the same order. Raises ProblemError: an index is out of range,
    or no point is left."""
    kept = np.unique(np.asarray(cameras, int))
    allowed = (
        np.arange(problem.num_points) if points is None else np.unique(np.asarray(points, int))
    )
    for name, numbers, count in (
        ("camera", kept, problem.num_cameras),
        ("point", allowed, problem.num_points),
    ):
        if numbers.size and not 0 <= numbers[0] <= numbers[-1] < count:
            raise ProblemError(
                f"there is no {name} {numbers[0] if numbers[0] < 0 else numbers[-1]} among {count}"
            )
    camera_index = np.asarray(problem.camera_index)
    point_index = np.asarray(problem.point_index)
    keep = np.isin(camera_index, kept) & np.isin(point_index, allowed)
    pairs = np.unique(np.stack([point_index[keep], camera_index[keep]]), axis=1)
    # of distinct cameras: one may observe a point twice
    tracks = np.bincount(pairs[0], minlength=problem.num_points)
    keep &= tracks[point_index] >= MIN_TRACK
    if not keep.any():
        raise ProblemError(f"no point is seen by two of these {len(kept)} cameras")
    return problem.subset(keep, kept, np.flatnonzero(tracks >= MIN_TRACK))


def neighbouring_cameras(problem: BundleProblem, count: int) -> Int[np.ndarray, " cameras"]:
    """Cameras with many common points, chosen greedily.

    The first is the camera that observes most points. The next shares most points with those
    chosen; of equals, the first. Returns sorted indices. Raises ProblemError: the problem has fewer
    cameras."""
    if not 1 <= count <= problem.num_cameras:
        raise ProblemError(f"cannot take {count} of {problem.num_cameras} cameras")
    pairs = np.asarray(problem.camera_index), np.asarray(problem.point_index)
    seen = csr_matrix(
        (np.ones(len(pairs[0]), np.int64), pairs), (problem.num_cameras, problem.num_points)
    )
    seen.data[:] = 1  # a camera may observe a point twice
    chosen = [int(np.argmax(seen.getnnz(axis=1)))]
    shared = np.zeros(problem.num_cameras, int)
    covered = np.zeros(problem.num_points, bool)
    free = np.ones(problem.num_cameras, bool)
    while len(chosen) < count:
        free[chosen[-1]] = False
        new = np.zeros(problem.num_points, np.int64)
        new[seen[chosen[-1]].indices] = 1
        shared += seen @ (new * ~covered)
        covered |= new > 0
        chosen.append(int(np.argmax(np.where(free, shared, -1))))
    return np.sort(np.array(chosen))


def neighbourhood(whole: Source, count: int) -> Source:
    """The sub-problem of so many neighbouring cameras of a problem, which is read with it."""

    def make() -> BundleProblem:
        problem = whole.read()
        return sub_problem(problem, neighbouring_cameras(problem, count))

    return Source(f"{whole.name}-first{count}", whole.family, whole.location, make)
