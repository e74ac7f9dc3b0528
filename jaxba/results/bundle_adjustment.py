"""pycolmap's functions for bundle adjustment, by `jaxba.solve`: a script changes one import.

Source: COLMAP 4.2, `BundleAdjustmentController`, `DefaultBundleAdjuster`,
`PosePriorBundleAdjuster`."""

from __future__ import annotations

import importlib
import warnings
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np

from jaxba.io.pose_priors import alignment_to, measured_positions, with_positions
from jaxba.io.pycolmap_config import chosen_part, constrained, everything, without_views_behind
from jaxba.io.pycolmap_options import ceres_options, changed, ignored, loss_of, options_of
from jaxba.io.reconstruction import any_far_off, check_reconstruction
from jaxba.lm.termination import Tolerances
from jaxba.problem.bundle_problem import BundleProblem, NothingObserved, ProblemWarning
from jaxba.problem.checks import shown
from jaxba.problem.similarity import Similarity, transformed
from jaxba.results.bundle_summary import BundleAdjustmentSummary
from jaxba.results.retriangulate import retriangulate
from jaxba.runtime.process import single_blas_thread
from jaxba.runtime.program_cache import keep_programs_by_default
from jaxba.solver.drivers import Callback
from jaxba.solver.options import SolveOptions
from jaxba.solver.solve import Solution, solve
from jaxba.solver.time_limit import TimeLimit

TOLERANCES = {
    "function_tolerance": "ftol",
    "gradient_tolerance": "gtol",
    "parameter_tolerance": "xtol",
    "max_solver_time_in_seconds": "seconds",
}
"""COLMAP's tolerances and its limit of time by name, as those of `Tolerances`."""

NEVER = SimpleNamespace(is_cancelled=False)
"""A token that stops nothing."""


def bundle_adjustment(
    reconstruction: Any,
    options: Any = None,
    config: Any = None,
    cancellation_token: Any = None,
) -> BundleAdjustmentSummary:
    """Optimises a `pycolmap.Reconstruction` in place, as `pycolmap.bundle_adjustment` does.

    Without a config, views of points behind their image are first deleted from the reconstruction,
    and points that then have fewer than two, as COLMAP does
    (`FilterObservationsWithNegativeDepth`); a `ProblemWarning` says how many. With one they stay,
    and count for nothing.

    Compiled programs are kept on disk, unless `jaxba.keep_programs` or the environment variable
    JAXBA_CACHE says otherwise.

    Args:
        reconstruction: start and result.
        options: a `pycolmap.BundleAdjustmentOptions`, or a dictionary of its values: what is
            refined, the loss, the tolerances, and the limits of iterations and of seconds. Those
            that COLMAP has by default mean jaxba's own. What only says how Ceres computes means
            nothing; a `ProblemWarning` names what else is ignored.
        config: a `pycolmap.BundleAdjustmentConfig`. None: all images, in the gauge of two cameras.
            A cancellation token in its place, where pycolmap has it, is one.
        cancellation_token: a `pycolmap.CancellationToken`; the solve stops after the iteration in
            which it is cancelled.

    Returns:
        The solution. If nothing is observed, one that is not usable, and the reconstruction is as
        it was.

    Raises: as `from_pycolmap` and `solve`; the reconstruction is as it was, but for deleted
    views."""
    if hasattr(config, "is_cancelled"):
        config, cancellation_token = None, config
    token = cancellation_token or NEVER
    if config:
        return BundleAdjuster(options, config, reconstruction, token).solve()
    check_reconstruction(reconstruction)
    return BundleAdjuster(
        options, everything(reconstruction), reconstruction, token, deletes=True
    ).solve()


def create_default_bundle_adjuster(
    options: Any, config: Any, reconstruction: Any
) -> BundleAdjuster:
    """What `pycolmap.create_default_bundle_adjuster` is for: its `solve()` is `bundle_adjustment`
    of the three.

    Args:
        options: a `pycolmap.BundleAdjustmentOptions`, or a dictionary of its values.
        config: a `pycolmap.BundleAdjustmentConfig`.
        reconstruction: a `pycolmap.Reconstruction`, start and result."""
    return BundleAdjuster(options, config, reconstruction, NEVER)


def create_pose_prior_bundle_adjuster(
    options: Any, prior_options: Any, config: Any, pose_priors: Any, reconstruction: Any
) -> BundleAdjuster:
    """The same with measured positions, with which the whole reconstruction is first aligned.

    Args:
        options: a `pycolmap.BundleAdjustmentOptions`, or a dictionary of its values.
        prior_options: a `pycolmap.PosePriorBundleAdjustmentOptions`: the loss of priors, and the
            standard deviation of those without a covariance. How COLMAP aligns means nothing here.
        config: a `pycolmap.BundleAdjustmentConfig`; priors of other images count for nothing.
        pose_priors: `pycolmap.PosePrior`s, in a list, or by ids of images in a dictionary as in
            COLMAP 3; Cartesian.
        reconstruction: a `pycolmap.Reconstruction`, start and result."""
    return BundleAdjuster(
        options, config, reconstruction, NEVER, priors=((prior_options, pose_priors),)
    )


@dataclass(frozen=True)
class BundleAdjuster:
    """A bundle adjustment that `solve` runs."""

    options: Any
    config: Any
    reconstruction: Any
    token: Any
    """Something with `is_cancelled`."""
    deletes: bool = False
    """Whether views of points behind their image are deleted first."""
    priors: tuple[tuple[Any, Any], ...] = ()
    """Options of pose priors, and these, if there are any."""

    # with two threads the gauge of a local adjustment took 30 ms beside a busy process
    @single_blas_thread()
    def solve(self) -> BundleAdjustmentSummary:
        """Optimises the reconstruction in place. Raises: as `bundle_adjustment`."""
        check_reconstruction(self.reconstruction)
        keep_programs_by_default()
        options = options_of(self.options)
        chosen = solve_options(options)
        limit = TimeLimit(chosen)
        callback = _stop_of(self.token)
        try:
            problem, moves, behind = self._problem(options)
            if behind and self.deletes:
                _delete_views_behind(self.reconstruction)
                problem, moves, _ = self._problem(options)
        except NothingObserved:
            return BundleAdjustmentSummary.nothing()
        if behind or any_far_off(problem, self.reconstruction):
            solution = _solve_after_search(problem, chosen, limit, callback)
        else:
            solution = solve(problem, options=limit.rest(chosen), callback=callback)
        for move in moves:
            _transform(self.reconstruction, move)
        solution.update(self.reconstruction)
        return BundleAdjustmentSummary.of(solution)

    def _problem(self, options: Any) -> tuple[BundleProblem, list[Similarity], bool]:
        """The problem to solve, how the whole reconstruction is first moved to the priors, and
        whether points lie behind images that see them."""
        part = chosen_part(self.reconstruction, self.config, options)
        measured = [measured_positions(part, self.config, *pair) for pair in self.priors]
        moves = [alignment_to(part, positions) for positions in measured]
        for move in moves:
            part = transformed(part, move)
        seen = without_views_behind(part)
        problem = constrained(seen, self.reconstruction, self.config, options)
        for positions in measured:
            problem = with_positions(problem, positions)
        return problem, moves, seen is not part


def _solve_after_search(
    problem: BundleProblem, options: SolveOptions, limit: TimeLimit, callback: Callback | None
) -> Solution:
    """A solve from points that were searched with the cameras held, since no step leads back those
    that are far off."""
    searched = retriangulate(problem, options.loss)
    solution = solve(searched.problem, options=limit.rest(options), callback=callback)
    return replace(solution, initial_cost=searched.cost_before)


def _delete_views_behind(reconstruction: Any) -> None:
    """Deletes views of points behind their image, and says how many."""
    pycolmap = importlib.import_module("pycolmap")
    points = reconstruction.num_points3D()
    deleted = pycolmap.ObservationManager(reconstruction).filter_observations_with_negative_depth()
    gone = points - reconstruction.num_points3D()
    lost = f", and {gone} points that then had fewer than two" if gone else ""
    text = f"the reconstruction: deleted {deleted} views of points behind their image{lost}"
    warnings.warn(f"{text}, as COLMAP does", ProblemWarning, stacklevel=5)


def _transform(reconstruction: Any, by: Similarity) -> None:
    pycolmap = importlib.import_module("pycolmap")
    rotation = pycolmap.Rotation3d(np.asarray(by.rotation))
    reconstruction.transform(pycolmap.Sim3d(float(by.scale), rotation, np.asarray(by.translation)))


def _stop_of(token: Any) -> Callback | None:
    """What stops a solve between iterations: a token. Raises ValueError: no token."""
    if not hasattr(token, "is_cancelled"):
        raise ValueError(
            f"cancellation_token must be a pycolmap.CancellationToken, not {shown(token)}"
        )

    def is_cancelled(record: Any) -> bool:
        return token.is_cancelled

    return None if token is NEVER else is_cancelled


def solve_options(options: Any) -> SolveOptions:
    """What a `pycolmap.BundleAdjustmentOptions` says of the solve, where it says something else
    than COLMAP's default. A ProblemWarning names what changes where COLMAP ends, and means nothing
    here."""
    unused = ignored(options)
    if unused:
        text = f"options: ignored {', '.join(unused)}, so that COLMAP may end elsewhere"
        warnings.warn(text, ProblemWarning, stacklevel=5)
    group = ceres_options(options)
    solver = group.solver_options
    tolerances = {
        own: getattr(solver, name) for name, own in TOLERANCES.items() if changed(options, name)
    }
    limit = (
        {"max_iterations": solver.max_num_iterations}
        if changed(options, "max_num_iterations")
        else {}
    )
    loss = loss_of(group.loss_function_type.name, group.loss_function_scale)
    return SolveOptions(loss=loss, tolerances=Tolerances(**tolerances), **limit)
