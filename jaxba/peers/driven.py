"""Ceres' steps with lambda chosen by a damping policy, one linear solve at a time. Needs the extra `ceres`.

Each iteration is a call of `pyceres.solve` with one iteration and `initial_trust_region_radius = 1 / lambda`. This is
the same algorithm as one long solve: between iterations Ceres keeps only the radius and the column scaling, and
`lambda diag(H)` does not depend on the scaling. Every call repeats Ceres' preprocessing and one linearisation, so that
these times are comparable with each other only.
"""

from __future__ import annotations

import functools
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxba.damping import DampingPolicy, ProblemInfo
from jaxba.lm.records import StepInfo
from jaxba.lm.termination import Termination, Tolerances
from jaxba.peers.acceptance import ReportedByCeres, StepAcceptance
from jaxba.peers.ceres import Callback, Run, solver_options, step_info, step_of
from jaxba.peers.colmap import pyceres
from jaxba.peers.model import Observations, observations_of, step_metrics
from jaxba.problem.bundle_problem import BundleProblem
from jaxba.problem.options import StepOptions
from jaxba.runtime.compilation import CompileClock
from jaxba.runtime.jit import jit
from jaxba.runtime.numerics import numerics
from jaxba.solver.loop import after_step
from jaxba.solver.options import MAX_ITERATIONS
from jaxba.solver.solve import Solution

LARGEST_RADIUS, SMALLEST_RADIUS = 1e300, 1e-300
"""Limits of the radius, so wide that they do not change the lambda of any policy."""

REJECTED_DAMPING_FRACTION = 0.0
"""Assumed `damping_fraction` of a rejected step, which Ceres does not return. Steps are rejected for too little
damping, so that it is near 0: for jaxba's own steps it was 0.0003 to 0.006 on Ladybug-49 and kittistereo00s."""

_after_step = jit(after_step)
_init = jit(lambda policy, info: policy.init(info))


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
    """Solves with Ceres' steps, lambda from a policy, and jaxba's convergence tests.

    The policy gets the same record of a step as from `lm_step`. Costs, gain ratio, predicted decrease and gradient are
    those that Ceres reports (its gradient by the three tangent coordinates of a quaternion is twice the one by angles);
    `step_metrics` computes the rest. For a rejected step, `step_norm` is NaN and `damping_fraction` is
    `REJECTED_DAMPING_FRACTION`.

    COLMAP gives a point behind its camera a residual of zero. If a step that Ceres accepts moves points there, it is
    tested once more with the cost that counts them.

    Args:
        problem: start of the optimisation.
        mode: a key of `LINEAR_SOLVERS`.
        policy: chooses lambda; its `min_gain` becomes Ceres' `min_relative_decrease`.
        max_iterations: limit of linear solves.
        tolerances: convergence tests.
        threads: number of threads of Ceres.
        callback: called after every iteration; a true return value stops the solve.
        embedded: if given, jaxba refines each step with these embedded iterations and accepts or rejects it
            (`acceptance.py`). Options of the linear solver are ignored, and the policy cannot change the number of
            point iterations.

    Returns:
        The solution. `total_s` has the time of Ceres, of the policy and of `step_metrics` or the acceptance test,
        without compilation.

    Raises:
        ProblemError: the initial cost is not finite, or the problem has covariances or shared lenses.
    """
    tolerances = tolerances or Tolerances()
    run = Run(problem, callback)
    options = solver_options(mode, threads)
    options.max_num_iterations = 1
    options.function_tolerance = options.parameter_tolerance = options.gradient_tolerance = 0.0
    options.min_relative_decrease = float(policy.min_gain)
    recorder = _SummaryRecorder()
    options.callbacks = [recorder]
    options.max_trust_region_radius, options.min_trust_region_radius = LARGEST_RADIUS, SMALLEST_RADIUS
    with numerics(np.float64), CompileClock() as clock:
        started = time.perf_counter()
        state, damping = _init(policy, _problem_info(problem, run.initial_cost, max_iterations))
        # everything is compiled before the clock starts
        same = run.colmap.parameters()
        if embedded is None:
            observations = observations_of(problem, run.colmap.pixels)
            jax.block_until_ready(step_metrics(observations, same, same))
            iterate = functools.partial(_iterate_under_ceres_rule, run, options, recorder.summaries, observations, mode)
        else:
            acceptance = StepAcceptance(run, embedded, policy.min_gain)
            jax.block_until_ready(acceptance.evaluate(same, float(damping), ReportedByCeres.empty()))
            iterate = functools.partial(_iterate_under_jaxba_rule, run, options, recorder.summaries, acceptance, mode)
        null_step = _null_step(run.cost, float(damping))
        # twice, since the state that a policy returns may differ in type from its initial state
        warm, _, _ = _update_policy(policy, state, null_step, 1, tolerances, max_iterations)
        jax.block_until_ready(_update_policy(policy, warm, null_step, 1, tolerances, max_iterations))
        run.setup_s += max(0.0, time.perf_counter() - started - clock.seconds)
        run.start()
        end, iteration = Termination.RUNNING, 0
        while end == Termination.RUNNING:
            iteration += 1
            step = iterate(float(damping))
            state, damping, answer = _update_policy(policy, state, step, iteration, tolerances, max_iterations)
            end = Termination(int(answer))
            if run.record(step) and end == Termination.RUNNING:
                end = Termination.STOPPED
    return run.solution(end, mode, clock.seconds)


def _iterate_under_ceres_rule(
    run: Run, options: Any, summaries: list[Any], observations: Observations, mode: str, damping: float
) -> StepInfo:
    """One linear solve by one call of Ceres, which accepts or rejects the step."""
    before = run.colmap.parameters()
    _call_ceres(run, options, summaries, damping)
    if len(summaries) < 2:  # the gradient is zero, or the candidate's cost or parameters are those before it
        return _null_step(run.cost, damping, *(summary.gradient_max_norm for summary in summaries))
    first, second = summaries
    if not second.step_is_successful:
        unknown = {"step_norm": np.nan, "damping_fraction": REJECTED_DAMPING_FRACTION}
        return step_of(second, first, first.cost, damping, mode, **unknown)
    metrics = step_metrics(observations, before, run.colmap.parameters())
    names = ("step_norm", "parameter_norm", "damping_fraction")
    known = {name: float(getattr(metrics, name)) for name in names}
    step = step_of(second, first, first.cost, damping, mode, **known)
    behind = np.asarray(metrics.behind) & ~run.colmap.in_python
    if not behind.any():
        return step
    full_cost = float(metrics.cost)
    gain = (first.cost - full_cost) / step.predicted
    step = step._replace(candidate_cost=full_cost, gain_ratio=gain)
    if gain > options.min_relative_decrease:
        run.count_behind(behind)
        return step._replace(cost=full_cost)
    run.colmap.restore(before)
    return step._replace(accepted=False, cost=first.cost, step_norm=np.nan, damping_fraction=REJECTED_DAMPING_FRACTION)


def _call_ceres(run: Run, options: Any, summaries: list[Any], damping: float) -> None:
    """Calls Ceres for one iteration with the given lambda; its callback fills `summaries`."""
    options.initial_trust_region_radius = float(np.clip(1 / damping, SMALLEST_RADIUS, LARGEST_RADIUS))
    summaries.clear()
    pyceres.solve(options, run.colmap.ceres, pyceres.SolverSummary())


def _iterate_under_jaxba_rule(
    run: Run, options: Any, summaries: list[Any], acceptance: StepAcceptance, mode: str, damping: float
) -> StepInfo:
    """One linear solve by one call of Ceres; jaxba refines the step and accepts or rejects it."""
    before = run.colmap.parameters()
    acceptance.accept_any.reset()
    _call_ceres(run, options, summaries, damping)
    if len(summaries) < 2 or not summaries[1].step_is_successful:  # no step could be computed
        return _null_step(run.cost, damping, *(summary.gradient_max_norm for summary in summaries[:1]))
    return acceptance.apply(before, damping, ReportedByCeres.from_summaries(summaries, mode))


def _null_step(cost: float, damping: float, gradient_max: float = np.nan) -> StepInfo:
    """The record of a rejected step of length zero."""
    fields = {
        "candidate_cost": cost,
        "predicted": 0.0,
        "gain_ratio": 0.0,
        "damping_fraction": REJECTED_DAMPING_FRACTION,
    }
    return step_info(cost, damping, gradient_max=gradient_max, **fields)


def _update_policy(
    policy: DampingPolicy, state: Any, step: StepInfo, iteration: int, tolerances: Any, limit: int
) -> Any:
    """`after_step` with all arguments as arrays of fixed types, so that it is compiled once."""
    kinds = {"accepted": np.bool_, "weightless": np.bool_}
    kinds |= dict.fromkeys(("cg_iterations", "repairs", "camera_rounds", "point_iterations"), np.int32)
    arrays = StepInfo(**{k: jnp.asarray(x, kinds.get(k, np.float64)) for k, x in step._asdict().items()})
    limits = Tolerances(*(np.float64(x) for x in tolerances))
    return _after_step(policy, state, arrays, np.int32(iteration), limits, np.int32(limit))


def _problem_info(problem: BundleProblem, cost: float, max_iterations: int) -> ProblemInfo:
    """The `ProblemInfo` that `solve` makes for diagonal damping."""
    seen = np.bincount(problem.camera_index, minlength=problem.num_cameras) > 0
    points, focal = len(np.unique(problem.point_index)), np.asarray(problem.cameras)[:, 6]
    return ProblemInfo.of(jnp.asarray(cost), problem.num_observations, points, seen, focal, max_iterations)
