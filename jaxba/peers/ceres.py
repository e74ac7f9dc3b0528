"""Solves with Ceres under its own trust-region rule. Needs the extra `ceres`.

The cost is that of BAL: observations of points behind their camera, which COLMAP's cost function
ignores, are counted (see `colmap.py`)."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Bool

from jaxba.lm.records import StepInfo
from jaxba.lm.termination import Termination, Tolerances
from jaxba.peers.colmap import SMALLEST_DEPTH, ColmapProblem, pyceres
from jaxba.problem import geometry
from jaxba.problem.bundle_problem import BundleProblem, ProblemError
from jaxba.solver.diagnosis import explain_start
from jaxba.solver.drivers import IterationRecord
from jaxba.solver.names import INNER
from jaxba.solver.options import MAX_ITERATIONS
from jaxba.solver.solve import Solution

_log = logging.getLogger(__name__)

LINEAR_SOLVERS = {"dense": "DENSE_SCHUR", "sparse": "SPARSE_SCHUR", "iterative": "ITERATIVE_SCHUR"}
"""Ceres' linear solver of a mode; the iterative one with SCHUR_JACOBI. After it `INNER` means inner
iterations."""

# forcing term of conjugate gradients in the iterative mode. Source: default of Ceres' `eta`
FORCING = 0.1

ENDS = {
    "Function tolerance": Termination.COST,
    "Parameter tolerance": Termination.STEP,
    "Gradient tolerance": Termination.GRADIENT,
    "Maximum number of iterations": Termination.MAX_ITERATIONS,
    "Minimum trust region radius": Termination.DAMPING_LIMIT,
}
"""Reason to stop by the beginning of Ceres' message. Any other is a failure, after five invalid
steps in a row."""

ENDS_WITHOUT_STEP = (Termination.COST, Termination.STEP)
"""Convergence tests that Ceres makes before it accepts a step, so that the last step is computed
but not taken."""

Callback = Callable[[IterationRecord], Any]


def solver_options(mode: str, threads: int) -> Any:
    """Ceres' default options with the linear solver of a mode, inner iterations if the mode has
    them, and no output."""
    options = pyceres.SolverOptions()
    options.use_inner_iterations = mode.endswith(INNER)
    options.linear_solver_type = getattr(
        pyceres.LinearSolverType, LINEAR_SOLVERS[mode.removesuffix(INNER)]
    )
    options.preconditioner_type = pyceres.PreconditionerType.SCHUR_JACOBI
    options.eta = FORCING
    options.num_threads = threads
    options.logging_type = pyceres.LoggingType.SILENT
    return options


class Run:
    """A solve in progress: the Ceres problem, the clock and the recorded iterations."""

    def __init__(self, problem: BundleProblem, callback: Callback | None) -> None:
        """Builds Ceres' problem. Raises ProblemError: a non-finite initial cost, covariances or
        shared lenses."""
        self.initial_cost = geometry.cost(problem)
        if not np.isfinite(self.initial_cost):
            raise ProblemError(explain_start(problem))
        started = time.perf_counter()
        self.colmap = ColmapProblem(problem)
        self.setup_s = time.perf_counter() - started
        self.callback = callback
        self.steps: list[StepInfo] = []
        self.cost = self.initial_cost
        self.paused = 0.0
        self.total_s = 0.0
        if behind := int(self.colmap.in_python.sum()):
            _log.warning(
                "%d observations of points behind their camera: Python evaluates them for Ceres",
                behind,
            )

    def start(self) -> None:
        """Starts the clock of `total_s`."""
        self.started = time.perf_counter()
        self.paused = 0.0

    def newly_behind(self) -> Bool[np.ndarray, " observations"]:
        """Observations whose point moved behind its camera: COLMAP ignores them. Their time is not
        counted."""
        now = time.perf_counter()
        behind = geometry.depths(self.colmap.bundle()) < SMALLEST_DEPTH
        self.paused += time.perf_counter() - now
        return behind & ~self.colmap.in_python

    def count_behind(self, behind: Bool[np.ndarray, " observations"]) -> None:
        """Counts observations of points behind their camera from here on."""
        number = self.colmap.count_behind(behind)
        _log.info(
            "%d observations of points that went behind their camera: Python evaluates them from "
            "here on",
            number,
        )

    def record(self, step: StepInfo) -> bool:
        """Records an iteration at the parameters after it, and calls the callback.

        Times of jaxba's cost and of the callback are not counted. Returns whether the callback
        asked to stop."""
        now = time.perf_counter()
        self.total_s = now - self.started - self.paused
        if step.accepted:
            self.cost = geometry.cost(self.colmap.bundle())
        self.steps.append(step._replace(cost=self.cost))
        stop = (
            self.callback(IterationRecord(len(self.steps), self.total_s, self.steps[-1]))
            if self.callback
            else False
        )
        self.paused += time.perf_counter() - now
        return bool(stop)

    def solution(self, termination: Termination, linear_solver: str) -> Solution:
        """The result, from the recorded iterations."""
        accepted = sum(bool(step.accepted) for step in self.steps)
        return Solution(
            problem=self.colmap.bundle() if accepted else self.colmap.start,
            initial_cost=self.initial_cost,
            final_cost=self.cost,
            iterations=len(self.steps),
            accepted=accepted,
            termination=termination,
            history=StepInfo.stacked(self.steps),
            linear_solver=linear_solver,
            setup_s=self.setup_s,
            compile_s=0.0,
            total_s=self.total_s,
        )


def step_info(cost: float, damping: float, **known: Any) -> StepInfo:
    """The record of a rejected step. Fields that are not given in `known` are NaN or neutral
    values."""
    fields: dict[str, Any] = dict.fromkeys(StepInfo._fields, np.nan)
    fields |= {
        "cost": cost,
        "previous_cost": cost,
        "damping": damping,
        "forcing": 0.0,
        "step_fraction": 1.0,
    }
    fields |= dict.fromkeys(("accepted", "weightless"), False)
    fields |= dict.fromkeys(("cg_iterations", "repairs"), 0)
    return StepInfo(**{**fields, **known})


def step_of(now: Any, before: Any, previous_cost: float, damping: float, mode: str) -> StepInfo:
    """Converts Ceres' summaries of an iteration and of the one before it, which has the gradient at
    the start of the step, into a `StepInfo`. Of a rejected step they have the candidate's cost
    only, so the last accepted one is given, and lambda. Only the iterative mode counts conjugate
    gradients."""
    fields: dict[str, Any] = {
        "previous_cost": previous_cost,
        "gradient_max": before.gradient_max_norm,
        "step_norm": now.step_norm,
        "cg_iterations": now.linear_solver_iterations if mode == "iterative" else 0,
        "forcing": FORCING if mode == "iterative" else 0.0,
    }
    if now.step_is_valid:
        fields["accepted"] = bool(now.step_is_successful)
        fields["candidate_cost"], fields["gain_ratio"] = now.cost, now.relative_decrease
        if now.relative_decrease != 0:
            fields["predicted"] = now.cost_change / now.relative_decrease
    else:
        fields["candidate_cost"] = np.inf
    return step_info(now.cost if now.step_is_successful else previous_cost, damping, **fields)


class _RecordingCallback(pyceres.IterationCallback):
    """Records every iteration of Ceres. Stops Ceres when an accepted step has moved a point behind
    its camera."""

    def __init__(self, run: Run, mode: str) -> None:
        super().__init__()
        self.run = run
        self.mode = mode
        self.reset()

    def reset(self) -> None:
        """Must be called before each call of Ceres."""
        self.last: Any = None
        self.before: Any = None
        self.behind: Any = None
        self.cost: Any = np.nan

    def __call__(self, summary: Any) -> Any:
        kind = pyceres.CallbackReturnType
        stop = False
        if self.last is None:
            self.cost = summary.cost
        else:
            if summary.step_is_successful and (behind := self.run.newly_behind()).any():
                self.behind = behind
                return kind.SOLVER_ABORT
            step = step_of(summary, self.last, self.cost, self.damping, self.mode)
            self.cost = step.cost
            stop = self.run.record(step)
        self.last, self.before = pyceres.IterationSummary(summary), self.run.colmap.parameters()
        return kind.SOLVER_TERMINATE_SUCCESSFULLY if stop else kind.SOLVER_CONTINUE

    @property
    def damping(self) -> float:
        """Lambda of the next step."""
        return 1 / self.last.trust_region_radius


def solve_by_ceres(
    problem: BundleProblem,
    mode: str,
    *,
    max_iterations: int = MAX_ITERATIONS,
    tolerances: Tolerances | None = None,
    threads: int = 1,
    callback: Callback | None = None,
) -> Solution:
    """Solves with Ceres under its own trust-region rule and convergence tests, with jaxba's
    tolerances.

    Ceres tests for a small decrease first: that last solve counts as a rejected step with gain
    ratio 0.

    COLMAP gives a point behind its camera a residual of zero. If an accepted step moves a point
    there, the step is undone and repeated from the same radius with that observation counted. That
    counts as one iteration.

    In the history, `step_norm` is the one of Ceres (0 for the first step, with quaternions instead
    of angles). `parameter_norm` and `damping_fraction` are NaN. `mode` is a key of
    `LINEAR_SOLVERS`, followed by `INNER` for Ceres' inner iterations. The target cost and the limit
    of time are ignored. `callback` is called after every iteration; a true return value stops the
    solve. Raises ProblemError: the initial cost is not finite, or the problem has covariances or
    shared lenses."""
    tolerances = tolerances or Tolerances()
    run = Run(problem, callback)
    options = solver_options(mode, threads)
    options.function_tolerance, options.parameter_tolerance = tolerances.ftol, tolerances.xtol
    options.gradient_tolerance = tolerances.gtol
    options.update_state_every_iteration = True
    recorder = _RecordingCallback(run, mode)
    summary = pyceres.SolverSummary()
    options.callbacks = [recorder]
    run.start()
    while True:
        recorder.reset()
        options.max_num_iterations = max_iterations - len(run.steps)
        pyceres.solve(options, run.colmap.ceres, summary)
        if recorder.behind is None:
            break
        run.colmap.restore(recorder.before)
        run.count_behind(recorder.behind)
        options.initial_trust_region_radius = recorder.last.trust_region_radius
    if summary.message.startswith("User callback"):
        end = Termination.STOPPED
    else:
        end = next(
            (end for words, end in ENDS.items() if summary.message.startswith(words)),
            Termination.STALLED,
        )
    if end == Termination.STALLED:
        _log.warning("Ceres gave up: %s", summary.message)
    if end in ENDS_WITHOUT_STEP:
        gradient = recorder.last.gradient_max_norm
        run.record(
            step_info(recorder.cost, recorder.damping, gradient_max=gradient, gain_ratio=0.0)
        )
    run.total_s = time.perf_counter() - run.started - run.paused
    return run.solution(end, mode)
