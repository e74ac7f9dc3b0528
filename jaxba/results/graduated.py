"""Bundle adjustment with many wrong matches: graduated non-convexity, which rejects them.

A robust loss with a narrow scale ignores wrong matches, and at a bad start the right ones, too. So
the scale falls from the residuals of the start to those of right matches. The loss is Geman and
McClure's, `s / (1 + s)`. Its weights `1 / (1 + s)^2` are constant during a stage: each is a
weighted least-squares problem of a few iterations. (Measured: with the loss itself in the solve,
most steps are rejected, since points of wrong matches alone are free to run away.)

An image that starts at a wrong place is left without right matches. It is tried again at the pose
of the image that shares most points with it, alone, with the points constant.

Source: Black, Rangarajan 1996, "On the unification of line processes, outlier rejection, and robust
statistics" (weights in the place of a loss); Yang, Antonante, Tzoumas, Carlone 2020, "Graduated
non-convexity for robust spatial perception"; Zach 2014, "Robust bundle adjustment revisited" (the
same weights in bundle adjustment)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxba.damping import DampingPolicy
from jaxba.problem import geometry
from jaxba.problem.bundle_problem import BundleProblem, ProblemError
from jaxba.problem.constants import constants_of
from jaxba.problem.facing import facing_away, views_behind
from jaxba.problem.hold import hold
from jaxba.problem.intrinsics import POSE_SIZE
from jaxba.problem.losses import Loss
from jaxba.problem.preprocess import MIN_TRACK, observed
from jaxba.problem.residuals import Residuals
from jaxba.results.consecutive import Consecutive, with_parameters
from jaxba.solver.drivers import Callback, Watch
from jaxba.solver.options import SolveOptions, checked_options
from jaxba.solver.place import NO_CAMERAS, check_problem
from jaxba.solver.prepare import DEFAULT_POLICY
from jaxba.solver.progress import shown
from jaxba.solver.robust import FALL, FIRST, LAST
from jaxba.solver.solve import Solution
from jaxba.solver.start import as_measured
from jaxba.solver.time_limit import TimeLimit

STAGES = 40
STAGE_ITERATIONS = 5
STAGE_FTOL = 1e-3
"""Most stages, and limit and `ftol` of each."""

FEWEST = 0.25
"""Share of right matches below which the pose of an image is wrong."""

LEAST_WEIGHT = 1e-6
"""Smallest factor of a residual."""

LEAST_MEDIAN = 1e-3
"""Least median that counts: what is below is rounding, in pixels without noise."""


def solve_graduated(
    problem: BundleProblem,
    policy: str | DampingPolicy = DEFAULT_POLICY,
    options: SolveOptions | None = None,
    *,
    max_residual: float = 0.0,
    callback: Callback | None = None,
    watch: Watch | None = None,
    verbose: bool = False,
) -> Solution:
    """`solve` without the observations that do not fit, which it finds.

    It needs right matches to be the majority. Solves with falling weights of large residuals come
    first; the last has the loss of the options, and the observations that are left: with a residual
    up to `max_residual`, in front of the camera, and of a point that two of them see. An image that
    keeps less than `FEWEST` of its observations loses all of them, and its pose is that of the
    start unless a rig moves it (`Solution.set_aside`). `Solution.rejected` says which are gone;
    `problem.subset(~solution.rejected)` is what was solved last. Costs in the history are weighted,
    and the initial cost is that of the observations that are left. Raises ValueError, ProblemError:
    as `solve`, or nothing is left.

    Args:
        problem: start of the optimisation.
        policy: as for `solve`.
        options: as for `solve`; `max_iterations` limits the last solve, those before are limited by
            `STAGE_ITERATIONS`. `Tolerances.seconds` limits all together; then residuals at that
            moment say which observations are gone.
        max_residual: largest residual of a right match, whitened; 0: `LAST` times the median. It is
            that of a point that many images see. The fewer see it, the better it fits them, so that
            one of n has `sqrt(1 - 3/(2n))` of it.
        callback: as for `solve`; iterations and seconds are counted over all solves.
        watch: as for `solve`; iterations and seconds are counted over all solves.
        verbose: as for `solve`."""
    check_problem(problem)
    options = checked_options(options)
    limit = TimeLimit(options)
    if not problem.num_observations:
        raise ProblemError("the problem has no observations, of which wrong ones might be rejected")
    if not max_residual >= 0:
        raise ValueError(f"max_residual must not be negative, is {max_residual}")
    problem = as_measured(problem)
    callback, waiting = shown(callback, verbose)
    solves = Consecutive(policy, callback, watch, waiting, limit)
    away = facing_away(problem)
    counted = ~np.isin(problem.camera_index, away)
    every = np.ones(problem.num_observations, bool)
    found, scale = _descend(
        solves, problem, away, options, FIRST * _median(problem, every, counted), max_residual
    )
    kept, lost = _fitting(found, scale)
    poses = constants_of(problem.constants, problem.num_cameras, problem.num_points).poses
    again = NO_CAMERAS if problem.rigs else lost[~np.asarray(poses)[lost].any(axis=1)]
    if len(again) and kept.any() and not solves.stopped:
        found = _posed_again(solves, found, again, kept, options, scale)
        found, scale = _descend(solves, found, NO_CAMERAS, options, FALL * scale, max_residual)
        kept, lost = _fitting(found, scale)
    if len(lost) and not problem.rigs:
        cameras = np.array(found.cameras)
        cameras[lost, :POSE_SIZE] = np.asarray(problem.cameras)[lost, :POSE_SIZE]
        found = found.replace(cameras=cameras)
    if not kept.any():
        raise ProblemError(
            "no observation fits: there are more wrong matches than right ones, or the start is bad"
        )
    seen = observed(problem.subset(kept))[1][:, None]
    found = found.replace(points=np.where(seen, found.points, problem.points))
    none = replace(options, max_iterations=0)
    start = Consecutive(policy, None, None, waiting, limit).solve(
        NO_CAMERAS, problem.subset(kept), none, problem
    )
    solves.begin_phase(f"the {np.count_nonzero(kept)} observations that fit")
    last = solves.solve(NO_CAMERAS, found.subset(kept), none if solves.stopped else options, found)
    limit.warn_if_too_short(solves.total.termination, solves.total.iterations)
    return replace(
        solves.total,
        problem=with_parameters(problem, last.problem),
        initial_cost=start.initial_cost,
        set_aside=lost,
        rejected=~kept,
    )


def _descend(
    solves: Consecutive,
    problem: BundleProblem,
    away: Int[np.ndarray, " away"],
    options: SolveOptions,
    scale: float,
    last: float,
) -> tuple[BundleProblem, float]:
    """Solves with a scale that falls to `last`; 0: to `LAST` medians. Returns the problem with the
    parameters found, and the last scale."""
    limit = min(STAGE_ITERATIONS, options.max_iterations)
    # far points would make every step short
    tolerances = options.tolerances._replace(ftol=STAGE_FTOL, xtol=0.0)
    options = replace(options, loss=Loss(), max_iterations=limit, tolerances=tolerances)
    counted = ~np.isin(problem.camera_index, away)
    good = np.ones(problem.num_observations, bool)
    floor = last or LAST * _median(problem, good, counted)
    for _ in range(STAGES if limit and not solves.stopped else 0):
        root = np.maximum(1 / (1 + (_distances(problem, good) / scale) ** 2), LEAST_WEIGHT)
        own = np.eye(2) if problem.whitening is None else np.asarray(problem.whitening)
        solves.begin_phase(f"all observations, with weights for residuals around {scale:.3g} px")
        found = solves.solve(
            away, problem.replace(whitening=root[:, None, None] * own), options, problem
        )
        problem = with_parameters(problem, found.problem)
        good = 2 * root > 1
        floor = last or LAST * _median(problem, good, counted)
        if solves.stopped or (found.converged and floor > 0.95 * scale):
            break
        scale = max(scale / FALL, min(floor, scale))
    return problem, floor


def _distances(problem: BundleProblem, good: Bool[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Norms of the residuals, as of points that many images see, by how many of the good ones do;
    infinite where they are not finite. The residuals of a point with n views have 2n - 3 degrees of
    freedom."""
    with np.errstate(all="ignore"):
        norms = np.linalg.norm(geometry.residuals(problem), axis=1)
    views = np.maximum(
        np.bincount(problem.point_index[good], minlength=problem.num_points), MIN_TRACK
    )
    return np.where(
        np.isfinite(norms), norms / np.sqrt(1 - 1.5 / views[problem.point_index]), np.inf
    )


def _median(
    problem: BundleProblem, good: Bool[np.ndarray, " n"], counted: Bool[np.ndarray, " n"]
) -> float:
    return max(float(np.median(_distances(problem, good)[counted])), LEAST_MEDIAN)


def _fitting(
    problem: BundleProblem, scale: float
) -> tuple[Bool[np.ndarray, " n"], Int[np.ndarray, " lost"]]:
    """Observations that fit, and the images that have too few of them."""
    front = ~views_behind(problem)
    views = np.bincount(problem.camera_index, minlength=problem.num_cameras)
    lost = NO_CAMERAS
    kept = np.ones(problem.num_observations, bool)
    for _ in range(3):  # the second time by how many do fit, the last time without lost images
        kept = (_distances(problem, kept) <= scale) & front & ~np.isin(problem.camera_index, lost)
        kept &= (
            np.bincount(problem.point_index[kept], minlength=problem.num_points)[
                problem.point_index
            ]
            >= MIN_TRACK
        )
        lost = np.flatnonzero(
            np.bincount(problem.camera_index[kept], minlength=len(views)) < FEWEST * views
        )
    return kept & ~np.isin(problem.camera_index, lost), lost


def _posed_again(
    solves: Consecutive,
    problem: BundleProblem,
    lost: Int[np.ndarray, " lost"],
    kept: Bool[np.ndarray, " n"],
    options: SolveOptions,
    scale: float,
) -> BundleProblem:
    """The problem with images at the poses that right points give them, from the pose of an image
    that shares them."""
    camera = np.asarray(problem.camera_index)
    point = np.asarray(problem.point_index)
    cameras = np.array(problem.cameras)
    for image in lost:
        shared = np.bincount(
            camera[kept & np.isin(point, point[camera == image])], minlength=len(cameras)
        )
        shared[lost] = 0
        cameras[image, :POSE_SIZE] = cameras[shared.argmax(), :POSE_SIZE]
    problem = problem.replace(cameras=cameras)
    alone = problem.subset(np.isin(camera, lost) & np.isin(point, point[kept]))
    if not alone.num_observations:
        return problem
    others = np.setdiff1d(np.arange(len(cameras)), lost)
    alone = hold(alone, poses=others, points="all", lenses="all").replace(residuals=Residuals())
    every = np.ones(alone.num_observations, bool)
    found, _ = _descend(
        solves, alone, NO_CAMERAS, options, FIRST * _median(alone, every, every), scale
    )
    return problem.replace(cameras=found.cameras)
