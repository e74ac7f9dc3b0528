"""The whole solve: iterate the step under a damping policy until it converges.

Without a callback the loop is one compiled program. With one, the same iteration runs step by step
from Python and every record carries the wall-clock time at which it was finished; so it does where a quickly
compiled program may give way to an optimised one (programs.py).
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import Float, Int

from jaxba import geometry, host
from jaxba.choose import choose_linear_solver
from jaxba.clock import CompileClock
from jaxba.damping import DampingPolicy, Learned, ProblemInfo, effort_of, make_policy
from jaxba.layout import Layout, layout_for
from jaxba.linearize import linearize, with_free_lenses
from jaxba.lm import LMState, StepInfo, initial_state, lm_step
from jaxba.methods import DEFAULT_METHOD, make_method
from jaxba.naming import DTYPES, fitting_policy
from jaxba.options import StepOptions
from jaxba.padding import Capacity, capacity_of, padded_parameters, with_padded_solver
from jaxba.problem import AnyArray, BundleProblem, ProblemError
from jaxba.programs import Compilation, program, quick_iterations, quick_options
from jaxba.schur import largest_diagonal
from jaxba.sums import point_sum
from jaxba.termination import Termination, Tolerances, termination_of

MAX_ITERATIONS = 100
"""Iterations after which a solve has failed. Source: the paper."""


class History(NamedTuple):
    """One entry an iteration; NumPy arrays of equal length in a `Solution`."""

    cost: AnyArray  # accepted cost after the iteration, pixels^2
    candidate_cost: AnyArray  # cost of the proposed step
    damping: AnyArray  # lambda that was used
    gain_ratio: AnyArray
    accepted: AnyArray
    cg_iterations: AnyArray
    gradient_max: AnyArray  # largest gradient entry before the step
    step_norm: AnyArray


class IterationRecord(NamedTuple):
    """What a callback sees."""

    iteration: int  # from 1
    time_s: float  # seconds since the first iteration started, compilation excluded
    step: StepInfo  # Python and NumPy scalars


@dataclass(frozen=True)
class Solution:
    """Result of `solve`."""

    problem: BundleProblem
    """The input with optimised cameras and points; what nobody observes is unchanged, but for a lens it shares."""

    initial_cost: float
    """Pixels squared."""

    final_cost: float
    """Pixels squared; never above the initial cost."""

    iterations: int
    """Linear solves, accepted or not."""

    accepted: int
    """Accepted iterations."""

    termination: Termination
    """Why it ended; `termination.converged` says whether that is a success."""

    history: History
    """Fixed-length records cut to `iterations`."""

    linear_solver: str
    """How the reduced camera system was solved."""

    setup_s: float
    """Seconds for the layout and the transfer to the device."""

    compile_s: float
    """Seconds for compilation; nearly zero when an executable was at hand."""

    total_s: float
    """Seconds for the iterations, and for searches between them (alternate.py)."""

    capacity: Capacity | None = None
    """Sizes to which the problem was padded; None where it was not."""

    quick_iterations: int = 0
    """Iterations, of a solve the first ones, that a quickly compiled program computed; they are slower."""

    @property
    def converged(self) -> bool:
        """Whether a convergence test ended the solve."""
        return self.termination.converged


class _Carry(NamedTuple):
    state: Any  # LMState, or None where only the policy's part is wanted
    policy: Any
    damping: Float[Array, ""]
    iteration: Int[Array, ""]
    termination: Int[Array, ""]


def solve(
    problem: BundleProblem,
    damping: str | DampingPolicy = "ceres",
    options: StepOptions | None = None,
    *,
    method: str = DEFAULT_METHOD,
    linear_solver: str | None = None,
    max_iterations: int = MAX_ITERATIONS,
    tolerances: Tolerances | None = None,
    dtype: str = "float64",
    callback: Callable[[IterationRecord], bool | None] | None = None,
    pad: bool = False,
    compilation: Compilation = "full",
) -> Solution:
    """Minimises the reprojection cost over cameras and points.

    Args:
        problem: start of the optimisation.
        damping: a policy, or the name of one (`jaxba.make_policy`). Without options `learned` is the shipped policy
            that fits the method (`naming.fitting_policy`), with options the one for plain LM.
        options: how a step is made; if left out, as a learned policy was trained (`AgentConfig.step_options`).
        method: how a step is made (`jaxba.METHODS`); fixes the options that make it.
        linear_solver: overrides that of the options; `auto` asks the cost model in choose.py.
        max_iterations: limit of linear solves.
        tolerances: convergence tests.
        dtype: `float64` or `float32`, the type of all arithmetic; `mixed` is float64 with the reduced camera system
            in float32 (`StepOptions.algebra`).
        callback: called after every iteration, which then run one by one; a true return value stops the
            solve.
        pad: rounds sizes up to a coarse grid, so that similar problems share one compiled program, also through a
            persistent compilation cache; results differ by rounding alone. For many small problems with the explicit
            solver, which `auto` then means. Other solvers and larger problems are left as they are:
            `Solution.capacity` is None then. See padding.py.
        compilation: `full`: all optimisation, for many solves of a shape and for whoever takes the time of iterations.
            `quick`: compiled in a third of the time, iterations take two to six times as long. `auto`: quick, and
            optimised after as many iterations as pay for it; the end of one small solve comes soonest. They differ by
            rounding. On a GPU all are `full`. See programs.py.

    Many problems of many shapes may be solved in one process: before their programs exceed what Linux lets a process
    map, all compiled programs of JAX are dropped (`host.release_programs`), and compiled anew where they are needed.

    Returns:
        Parameters as NumPy float64 arrays, histories and timings.

    Raises:
        ValueError: unknown names, or limits that make no sense.
        ProblemError: the cost at the start is not finite, or the step asked for cannot hold the problem's lenses.
    """
    if dtype not in DTYPES:
        raise ValueError(f"dtype must be one of {', '.join(DTYPES)}, not {dtype!r}")
    if compilation not in get_args(Compilation):
        raise ValueError(f"compilation must be one of {', '.join(get_args(Compilation))}, not {compilation!r}")
    if max_iterations < 1:
        raise ValueError(f"max_iterations must be at least 1, is {max_iterations}")
    if isinstance(damping, str):
        policy = make_policy(damping if options is not None else fitting_policy(damping, method))
    else:
        policy = damping
    if options is None:
        options = policy.config.step_options(StepOptions()) if isinstance(policy, Learned) else StepOptions()
    options = make_method(method).options(options)
    capacity = None
    if pad:
        capacity, linear_solver = with_padded_solver(capacity_of(problem), options, linear_solver)
    options = choose_linear_solver(problem, options, linear_solver)
    tolerances = tolerances or Tolerances()
    if dtype == "mixed":
        options, dtype = replace(options, algebra="mixed"), "float64"
    with jax.enable_x64(dtype == "float64"), host.calm_blas():
        started = time.perf_counter()
        with CompileClock() as clock:
            layout = jax.device_put(layout_for(problem, options, capacity))
            initial = program(initial_state, "options", "dtype", quick=True)
            begin = problem if capacity is None else padded_parameters(problem, capacity)
            state = jax.block_until_ready(initial(layout, begin, options, jnp.dtype(dtype)))
        setup_s = max(0.0, time.perf_counter() - started - clock.seconds)
        if not np.isfinite(float(state.cost)):
            raise ProblemError(explain_start(problem))
        quick = _quick_part(compilation, problem, max_iterations)
        run = functools.partial(_run_stepwise, callback=callback or (lambda _: None), quick=quick)
        if callback is None and not quick:
            run = _run_compiled
        final, history, compile_s, total_s = run(layout, state, policy, tolerances, options, max_iterations)
        if clock.seconds + compile_s > 0:
            host.release_programs()  # many problems in one process would end it
        count = int(final.iteration)
        history = History(*(np.asarray(field)[:count] for field in history))
        return Solution(
            problem=_write_back(problem, layout, final.state, options),
            initial_cost=float(state.cost),
            final_cost=float(final.state.cost),
            iterations=count,
            accepted=int(np.sum(history.accepted)),
            termination=Termination(int(final.termination)),
            history=history,
            linear_solver=options.linear_solver,
            setup_s=setup_s,
            compile_s=compile_s + clock.seconds,
            total_s=total_s,
            capacity=capacity,
            quick_iterations=min(quick, count),
        )


def explain_start(problem: BundleProblem) -> str:
    """Which observation makes the initial cost infinite, in one line."""
    with np.errstate(all="ignore"):
        bad = np.flatnonzero(~np.isfinite(geometry.residuals(problem)).all(axis=1))
    if not bad.size:
        return "the cost at the start overflows"
    camera, point = (int(index[bad[0]]) for index in (problem.camera_index, problem.point_index))
    others = f" (and {bad.size - 1} more)" if bad.size > 1 else ""
    return (
        f"the cost at the start is not finite: observation {bad[0]}{others}, point {point} lies on the plane of camera "
        f"{camera} or its projection overflows"
    )


def _quick_part(compilation: str, problem: BundleProblem, max_iterations: int) -> int:
    """How many of the first iterations are a quickly compiled program's."""
    if compilation == "full" or quick_options() is None:
        return 0
    return max_iterations if compilation == "quick" else quick_iterations(problem.num_observations)


def _info(layout: Layout, state: LMState, options: StepOptions, max_iterations: int) -> ProblemInfo:
    """What a policy may know before the first iteration."""
    unit = jnp.ones_like(state.cost)
    if options.scaling == "identity":
        linear = linearize(layout, state.cameras, state.points, options.loss)
        unit = largest_diagonal(layout, with_free_lenses(layout, linear, "free"))
    count = lambda n: jnp.asarray(n, jnp.int32)
    info = ProblemInfo(
        cost=state.cost,
        observations=count(jnp.sum(layout.slot_mask)),
        cameras=count(jnp.sum(layout.camera_seen)),
        points=count(jnp.sum(point_sum(layout, jnp.asarray(layout.slot_mask, state.cost.dtype)[None]) > 0)),
        unit=unit,
        focal=jnp.nanmedian(jnp.where(layout.camera_seen, jnp.abs(state.cameras[6]), jnp.nan)),
        max_iterations=count(max_iterations),
    )
    return info


def _begin(info: ProblemInfo, policy: DampingPolicy, state: Any) -> _Carry:
    """Carry before the first iteration."""
    policy_state, damping = policy.init(info)
    count = lambda n: jnp.asarray(n, jnp.int32)
    return _Carry(state, policy_state, damping, count(0), count(Termination.RUNNING))


def after_step(
    policy: DampingPolicy,
    policy_state: Any,
    step: StepInfo,
    iteration: Int[Array, ""],
    tolerances: Tolerances,
    max_iterations: Any,
) -> tuple[Any, Float[Array, ""], Int[Array, ""]]:
    """The policy's answer to a step, and the stop rules: its next state, the next lambda, a `Termination`."""
    after, damping = policy.propose(policy_state, step)
    # the same state and lambda after a rejection: the policy would ask for the same step for ever
    same = [jnp.all(old == new) for old, new in zip(*map(jax.tree.leaves, (policy_state, after)), strict=True)]
    stuck = functools.reduce(jnp.logical_and, same, damping == step.damping)
    return after, damping, termination_of(step, stuck, iteration, tolerances, max_iterations)


def _advance(
    carry: _Carry, state: Any, step: StepInfo, policy: DampingPolicy, tolerances: Tolerances, max_iterations: Any
) -> _Carry:
    """Everything of an iteration that follows the step.

    The parameters are handed on and not looked at; None leaves them out.
    """
    iteration = carry.iteration + 1
    policy_state, damping, end = after_step(policy, carry.policy, step, iteration, tolerances, max_iterations)
    return _Carry(state, policy_state, damping, iteration, end)


def _advance_and_tell(
    carry: _Carry, step: StepInfo, policy: DampingPolicy, tolerances: Tolerances, max_iterations: Any
) -> tuple[_Carry, Float[Array, " facts"]]:
    """`_advance` without the parameters, and for the host the step and the end, as one array: one transfer, not 15."""
    after = _advance(carry, None, step, policy, tolerances, max_iterations)
    return after, jnp.stack([x.astype(step.cost.dtype) for x in (*step, after.termination)])


def _told(facts: Float[Array, " facts"], shapes: StepInfo) -> tuple[StepInfo, Termination]:
    """The other end of `_advance_and_tell`: Python numbers of the types that `shapes` has."""
    *values, end = np.asarray(facts).tolist()
    kinds = {"b": bool, "i": int, "f": float}
    return StepInfo(*(kinds[x.dtype.kind](v) for v, x in zip(values, shapes, strict=True))), Termination(int(end))


def _history(step: StepInfo) -> History:
    return History(
        cost=step.cost,
        candidate_cost=step.candidate_cost,
        damping=step.damping,
        gain_ratio=step.gain_ratio,
        accepted=step.accepted,
        cg_iterations=step.cg_iterations,
        gradient_max=step.gradient_max,
        step_norm=step.step_norm,
    )


@functools.partial(jax.jit, static_argnames=("options", "max_iterations"))
def solve_loop(
    layout: Layout,
    state: LMState,
    policy: DampingPolicy,
    tolerances: Tolerances,
    options: StepOptions,
    max_iterations: int,
) -> tuple[_Carry, History]:
    """The loop as one program; vmappable over layouts and states of equal shape.

    Returns:
        Final carry, and histories of length `max_iterations`, zero past the last iteration.
    """
    carry = _begin(_info(layout, state, options, max_iterations), policy, state)

    def step_of(c: _Carry) -> tuple[LMState, StepInfo]:
        effort = effort_of(policy, c.policy)
        return lm_step(layout, c.state, c.damping, options, policy.min_gain, c.iteration, effort)

    shapes = jax.eval_shape(lambda c: _history(step_of(c)[1]), carry)
    empty = jax.tree.map(lambda s: jnp.zeros((max_iterations, *s.shape), s.dtype), shapes)

    def body(loop: tuple[_Carry, History]) -> tuple[_Carry, History]:
        carry, history = loop
        state, step = step_of(carry)
        history = jax.tree.map(lambda all_, one: all_.at[carry.iteration].set(one), history, _history(step))
        return _advance(carry, state, step, policy, tolerances, max_iterations), history

    return lax.while_loop(lambda loop: loop[0].termination == Termination.RUNNING, body, (carry, empty))


def _run_compiled(layout, state, policy, tolerances, options, max_iterations):
    started = time.perf_counter()
    with CompileClock() as clock:
        carry, history = jax.block_until_ready(solve_loop(layout, state, policy, tolerances, options, max_iterations))
    return carry, history, clock.seconds, time.perf_counter() - started - clock.seconds


def _run_stepwise(layout, state, policy, tolerances, options, max_iterations, *, callback, quick):
    inform = program(_info, "options", "max_iterations", quick=True)
    begin, advance = program(_begin, quick=True), program(_advance_and_tell, quick=True)
    with CompileClock() as clock:
        # without the parameters what is the policy's compiles once for all problems
        carry = begin(inform(layout, state, options, max_iterations), policy, None)
        carry = jax.block_until_ready(carry._replace(state=state))
        min_gain = jnp.asarray(policy.min_gain, state.cost.dtype)
        limit = jnp.asarray(max_iterations, jnp.int32)

        def iterate(carry: _Carry, done: int) -> tuple[_Carry, StepInfo, Termination]:
            effort = effort_of(policy, carry.policy)
            take_step = program(lm_step, "options", quick=done < quick)
            state, step = take_step(layout, carry.state, carry.damping, options, min_gain, carry.iteration, effort)
            carry, facts = advance(carry._replace(state=None), step, policy, tolerances, limit)
            return carry._replace(state=state), *_told(facts, step)

        started, compiling = time.perf_counter(), 0.0
        records = []
        while True:
            began, before = time.perf_counter(), clock.seconds
            after, step, end = iterate(carry, len(records))
            if clock.seconds > before:  # compiled just now
                spent = time.perf_counter() - began
                if len(records) < quick:  # who is in a hurry takes what the clock says
                    compiling += min(spent, clock.seconds - before)
                else:  # the iteration is pure, so do it again
                    compiling += spent
                    after, step, end = iterate(carry, len(records))
            carry = after
            records.append(step)
            wants_stop = callback(IterationRecord(len(records), time.perf_counter() - started - compiling, step))
            if end != Termination.RUNNING:
                break
            if wants_stop:
                carry = carry._replace(termination=jnp.asarray(int(Termination.STOPPED), jnp.int32))
                break
        total_s = time.perf_counter() - started - compiling
    history = jax.tree.map(lambda *values: np.array(values), *map(_history, records))
    return carry, history, clock.seconds, total_s


def _write_back(problem: BundleProblem, layout: Layout, state: LMState, options: StepOptions) -> BundleProblem:
    """Optimised parameters in the problem's own order; what was not optimised is copied bit by bit."""
    cameras, points = np.array(problem.cameras, np.float64), np.array(problem.points, np.float64)
    seen = np.flatnonzero(layout.camera_seen)  # cameras of padding are not seen
    cameras[seen] = np.asarray(state.cameras, np.float64).T[seen]
    if options.intrinsics == "fixed":
        cameras[:, 6:] = problem.cameras[:, 6:]
    elif problem.lenses is not None:  # what nobody observes has the lens of the others
        lens = np.asarray(problem.lenses.index)
        used, first = np.unique(lens[seen], return_index=True)
        follows = np.isin(lens, used)
        cameras[follows, 6:] = cameras[seen[first[np.searchsorted(used, lens[follows])]], 6:]
        cameras[:, 6:] = np.where(np.asarray(problem.lenses.free)[lens], cameras[:, 6:], problem.cameras[:, 6:])
    order = np.concatenate([np.asarray(members) for members in layout.bucket_points])
    real = order < problem.num_points
    points[order[real]] = np.asarray(state.points, np.float64).T[real]
    return problem.replace(cameras=cameras, points=points)
