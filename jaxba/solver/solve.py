"""`solve`: bundle adjustment of a problem with a damping policy, until convergence.

Without a callback and with full optimisation the loop is one compiled program (solver/loop.py). Otherwise the same
iterations are run from Python (solver/callback_loop.py).
"""

from __future__ import annotations

import functools
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import jax
import numpy as np
from jaxtyping import Int

from jaxba.damping import DampingPolicy
from jaxba.lm.termination import Termination, Tolerances
from jaxba.problem.bundle_problem import BundleProblem
from jaxba.problem.options import StepOptions
from jaxba.runtime import process
from jaxba.runtime.compilation import CompileClock, Stage, compile_and_run, compiler_options, stages
from jaxba.runtime.numerics import numerics
from jaxba.solver.callback_loop import IterationRecord, Run, Watch, parts_of, run_stepwise
from jaxba.solver.diagnosis import cost_of_rounding
from jaxba.solver.loop import Carry, History, history_of, solve_loop
from jaxba.solver.options import SolveOptions, checked_options
from jaxba.solver.prepare import DEFAULT_POLICY, Setup, set_up
from jaxba.structure.padding import Capacity
from jaxba.typing import ArrayRecord

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MIN_HISTORY = 128
"""Smallest length of the histories of the compiled loop, so that all lower limits use one program; larger limits are
rounded up to a power of two."""


@dataclass(frozen=True, eq=False, repr=False)
class Solution(ArrayRecord):
    """Result of `solve`."""

    problem: BundleProblem
    """The input with optimised cameras and points. What has no observations is unchanged, except for shared
    intrinsics."""

    initial_cost: float
    """Pixels^2."""

    final_cost: float
    """Pixels^2; never above the initial cost."""

    iterations: int
    """Number of iterations (linear solves), accepted or rejected."""

    accepted: int
    """Number of accepted iterations."""

    termination: Termination
    """Why it ended; `termination.converged` is true for a success."""

    history: History
    """Records of the iterations, arrays of length `iterations`."""

    linear_solver: str
    """Name of the linear solver, or of the method that replaced it."""

    setup_s: float
    """Seconds for the layout and the transfer to the device."""

    compile_s: float
    """Seconds for compilation; nearly zero if the compiled program was cached."""

    total_s: float
    """Seconds for the iterations, and for retriangulations between them (solver/alternation.py)."""

    capacity: Capacity | None = None
    """Sizes to which the problem was padded; None if it was not."""

    quick_iterations: int = 0
    """Number of iterations, the first ones, that ran at least in part in programs that were not fully optimised."""

    set_aside: Int[np.ndarray, " away"] = field(default_factory=lambda: np.zeros(0, int))
    """Cameras that face away from their points (problem/facing.py). Their views count in no cost, and they stay."""

    @property
    def converged(self) -> bool:
        """Whether a convergence test ended the solve."""
        return self.termination.converged

    def plot(self) -> Figure:
        """A matplotlib figure of cost and lambda over the iterations; `savefig` writes it, a notebook shows it."""
        from jaxba.solver.figure import plot_history

        return plot_history(self.history, self.initial_cost)


def solve(
    problem: BundleProblem,
    policy: str | DampingPolicy = DEFAULT_POLICY,
    options: SolveOptions | None = None,
    *,
    callback: Callable[[IterationRecord], bool | None] | None = None,
    watch: Watch | None = None,
) -> Solution:
    """Minimises the reprojection cost over cameras and points.

    A scene far from the origin relative to its size, as georeferenced scenes are, is shifted to the origin, solved and
    shifted back (`preprocess.FAR`).

    An image with more than half of its views behind it is left out with a ProblemWarning (`Solution.set_aside`), unless
    half of the images are like that.

    Many problems of different shapes can be solved in one process: before compiled programs exceed the number
    of memory mappings that Linux allows a process, all of them are dropped (`process.release_programs`) and compiled
    again when needed.

    Args:
        problem: start of the optimisation.
        policy: damping policy, which chooses lambda in every iteration, or its name (`jaxba.make_policy`). A name may
            end with `+embedded`, all embedded iterations of the default agent around a rule, or `+refineK`, K point
            iterations and no other refinement. With a refinement without point iterations `learned` and `bold` mean
            their variants for plain steps.
        options: options of the solve; None: the defaults.
        callback: called after every iteration; a true return value stops the solve.
        watch: called before it, with the record and a function that gives the problem with the parameters after the
            iteration; the time that it takes is not counted.

    Returns:
        The optimised problem in NumPy float64 arrays, histories and timings.

    Raises:
        ValueError: unknown names, or options that exclude each other, or that contradict the name of the policy.
        ProblemError: the cost at the start is not finite, a factorisation needs more memory than the machine has, or
            the method does not support what the problem has (shared lenses, priors, rigs).
        RuntimeError: this process was forked from one in which JAX had started.
        TypeError: called inside `jax.jit`, `jax.vmap` or `jax.grad`.
    """
    return solve_without(None, problem, policy, options, callback=callback, watch=watch)


def solve_without(
    away: Int[np.ndarray, " away"] | None,
    problem: BundleProblem,
    policy: str | DampingPolicy,
    options: SolveOptions | None,
    *,
    callback: Callable[[IterationRecord], bool | None] | None,
    watch: Watch | None,
) -> Solution:
    """`solve` where it is known which images face away; None: it is not."""
    options = checked_options(options)
    setup = set_up(problem, policy, options, away)
    problem = setup.counted
    with numerics(setup.dtype):
        stages_of_parts = _stages(options.compilation, problem, setup.options)
        run = functools.partial(
            run_stepwise, callback=callback or (lambda _: None), stages=stages_of_parts, watch=watch
        )
        if callback is None and watch is None and not any(stages_of_parts.values()):
            run = _run_compiled
        if setup.shards is not None:
            run = functools.partial(_run_sharded, callback=callback, watch=watch)
        if options.max_iterations == 0:
            run = _run_nothing
        carry, history, initial_cost, quick_iterations, compile_s, total_s = run(
            setup, options.tolerances, options.max_iterations
        )
        if compile_s > 0:
            process.release_programs()  # see above: too many programs end a process
        count = int(carry.iteration)
        history = History(*(np.asarray(field)[:count] for field in history))
        final_cost = float(carry.state.cost)
        termination = Termination(int(carry.termination))
        gave_up = termination in (Termination.DAMPING_LIMIT, Termination.STALLED)
        if gave_up and final_cost <= cost_of_rounding(problem, setup.dtype):
            termination = Termination.ROUNDING
        return Solution(
            problem=setup.problem_at(carry.state) if count else _unchanged(problem),
            initial_cost=initial_cost,
            final_cost=final_cost,
            iterations=count,
            accepted=int(np.sum(history.accepted)),
            termination=termination,
            history=history,
            linear_solver=setup.options.solver_name,
            setup_s=setup.setup_s,
            compile_s=compile_s,
            total_s=total_s,
            capacity=setup.capacity,
            quick_iterations=quick_iterations,
            set_aside=setup.away,
        )


def _unchanged(problem: BundleProblem) -> BundleProblem:
    """The problem itself, its parameters as NumPy float64."""
    cameras, points = (np.asarray(one, np.float64) for one in (problem.cameras, problem.points))
    return problem.replace(cameras=cameras, points=points)


def _stages(compilation: str, problem: BundleProblem, options: StepOptions) -> dict[str, tuple[Stage, ...]]:
    """The stages of compilation of each part of a step, before it is fully optimised."""
    parts = parts_of(options)
    if compilation == "full" or not compiler_options("quick"):
        return dict.fromkeys(parts, ())
    if compilation == "quick":
        return dict.fromkeys(parts, (Stage("quick", sys.maxsize),))
    return {name: stages(part, problem.num_observations) for name, part in parts.items()}


def _run_sharded(
    setup: Setup,
    tolerances: Tolerances,
    max_iterations: int,
    *,
    callback: Callable[[IterationRecord], bool | None] | None,
    watch: Watch | None,
) -> Run:
    """Runs the loop on several devices: as one program, or an iteration at a time for a callback."""
    assert setup.shards is not None
    started = time.perf_counter()
    limit = np.asarray(max_iterations, np.int32)
    history: Any = None
    with CompileClock() as clock:
        carry = jax.block_until_ready(setup.shards.begin(setup.policy, limit))
        initial_cost = float(carry.state.cost)
        setup.check_cost(carry.state)
        if callback is None and watch is None:
            length = max(MIN_HISTORY, 1 << (max_iterations - 1).bit_length())
            found = setup.shards.run(carry, setup.policy, tolerances, limit, length)
            carry, history = jax.block_until_ready(found)
        else:
            records = []
            while int(carry.termination) == Termination.RUNNING:
                carry, step = setup.shards.iterate(carry, setup.policy, tolerances, limit)
                step = jax.device_get(step)
                records.append(history_of(step))
                time_s = time.perf_counter() - started - clock.seconds
                record = IterationRecord(len(records), time_s, jax.tree.map(lambda x: x.item(), step))
                if watch is not None:
                    began = time.perf_counter()
                    watch(record, functools.partial(setup.problem_at, carry.state))
                    started += time.perf_counter() - began
                if callback is not None and callback(record) and int(carry.termination) == Termination.RUNNING:
                    carry = carry._replace(termination=np.asarray(Termination.STOPPED, np.int32))
            history = jax.tree.map(lambda *rows: np.stack(rows), *records)
    total_s = time.perf_counter() - started - clock.seconds
    return Run(carry, history, initial_cost, 0, clock.seconds, total_s)


def _run_nothing(setup: Setup, tolerances: Tolerances, max_iterations: int) -> Run:
    """Runs no iteration: computes the cost of the start."""
    started = time.perf_counter()
    with CompileClock() as clock:
        if setup.shards is None:
            state = jax.block_until_ready(setup.initial(compile_and_run))
        else:
            state = setup.shards.begin(setup.policy, np.asarray(1, np.int32)).state
        setup.check_cost(state)
    nothing = History(*(np.empty(0, setup.dtype) for _ in History._fields))
    history = nothing._replace(accepted=np.empty(0, bool), cg_iterations=np.empty(0, np.int32))
    counts = np.asarray(0, np.int32), np.asarray(Termination.MAX_ITERATIONS, np.int32)
    carry = Carry(state, None, *jax.device_put((np.asarray(np.nan, setup.dtype), *counts)))
    total_s = time.perf_counter() - started - clock.seconds
    return Run(carry, history, float(state.cost), 0, clock.seconds, total_s)


def _run_compiled(setup: Setup, tolerances: Tolerances, max_iterations: int) -> Run:
    """Runs the loop as one optimised program."""
    started = time.perf_counter()
    with CompileClock() as clock:
        state = jax.block_until_ready(setup.initial(compile_and_run))
        setup.check_cost(state)
        length = max(MIN_HISTORY, 1 << (max_iterations - 1).bit_length())
        limit = np.asarray(max_iterations, np.int32)  # a conversion by JAX is a program
        result = solve_loop(setup.layout, state, setup.policy, tolerances, setup.options, length, limit)
        carry, history = jax.block_until_ready(result)
    total_s = time.perf_counter() - started - clock.seconds
    return Run(carry, history, float(state.cost), 0, clock.seconds, total_s)
