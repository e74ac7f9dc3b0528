"""Ceres' steps with lambda chosen by a damping policy, one linear solve at a time. Needs the extra `ceres`.

Each iteration is a call of `pyceres.solve` with one iteration and `initial_trust_region_radius = 1 / lambda`. This is
the same algorithm as one long solve: between iterations Ceres keeps only the radius and the column scaling, and
`lambda diag(H)` does not depend on the scaling. Every call repeats Ceres' preprocessing and one linearisation, so that
these times are comparable with each other only.

Ceres itself accepts every step: its problem has an additional residual (`_AcceptAnyStep`) that no parameter changes,
large before a step and zero after it. jaxba then refines the step if that is asked for, and accepts or rejects it as it
does its own, and Ceres continues from the result."""

from __future__ import annotations

import functools
import time
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.scipy.spatial.transform import Rotation
from jaxtyping import Float

from jaxba.damping import DampingPolicy, ProblemInfo
from jaxba.linear.schur import jacobian_product
from jaxba.lm.records import KINDS, LMState, StepInfo
from jaxba.lm.step import Proposal, initial_state, try_step
from jaxba.lm.termination import Termination, Tolerances
from jaxba.model.linearize import linearize
from jaxba.peers.ceres import Callback, Run, solver_options, step_info, step_of
from jaxba.peers.colmap import pyceres
from jaxba.problem.bundle_problem import BundleProblem
from jaxba.problem.geometry import COLMAP_FLIP as FLIP
from jaxba.problem.options import ConjugateGradients, StepOptions
from jaxba.refinement.acceptance import Step
from jaxba.runtime.compilation import CompileClock
from jaxba.runtime.jit import jit
from jaxba.runtime.numerics import numerics
from jaxba.solver.iteration import Carry, advance, begin
from jaxba.solver.options import MAX_ITERATIONS
from jaxba.solver.place import Placed
from jaxba.solver.solve import Solution
from jaxba.structure.layout import Layout, build_layout

LARGEST_RADIUS, SMALLEST_RADIUS = 1e300, 1e-300  # so wide that they change the lambda of no policy
FORCED_DECREASE = 1e200  # of the cost by `_AcceptAnyStep`, pixels squared: larger than the cost of any useful candidate

_advance, _begin = jit(advance), jit(begin)


class _SummaryRecorder(pyceres.IterationCallback):
    """Keeps the summaries of a call of Ceres: of the start, and of the iteration if it was completed.

    One object serves all calls, since assigning `SolverOptions.callbacks` a second time appends to it (pyceres 2.6)."""

    def __init__(self) -> None:
        super().__init__()
        self.summaries: list[Any] = []

    def __call__(self, summary: Any) -> Any:
        self.summaries.append(pyceres.IterationSummary(summary))
        return pyceres.CallbackReturnType.SOLVER_CONTINUE


class _AcceptAnyStep(pyceres.CostFunction):
    """A residual that makes Ceres accept any step: large at the first evaluation after `reset`, zero afterwards.

    Its Jacobian is zero, so that it does not enter the linear system. It has two residuals and depends on one point,
    as an observation does, since Ceres has code specialised for these sizes."""

    def __init__(self) -> None:
        super().__init__()
        self.set_num_residuals(2)
        self.set_parameter_block_sizes([3])
        self.reset()

    def reset(self) -> None:
        """Must be called before each call of Ceres."""
        self.value = float(np.sqrt(FORCED_DECREASE))

    def Evaluate(self, parameters: Any, residuals: Any, jacobians: Any) -> bool:
        """Writes the residuals and the zero Jacobian; called by Ceres."""
        residuals[:] = self.value, self.value
        self.value = 0.0
        if jacobians is not None and jacobians[0] is not None:
            jacobians[0][:] = 0.0
        return True


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

    The policy gets the same record of a step as from `lm_step`, from jaxba's acceptance test, which counts points
    behind their camera. The gradient is Ceres': by the three tangent coordinates of a quaternion it is twice the one by
    angles. `mode` is a key of `LINEAR_SOLVERS`; the policy's `min_gain` is the gain ratio that a step must exceed.
    `callback` is called after every iteration; a true return value stops the solve. By the embedded iterations of
    `embedded`, if any, jaxba refines each step: options of the linear solver are ignored, and the policy cannot change
    the number of point iterations. `Solution.total_s` has the time of Ceres, of the policy and of the acceptance test,
    without compilation. Raises ProblemError: the initial cost is not finite, or the problem has covariances or shared
    lenses."""
    tolerances = tolerances or Tolerances()
    run = Run(problem, callback)
    colmap, recorder, accept_any = run.colmap, _SummaryRecorder(), _AcceptAnyStep()
    colmap.add_point_cost(accept_any, int(problem.point_index[0]))
    ceres = solver_options(mode, threads)
    ceres.max_num_iterations = 1
    ceres.function_tolerance = ceres.parameter_tolerance = ceres.gradient_tolerance = 0.0
    ceres.callbacks = [recorder]
    ceres.max_trust_region_radius, ceres.min_trust_region_radius = LARGEST_RADIUS, SMALLEST_RADIUS
    own = embedded or StepOptions()
    # Ceres solves the linear system, so that the layout needs nothing for it and no past steps are kept
    own = replace(
        own,
        linear_solver="implicit",
        method=None,
        conjugate_gradients=ConjugateGradients(preconditioner="jacobi"),
        coordinates=replace(own.coordinates, rotation="manifold"),
    )

    def tried(before: Any, damping: float, step: StepInfo) -> tuple[LMState, StepInfo]:
        """The next state after the step from the parameters `before` to Ceres' current ones, and its record."""
        numbers = np.float64(step.gradient_max), np.int32(step.cg_iterations), np.float64(step.forcing)
        after, least = colmap.parameters(), np.float64(policy.min_gain)
        found = _evaluate(layout, state, before, after, np.float64(damping), numbers, least, options=own)
        return jax.block_until_ready(found)

    def iterate(damping: float) -> StepInfo:
        """One linear solve by one call of Ceres; jaxba accepts or rejects the step."""
        nonlocal state
        before, summaries = colmap.parameters(), recorder.summaries
        accept_any.reset()
        ceres.initial_trust_region_radius = float(np.clip(1 / damping, SMALLEST_RADIUS, LARGEST_RADIUS))
        summaries.clear()
        pyceres.solve(ceres, colmap.ceres, pyceres.SolverSummary())
        if len(summaries) < 2 or not summaries[1].step_is_successful:  # no step could be computed
            return _null_step(run.cost, damping, *(summary.gradient_max_norm for summary in summaries[:1]))
        state, step = tried(before, damping, step_of(summaries[1], summaries[0], np.nan, np.nan, mode))
        if not step.accepted:
            colmap.restore(before)
            return step
        start = colmap.start
        colmap.set_parameters_of(Placed(start, np.zeros(3), start).after(layout, layout.points, state, own))
        if (behind := run.newly_behind()).any():
            run.count_behind(behind)
        return step

    with numerics(np.float64), CompileClock() as clock:
        started = time.perf_counter()
        carry = _begin(_problem_info(problem, run.initial_cost, max_iterations), policy, None)
        # everything is compiled before the clock starts
        layout = jax.device_put(build_layout(colmap.start, own))
        state = initial_state(layout, colmap.start, own)
        null_step = _null_step(run.cost, float(carry.damping))
        tried(colmap.parameters(), float(carry.damping), null_step)
        # twice, since the state that a policy returns may differ in type from its initial state
        warm = _after_step(policy, carry, null_step, tolerances, max_iterations)
        jax.block_until_ready(_after_step(policy, warm, null_step, tolerances, max_iterations))
        run.setup_s += max(0.0, time.perf_counter() - started - clock.seconds)
        run.start()
        end = Termination.RUNNING
        while end == Termination.RUNNING:
            step = iterate(float(carry.damping))
            carry = _after_step(policy, carry, step, tolerances, max_iterations)
            end = Termination(int(carry.termination))
            if run.record(step) and end == Termination.RUNNING:
                end = Termination.STOPPED
    return run.solution(end, mode, clock.seconds)


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


@functools.partial(jit, static_argnames="options")
def _evaluate(
    layout: Layout,
    state: LMState,
    before: Any,
    after: Any,
    damping: Float[Array, ""],
    numbers: tuple[Array, Array, Array],
    min_gain: Float[Array, ""],
    options: StepOptions,
) -> tuple[LMState, StepInfo]:
    """jaxba's acceptance test of a step between two sets of COLMAP's parameters.

    `before` and `after` are `(poses [c, 7], lenses [c, 5], points [p, 3])`. `numbers` of a step are known to Ceres
    alone: the largest gradient entry before it, and the iterations and the forcing term of conjugate gradients, 0 for a
    direct linear solver."""
    flip = jnp.asarray(FLIP)[:, None]
    first, second = (Rotation.from_quat(poses[:, :4]) for poses, *_ in (before, after))
    rotation = (second * first.inv()).as_rotvec().T
    lens = (after[1] - before[1]).T
    cameras = jnp.concatenate(
        [flip * rotation, flip * (after[0][:, 4:] - before[0][:, 4:]).T, lens[jnp.array([0, 3, 4])]]
    )
    points = (after[2] - before[2]).at[layout.points].get(mode="fill", fill_value=0).T
    linear = linearize(layout, state.cameras, state.points, options.loss)
    residual, change = jnp.stack(linear.residual), jnp.stack(jacobian_product(layout, linear, cameras.T, points))
    slope = -jnp.sum(residual * change)
    damped = slope - jnp.sum(change * change)
    proposal = Proposal(Step(cameras, points, slope, damped, *numbers), linear.reference, jnp.zeros((), bool))
    return try_step(layout, state, damping, proposal, options, min_gain)
