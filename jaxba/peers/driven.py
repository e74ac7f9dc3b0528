"""Ceres' steps with lambda chosen by a damping policy, one linear solve at a time. Needs the extra `ceres`.

Each iteration is a call of `pyceres.solve` with one iteration and `initial_trust_region_radius = 1 / lambda`. This is
the same algorithm as one long solve: between iterations Ceres keeps only the radius and the column scaling, and
`lambda diag(H)` does not depend on the scaling. Every call repeats Ceres' preprocessing and one linearisation, so that
these times are comparable with each other only.
"""

from __future__ import annotations

import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxba.damping import DampingPolicy, ProblemInfo
from jaxba.lm.records import KINDS, StepInfo
from jaxba.lm.termination import Termination, Tolerances
from jaxba.peers.acceptance import StepAcceptance, reported
from jaxba.peers.ceres import Callback, Run, solver_options, step_info, step_of
from jaxba.peers.colmap import pyceres
from jaxba.problem.bundle_problem import BundleProblem
from jaxba.problem.options import StepOptions
from jaxba.runtime.compilation import CompileClock
from jaxba.runtime.jit import jit
from jaxba.runtime.numerics import numerics
from jaxba.solver.iteration import Carry, advance, begin
from jaxba.solver.options import MAX_ITERATIONS
from jaxba.solver.solve import Solution

LARGEST_RADIUS, SMALLEST_RADIUS = 1e300, 1e-300
"""Limits of the radius, so wide that they do not change the lambda of any policy."""

_advance, _begin = jit(advance), jit(begin)


class _SummaryRecorder(pyceres.IterationCallback):
    """Keeps the summaries of a call of Ceres: of the start, and of the iteration if it was completed.

    One object serves all calls, since assigning `SolverOptions.callbacks` a second time appends to it (pyceres 2.6).
    """

    def __init__(self) -> None:
        super().__init__()
        self.summaries: list[Any] = []

    def __call__(self, summary: Any) -> Any:
        self.summaries.append(pyceres.IterationSummary(summary))
        return pyceres.CallbackReturnType.SOLVER_CONTINUE


def drive_ceres(
    problem: BundleProblem,
    mode: str,
    policy: DampingPolicy,
    *,
    max_iterations: int = MAX_ITERATIONS,
    tolerances: Tolerances | None = None,
    threads: int = 1,
    callback: Callback | None = None,
    embedded: StepOptions | None = None,
) -> Solution:
    """Solves with Ceres' steps, lambda from a policy, and jaxba's acceptance and convergence tests.

    The policy gets the same record of a step as from `lm_step`, from jaxba's acceptance test (`acceptance.py`), which
    counts points behind their camera. The gradient is Ceres': by the three tangent coordinates of a quaternion it is
    twice the one by angles.

    Args:
        problem: start of the optimisation.
        mode: a key of `LINEAR_SOLVERS`.
        policy: chooses lambda; its `min_gain` is the gain ratio that a step must exceed.
        max_iterations: limit of linear solves.
        tolerances: convergence tests.
        threads: number of threads of Ceres.
        callback: called after every iteration; a true return value stops the solve.
        embedded: embedded iterations with which jaxba refines each step, if any. Options of the linear solver are
            ignored, and the policy cannot change the number of point iterations.

    Returns:
        The solution. `total_s` has the time of Ceres, of the policy and of the acceptance test, without compilation.

    Raises:
        ProblemError: the initial cost is not finite, or the problem has covariances or shared lenses.
    """
    tolerances = tolerances or Tolerances()
    run = Run(problem, callback)
    options = solver_options(mode, threads)
    options.max_num_iterations = 1
    options.function_tolerance = options.parameter_tolerance = options.gradient_tolerance = 0.0
    recorder = _SummaryRecorder()
    options.callbacks = [recorder]
    options.max_trust_region_radius, options.min_trust_region_radius = LARGEST_RADIUS, SMALLEST_RADIUS
    with numerics(np.float64), CompileClock() as clock:
        started = time.perf_counter()
        carry = _begin(_problem_info(problem, run.initial_cost, max_iterations), policy, None)
        damping = float(carry.damping)
        # everything is compiled before the clock starts
        acceptance = StepAcceptance(run, embedded or StepOptions(), policy.min_gain)
        null_step = _null_step(run.cost, damping)
        jax.block_until_ready(acceptance.evaluate(run.colmap.parameters(), damping, reported(null_step)))
        # twice, since the state that a policy returns may differ in type from its initial state
        warm = _after_step(policy, carry, null_step, tolerances, max_iterations)
        jax.block_until_ready(_after_step(policy, warm, null_step, tolerances, max_iterations))
        run.setup_s += max(0.0, time.perf_counter() - started - clock.seconds)
        run.start()
        end = Termination.RUNNING
        while end == Termination.RUNNING:
            step = _iterate(run, options, recorder.summaries, acceptance, mode, float(carry.damping))
            carry = _after_step(policy, carry, step, tolerances, max_iterations)
            end = Termination(int(carry.termination))
            if run.record(step) and end == Termination.RUNNING:
                end = Termination.STOPPED
    return run.solution(end, mode, clock.seconds)


def _iterate(
    run: Run, options: Any, summaries: list[Any], acceptance: StepAcceptance, mode: str, damping: float
) -> StepInfo:
    """One linear solve by one call of Ceres, whose callback fills `summaries`; jaxba accepts or rejects the step."""
    before = run.colmap.parameters()
    acceptance.accept_any.reset()
    options.initial_trust_region_radius = float(np.clip(1 / damping, SMALLEST_RADIUS, LARGEST_RADIUS))
    summaries.clear()
    pyceres.solve(options, run.colmap.ceres, pyceres.SolverSummary())
    if len(summaries) < 2 or not summaries[1].step_is_successful:  # no step could be computed
        return _null_step(run.cost, damping, *(summary.gradient_max_norm for summary in summaries[:1]))
    step = step_of(summaries[1], summaries[0], np.nan, np.nan, mode)
    return acceptance.apply(before, damping, reported(step))


def _null_step(cost: float, damping: float, gradient_max: float = np.nan) -> StepInfo:
    """The record of a rejected step of length zero."""
    none = dict.fromkeys(("predicted", "gain_ratio", "damping_fraction"), 0.0)
    return step_info(cost, damping, gradient_max=gradient_max, candidate_cost=cost, **none)


def _after_step(policy: DampingPolicy, carry: Carry, step: StepInfo, tolerances: Any, limit: int) -> Carry:
    """`advance` with all arguments as arrays of fixed types, so that it is compiled once."""
    arrays = StepInfo(**{k: jnp.asarray(x, KINDS.get(k, float)) for k, x in step._asdict().items()})
    limits = Tolerances(*(np.float64(x) for x in tolerances))
    return _advance(carry, None, arrays, policy, limits, np.int32(limit))


def _problem_info(problem: BundleProblem, cost: float, max_iterations: int) -> ProblemInfo:
    """The `ProblemInfo` that `solve` makes for diagonal damping."""
    seen = np.bincount(problem.camera_index, minlength=problem.num_cameras) > 0
    points, focal = len(np.unique(problem.point_index)), np.asarray(problem.cameras)[:, 6]
    return ProblemInfo.of(jnp.asarray(cost), problem.num_observations, points, seen, focal, max_iterations)
