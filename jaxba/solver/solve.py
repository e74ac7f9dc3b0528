"""The whole solve: iterate the step under a damping policy until it converges.

Without a callback the loop is one compiled program (solver/loop.py). With one, or where compilation is in a hurry, the
same iteration runs step by step from Python (solver/callback_loop.py).
"""

from __future__ import annotations

import functools
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import get_args

import jax
import jax.numpy as jnp
import numpy as np

from jaxba.damping import DampingPolicy, Learned, make_policy
from jaxba.lm.step import LMState, initial_state
from jaxba.lm.termination import Termination, Tolerances
from jaxba.methods.registry import DEFAULT_METHOD, make_method
from jaxba.problem import geometry
from jaxba.problem.bundle_problem import BundleProblem, ProblemError
from jaxba.problem.options import REDUCED_SOLVERS, StepOptions, check_count
from jaxba.problem.preprocess import far_middle, shift
from jaxba.runtime import process
from jaxba.runtime.compilation import (
    Compilation,
    CompileClock,
    Part,
    Stage,
    compile_and_run,
    compiler_options,
    program,
    stages,
)
from jaxba.solver.callback_loop import IterationRecord, run_stepwise
from jaxba.solver.cost_model import choose_linear_solver
from jaxba.solver.loop import Carry, History, solve_loop
from jaxba.solver.names import DTYPES
from jaxba.structure.layout import Layout, layout_for
from jaxba.structure.padding import Capacity, capacity_of, padded_parameters, with_padded_solver

MAX_ITERATIONS = 100
"""Iterations after which a solve has failed. Source: the paper."""


LEAST_ROOM = 128
"""Least iterations that a compiled loop keeps records of: one program for all lower limits. Else powers of two."""


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
    """Seconds for the iterations, and for searches between them (solver/alternation.py)."""

    capacity: Capacity | None = None
    """Sizes to which the problem was padded; None where it was not."""

    quick_iterations: int = 0
    """Iterations, a solve's first ones, that were computed, at least in part, by programs not fully optimised."""

    @property
    def converged(self) -> bool:
        """Whether a convergence test ended the solve."""
        return self.termination.converged


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
        damping: a policy, or the name of one (`jaxba.make_policy`).
        options: how a step is made; if left out, as a learned policy was trained (`AgentConfig.step_options`).
        method: how a step is made (`jaxba.METHODS`); fixes the options that make it.
        linear_solver: overrides that of the options; `auto` asks the cost model in solver/cost_model.py.
        max_iterations: limit of linear solves.
        tolerances: convergence tests.
        dtype: `float64` or `float32`, the type of all arithmetic; `mixed` is float64 with the reduced camera system
            in float32 (`StepOptions.algebra`).
        callback: called after every iteration, which then run one by one; a true return value stops the
            solve.
        pad: rounds sizes up to a coarse grid, so that similar problems share one compiled program, also through a
            persistent compilation cache; results differ by rounding alone. For many small problems with the explicit
            solver, which `auto` then means. Other solvers and larger problems are left as they are:
            `Solution.capacity` is None then. See structure/padding.py.
        compilation: `full`: all optimisation, for many solves of a shape and for whoever takes the time of iterations.
            `quick`: compiled in a third of the time, iterations take two to six times as long. `auto`: quick or, with
            more observations, in half of the time and nearly as fast, and optimised after as many iterations as pay
            for it; the end of one solve comes soonest. They differ by rounding. On a GPU all are `full`. See
            runtime/compilation.py.

    A scene far from the origin for its size, as georeferenced ones are, is moved there to be solved, and back
    (`transform.FAR`).

    Many problems of many shapes may be solved in one process: before their programs exceed what Linux lets a process
    map, all compiled programs of JAX are dropped (`process.release_programs`), and compiled anew where they are needed.

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
    check_count("max_iterations", max_iterations, 1)
    policy = make_policy(damping) if isinstance(damping, str) else damping
    if not isinstance(policy, DampingPolicy):
        raise ValueError(f"damping must be the name of a policy or a policy, not {damping!r}")
    if options is None:
        options = policy.config.step_options(StepOptions()) if isinstance(policy, Learned) else StepOptions()
    if isinstance(policy, Learned) and options.scaling != StepOptions().scaling:
        raise ProblemError(
            f"a learned policy knows lambda as a factor on the diagonal, not with scaling {options.scaling!r}"
        )
    options = make_method(method).options(options)
    capacity = None
    if pad:
        capacity, linear_solver = with_padded_solver(capacity_of(problem), options, linear_solver)
    options = choose_linear_solver(problem, options, linear_solver)
    tolerances = tolerances or Tolerances()
    for name, value in tolerances._asdict().items():
        if not value >= 0:
            raise ValueError(f"{name} must not be negative, is {value}")
    if dtype == "mixed":
        if options.linear_solver not in REDUCED_SOLVERS:
            raise ProblemError(
                f"mixed types are for plain LM solved by {', '.join(REDUCED_SOLVERS)}; others have float64 or float32"
            )
        options, dtype = replace(options, algebra="mixed"), "float64"
    with jax.enable_x64(dtype == "float64"), process.single_blas_thread():
        started = time.perf_counter()
        middle = far_middle(problem)
        here = problem if middle is None else shift(problem, -middle)
        with CompileClock() as clock:
            layout = jax.device_put(layout_for(problem, options, capacity))
            initial = program(initial_state, "options", "dtype", level="quick")
            begin = here if capacity is None else padded_parameters(here, capacity)
            state = jax.block_until_ready(compile_and_run(initial, layout, begin, options, jnp.dtype(dtype)))
        setup_s = max(0.0, time.perf_counter() - started - clock.seconds)
        if not np.isfinite(float(state.cost)):
            raise ProblemError(explain_start(problem))
        before = _stages(compilation, problem, options)
        run = functools.partial(run_stepwise, callback=callback or (lambda _: None), stages=before)
        if callback is None and not any(before.values()):
            run = _run_compiled
        final, history, quick_count, compile_s, total_s = run(
            layout, state, policy, tolerances, options, max_iterations
        )
        if clock.seconds + compile_s > 0:
            process.release_programs()  # many problems in one process would end it
        count = int(final.iteration)
        history = History(*(np.asarray(field)[:count] for field in history))
        found = write_back(here, layout, final.state, options)
        return Solution(
            problem=found if middle is None else shift(found, middle),
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
            quick_iterations=quick_count,
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


def _stages(compilation: str, problem: BundleProblem, options: StepOptions) -> dict[str, tuple[Stage, ...]]:
    """How each part of a step is compiled before it is optimised."""
    parts: dict[str, Part] = {"round": "decomposition"}
    if options.in_two:
        parts = {"propose": "factorization" if options.factors else "iterative", "judge": "acceptance"}
    if compilation == "full" or compiler_options("quick") is None:
        return dict.fromkeys(parts, ())
    if compilation == "quick":
        return dict.fromkeys(parts, (Stage("quick", sys.maxsize),))
    return {name: stages(part, problem.num_observations) for name, part in parts.items()}


def _run_compiled(
    layout: Layout,
    state: LMState,
    policy: DampingPolicy,
    tolerances: Tolerances,
    options: StepOptions,
    max_iterations: int,
) -> tuple[Carry, History, int, float, float]:
    """The loop as one optimised program; returns what `run_stepwise` does."""
    started = time.perf_counter()
    with CompileClock() as clock:
        room = max(LEAST_ROOM, 1 << (max_iterations - 1).bit_length())
        limit = jnp.asarray(max_iterations, jnp.int32)
        whole = solve_loop(layout, state, policy, tolerances, options, room, limit)
        carry, history = jax.block_until_ready(whole)
    return carry, history, 0, clock.seconds, time.perf_counter() - started - clock.seconds


def write_back(problem: BundleProblem, layout: Layout, state: LMState, options: StepOptions) -> BundleProblem:
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
