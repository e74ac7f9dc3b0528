"""Ceres as a peer: under its own rule, or driven by a damping policy one iteration at a time. Needs the extra `ceres`.

Costs are BAL's: observations of points behind their camera, which COLMAP leaves out, are counted (`colmap_problem.py`).
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Bool

from jaxba.lm.records import StepInfo
from jaxba.lm.termination import Termination, Tolerances
from jaxba.peers.colmap import SMALLEST_DEPTH, pyceres
from jaxba.peers.colmap_problem import ColmapProblem
from jaxba.problem import geometry
from jaxba.problem.bundle_problem import BundleProblem, ProblemError
from jaxba.solver.callback_loop import IterationRecord
from jaxba.solver.loop import History
from jaxba.solver.names import INNER
from jaxba.solver.options import MAX_ITERATIONS
from jaxba.solver.prepare import explain_start
from jaxba.solver.solve import Solution

_log = logging.getLogger(__name__)

LINEAR_SOLVERS = {"dense": "DENSE_SCHUR", "sparse": "SPARSE_SCHUR", "iterative": "ITERATIVE_SCHUR"}
"""Ceres' linear solvers by mode, which may be followed by `naming.INNER`; the iterative one preconditions with
SCHUR_JACOBI."""

FORCING = 0.1
"""Forcing term of the iterative mode. Source: Ceres eta."""

ENDS = {
    "Function tolerance": Termination.COST,
    "Parameter tolerance": Termination.STEP,
    "Gradient tolerance": Termination.GRADIENT,
    "Maximum number of iterations": Termination.MAX_ITERATIONS,
    "Minimum trust region radius": Termination.DAMPING_LIMIT,
}
"""How the message of Ceres' summary begins; anything else is a failure of five invalid steps in a row."""

DISCARDED = (Termination.COST, Termination.STEP)
"""Ceres tests a candidate before it accepts, so that these end a solve with a step that is computed and not taken."""

Callback = Callable[[IterationRecord], Any]


def solver_options(mode: str, threads: int) -> Any:
    """Ceres' defaults with the linear solver of a mode, inner iterations if it has them, and silence."""
    options = pyceres.SolverOptions()
    options.use_inner_iterations = mode.endswith(INNER)
    options.linear_solver_type = getattr(pyceres.LinearSolverType, LINEAR_SOLVERS[mode.removesuffix(INNER)])
    options.preconditioner_type = pyceres.PreconditionerType.SCHUR_JACOBI
    options.eta = FORCING
    options.num_threads = threads
    options.logging_type = pyceres.LoggingType.SILENT
    return options


class Run:
    """A solve in progress: its problem, its clock, and what was recorded."""

    def __init__(self, problem: BundleProblem, callback: Callback | None) -> None:
        """Makes the Ceres problem.

        Raises:
            ProblemError: the cost at the start is not finite, or the problem has covariances.
        """
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
            _log.warning("%d observations of points behind their camera: Python evaluates them for Ceres", behind)

    def start(self) -> None:
        """Starts the clock."""
        self.started = time.perf_counter()
        self.paused = 0.0

    def hidden(self) -> Bool[np.ndarray, " observations"]:
        """Observations that COLMAP leaves out at the present parameters, found while the clock stands."""
        now = time.perf_counter()
        behind = geometry.depths(self.colmap.bundle()) < SMALLEST_DEPTH
        self.paused += time.perf_counter() - now
        return behind & ~self.colmap.in_python

    def count(self, hidden: Bool[np.ndarray, " observations"]) -> None:
        """Has observations counted from here on."""
        number = self.colmap.keep(hidden)
        _log.info("%d observations of points that went behind their camera: Python evaluates them from here on", number)

    def record(self, step: StepInfo) -> bool:
        """Notes an iteration, the parameters being those after it; returns whether the caller wants to stop.

        The recorded cost is evaluated anew, by jaxba, while the clock stands.
        """
        now = time.perf_counter()
        self.total_s = now - self.started - self.paused
        if step.accepted:
            self.cost = geometry.cost(self.colmap.bundle())
        self.steps.append(step._replace(cost=self.cost))
        stop = self.callback(IterationRecord(len(self.steps), self.total_s, self.steps[-1])) if self.callback else False
        self.paused += time.perf_counter() - now
        return bool(stop)

    def solution(self, termination: Termination, linear_solver: str, compile_s: float = 0.0) -> Solution:
        """The end of the run."""
        accepted = sum(bool(step.accepted) for step in self.steps)
        return Solution(
            problem=self.colmap.bundle() if accepted else self.colmap.start,
            initial_cost=self.initial_cost,
            final_cost=self.cost,
            iterations=len(self.steps),
            accepted=accepted,
            termination=termination,
            history=History(*(np.array([getattr(step, name) for step in self.steps]) for name in History._fields)),
            linear_solver=linear_solver,
            setup_s=self.setup_s,
            compile_s=compile_s,
            total_s=self.total_s,
        )


def step_info(cost: float, damping: float, **known: Any) -> StepInfo:
    """The record of a rejected step of which nothing else is known, but for what is `known`."""
    facts: dict[str, Any] = {
        "cost": cost,
        "previous_cost": cost,
        "candidate_cost": np.nan,
        "predicted": np.nan,
        "gain_ratio": np.nan,
        "accepted": False,
        "damping": damping,
        "gradient_max": np.nan,
        "step_norm": np.nan,
        "parameter_norm": np.nan,
        "cg_iterations": 0,
        "forcing": 0.0,
        "share": 1.0,
        "damping_share": np.nan,
        "repairs": 0,
    }
    return StepInfo(**{**facts, **known})


def step_of(now: Any, before: Any, previous_cost: float, damping: float, mode: str, **known: Any) -> StepInfo:
    """The record of one of Ceres' iteration summaries.

    Args:
        now: of the iteration.
        before: of the one before it, at whose end the gradient was taken.
        previous_cost: last accepted cost; the summary of a rejected step has the candidate's.
        damping: lambda that the step used.
        mode: a direct solver has no conjugate gradients to count.
        known: fields that Ceres does not report.
    """
    facts = {
        "previous_cost": previous_cost,
        "gradient_max": before.gradient_max_norm,
        "step_norm": now.step_norm,
        "cg_iterations": now.linear_solver_iterations if mode == "iterative" else 0,
        "forcing": FORCING if mode == "iterative" else 0.0,
    }
    if now.step_is_valid:
        facts["accepted"] = bool(now.step_is_successful)
        facts["candidate_cost"], facts["gain_ratio"] = now.cost, now.relative_decrease
        if now.relative_decrease != 0:
            facts["predicted"] = now.cost_change / now.relative_decrease
    else:
        facts["candidate_cost"] = np.inf
    return step_info(now.cost if now.step_is_successful else previous_cost, damping, **{**facts, **known})


class _Watch(pyceres.IterationCallback):
    """Turns Ceres' iteration callbacks into records, until a step that it accepted has hidden an observation."""

    def __init__(self, run: Run, mode: str) -> None:
        super().__init__()
        self.run, self.mode = run, mode
        self.begin()

    def begin(self) -> None:
        """Before a call of Ceres."""
        self.last: Any = None
        self.before: Any = None
        self.hidden: Any = None
        self.cost: Any = np.nan

    def __call__(self, summary: Any) -> Any:
        kind, stop = pyceres.CallbackReturnType, False
        if self.last is None:
            self.cost = summary.cost
        else:
            if summary.step_is_successful and (hidden := self.run.hidden()).any():
                self.hidden = hidden
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
    """Ceres under its own trust-region rule and its own stop tests, at jaxba's tolerances.

    The test of a small decrease looks at the candidate: that last linear solve is counted, as a step that is not taken
    and gains nothing. An accepted step that takes a point behind its camera, which COLMAP rewards with a residual of
    zero, is undone and repeated from the same radius with that observation counted: one iteration in the time of two.

    `step_norm` is Ceres' (0 for the first step, quaternions instead of angles); `parameter_norm` and `damping_share`
    are not known.

    Args:
        problem: start of the optimisation.
        mode: a key of `LINEAR_SOLVERS`, followed by `naming.INNER` for Ceres' inner iterations.
        max_iterations: limit of linear solves.
        tolerances: convergence tests; Ceres has no target.
        threads: of Ceres.
        callback: called after every iteration; a true return value stops the solve.

    Raises:
        ProblemError: as `Run`.
    """
    tolerances = tolerances or Tolerances()
    run = Run(problem, callback)
    options = solver_options(mode, threads)
    options.function_tolerance, options.parameter_tolerance = tolerances.ftol, tolerances.xtol
    options.gradient_tolerance = tolerances.gtol
    options.update_state_every_iteration = True
    watch, summary = _Watch(run, mode), pyceres.SolverSummary()
    options.callbacks = [watch]
    run.start()
    while True:
        watch.begin()
        options.max_num_iterations = max_iterations - len(run.steps)
        pyceres.solve(options, run.colmap.ceres, summary)
        if watch.hidden is None:
            break
        run.colmap.restore(watch.before)
        run.count(watch.hidden)
        options.initial_trust_region_radius = watch.last.trust_region_radius
    if summary.message.startswith("User callback"):
        end = Termination.STOPPED
    else:
        end = next((end for words, end in ENDS.items() if summary.message.startswith(words)), Termination.STALLED)
    if end == Termination.STALLED:
        _log.warning("Ceres gave up: %s", summary.message)
    if end in DISCARDED:
        gradient = watch.last.gradient_max_norm
        run.record(step_info(watch.cost, watch.damping, gradient_max=gradient, gain_ratio=0.0))
    run.total_s = time.perf_counter() - run.started - run.paused
    return run.solution(end, mode)
