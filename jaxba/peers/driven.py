"""Ceres driven by a damping policy, one linear solve at a time. Needs the extra `ceres`.

An iteration is one call of `pyceres.solve` with one iteration and `initial_trust_region_radius = 1 / lambda`: the same
algorithm, since what Ceres keeps between iterations is the radius and the column scaling, and `lambda diag(H)` does not
depend on the scaling. A call repeats Ceres' preparations and the first linearisation, so driven times compare with
driven times only.
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
from jaxba.peers.ceres import Callback, Run, solver_options, step_info, step_of
from jaxba.peers.colmap import pyceres
from jaxba.peers.model import Observed, observed, step_facts
from jaxba.peers.verdict import Told, Verdict
from jaxba.problem.bundle_problem import BundleProblem
from jaxba.problem.options import StepOptions
from jaxba.runtime import process
from jaxba.runtime.compilation import CompileClock
from jaxba.solver.loop import after_step
from jaxba.solver.options import MAX_ITERATIONS
from jaxba.solver.solve import Solution

LARGEST_RADIUS, SMALLEST_RADIUS = 1e300, 1e-300
"""Limits of the radius that leave every lambda of a policy as it is."""

REJECTED_SHARE = 0.0
"""Stand-in for `damping_share` of a rejected step, which Ceres does not show. Steps are rejected for too little
damping: of jaxba's own it was 0.0003 to 0.006 on Ladybug-49 and kittistereo00s under `learned-driver`."""

_after_step = jax.jit(after_step)
_init = jax.jit(lambda policy, info: policy.init(info))


class _Last(pyceres.IterationCallback):
    """Keeps the summaries of a call: the start, and the iteration if it came to its end.

    One for all calls: to assign to `SolverOptions.callbacks` again adds to what is there (pyceres 2.6).
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
    """Ceres' steps under a policy, with jaxba's stop tests.

    The policy sees what it sees of `lm_step`: costs, gain ratio, predicted decrease and gradient as Ceres reports them
    (the gradient by a quaternion's three tangent coordinates, twice that by angles), the rest by `step_facts`. Of a
    rejected step the length stays unknown (NaN, by which stop rules know it), the share of damping is `REJECTED_SHARE`.
    Where an accepted step takes points behind their camera, which COLMAP rewards with a residual of zero, the whole
    cost decides once more.

    Args:
        problem: start of the optimisation.
        mode: a key of `LINEAR_SOLVERS`.
        policy: chooses lambda; its `min_gain` is Ceres' `min_relative_decrease`.
        max_iterations: limit of linear solves.
        tolerances: convergence tests.
        threads: of Ceres.
        callback: called after every iteration; a true return value stops the solve.
        embedded: what surrounds each step, and how it is added to a camera; then jaxba judges it (verdict.py), and the
            policy sees what it sees of `lm_step`. How a step is solved does not matter, and how many point iterations a
            policy would have is not asked.

    Returns:
        `total_s` holds Ceres' calls, the policy and `step_facts` or the verdict, without compilation.

    Raises:
        ProblemError: as `Run`.
    """
    tolerances = tolerances or Tolerances()
    run = Run(problem, callback)
    options = solver_options(mode, threads)
    options.max_num_iterations = 1
    options.function_tolerance = options.parameter_tolerance = options.gradient_tolerance = 0.0
    options.min_relative_decrease = float(policy.min_gain)
    last = _Last()
    options.callbacks = [last]
    options.max_trust_region_radius, options.min_trust_region_radius = LARGEST_RADIUS, SMALLEST_RADIUS
    with jax.enable_x64(True), process.single_blas_thread(), CompileClock() as clock:
        started = time.perf_counter()
        state, damping = _init(policy, _problem_info(problem, run.initial_cost, max_iterations))
        # everything is compiled before the clock starts
        same = run.colmap.parameters()
        if embedded is None:
            constant = observed(problem, run.colmap.pixels)
            jax.block_until_ready(step_facts(constant, same, same))
            iterate = functools.partial(_iterate, run, options, last.summaries, constant, mode)
        else:
            verdict = Verdict(run, embedded, policy.min_gain)
            jax.block_until_ready(verdict.judged(same, float(damping), Told.nothing()))
            iterate = functools.partial(_judged, run, options, last.summaries, verdict, mode)
        idle = _idle(run.cost, float(damping))
        # twice: the state that a policy returns need not be of the type of its first
        warm, _, _ = _answer(policy, state, idle, 1, tolerances, max_iterations)
        jax.block_until_ready(_answer(policy, warm, idle, 1, tolerances, max_iterations))
        run.setup_s += max(0.0, time.perf_counter() - started - clock.seconds)
        run.start()
        end, iteration = Termination.RUNNING, 0
        while end == Termination.RUNNING:
            iteration += 1
            step = iterate(float(damping))
            state, damping, answer = _answer(policy, state, step, iteration, tolerances, max_iterations)
            end = Termination(int(answer))
            if run.record(step) and end == Termination.RUNNING:
                end = Termination.STOPPED
    return run.solution(end, mode, clock.seconds)


def _iterate(run: Run, options: Any, summaries: list[Any], constant: Observed, mode: str, damping: float) -> StepInfo:
    """One linear solve by one call of Ceres; the parameters change if its step is accepted."""
    before = run.colmap.parameters()
    _ask(run, options, summaries, damping)
    if len(summaries) < 2:  # the gradient is zero, or the candidate's cost or parameters are those before it
        return _idle(run.cost, damping, *(summary.gradient_max_norm for summary in summaries))
    first, second = summaries
    if not second.step_is_successful:
        unknown = {"step_norm": np.nan, "damping_share": REJECTED_SHARE}
        return step_of(second, first, first.cost, damping, mode, **unknown)
    facts = step_facts(constant, before, run.colmap.parameters())
    names = ("step_norm", "parameter_norm", "damping_share")
    known = {name: float(getattr(facts, name)) for name in names}
    step = step_of(second, first, first.cost, damping, mode, **known)
    hidden = np.asarray(facts.behind) & ~run.colmap.in_python
    if not hidden.any():
        return step
    whole = float(facts.cost)
    gain = (first.cost - whole) / step.predicted
    step = step._replace(candidate_cost=whole, gain_ratio=gain)
    if gain > options.min_relative_decrease:
        run.count(hidden)
        return step._replace(cost=whole)
    run.colmap.restore(before)
    return step._replace(accepted=False, cost=first.cost, step_norm=np.nan, damping_share=REJECTED_SHARE)


def _ask(run: Run, options: Any, summaries: list[Any], damping: float) -> None:
    """One call of Ceres; its callback fills the summaries."""
    options.initial_trust_region_radius = float(np.clip(1 / damping, SMALLEST_RADIUS, LARGEST_RADIUS))
    summaries.clear()
    pyceres.solve(options, run.colmap.ceres, pyceres.SolverSummary())


def _judged(run: Run, options: Any, summaries: list[Any], verdict: Verdict, mode: str, damping: float) -> StepInfo:
    """One linear solve by one call of Ceres; what becomes of its step jaxba decides."""
    before = run.colmap.parameters()
    verdict.forgiving.begin()
    _ask(run, options, summaries, damping)
    if len(summaries) < 2 or not summaries[1].step_is_successful:  # no step could be computed
        return _idle(run.cost, damping, *(summary.gradient_max_norm for summary in summaries[:1]))
    return verdict.settle(before, damping, Told.of(summaries, mode))


def _idle(cost: float, damping: float, gradient_max: float = np.nan) -> StepInfo:
    """A step that leads nowhere."""
    facts = {"candidate_cost": cost, "predicted": 0.0, "gain_ratio": 0.0, "damping_share": REJECTED_SHARE}
    return step_info(cost, damping, gradient_max=gradient_max, **facts)


def _answer(policy: DampingPolicy, state: Any, step: StepInfo, iteration: int, tolerances: Any, limit: int) -> Any:
    """`after_step` on arrays of fixed types, so that it compiles once."""
    kinds = {"accepted": np.bool_, "cg_iterations": np.int32, "repairs": np.int32}
    arrays = StepInfo(**{k: jnp.asarray(x, kinds.get(k, np.float64)) for k, x in step._asdict().items()})
    limits = Tolerances(*(np.float64(x) for x in tolerances))
    return _after_step(policy, state, arrays, np.int32(iteration), limits, np.int32(limit))


def _problem_info(problem: BundleProblem, cost: float, max_iterations: int) -> ProblemInfo:
    """As `solve` has it under diagonal damping."""
    cameras = np.unique(problem.camera_index)
    count = lambda n: jnp.asarray(n, jnp.int32)
    return ProblemInfo(
        cost=jnp.asarray(cost),
        observations=count(problem.num_observations),
        cameras=count(len(cameras)),
        points=count(len(np.unique(problem.point_index))),
        unit=jnp.ones(()),
        focal=jnp.median(jnp.abs(jnp.asarray(problem.cameras)[cameras, 6])),
        max_iterations=count(max_iterations),
    )
