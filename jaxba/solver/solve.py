"""The whole solve: iterate the step under a damping policy until it converges.

Without a callback the loop is one compiled program (solver/loop.py). With one, or where compilation is in a hurry, the
same iteration runs step by step from Python (solver/callback_loop.py).
"""

from __future__ import annotations

import functools
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from jaxba.damping import DampingPolicy
from jaxba.lm.records import LMState
from jaxba.lm.termination import Termination, Tolerances
from jaxba.problem.bundle_problem import BundleProblem
from jaxba.problem.options import StepOptions
from jaxba.runtime import process
from jaxba.runtime.compilation import CompileClock, Part, Stage, compiler_options, stages
from jaxba.solver.callback_loop import IterationRecord, run_stepwise
from jaxba.solver.loop import Carry, History, solve_loop
from jaxba.solver.options import SolveOptions
from jaxba.solver.prepare import DEFAULT_POLICY, prepare
from jaxba.structure.layout import Layout
from jaxba.structure.padding import Capacity

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
    policy: str | DampingPolicy = DEFAULT_POLICY,
    options: SolveOptions | None = None,
    *,
    callback: Callable[[IterationRecord], bool | None] | None = None,
) -> Solution:
    """Minimises the reprojection cost over cameras and points.

    Args:
        problem: start of the optimisation.
        policy: chooses the damping lambda of every iteration: a policy, or the name of one (`jaxba.make_policy`).
        options: how; the defaults if left out.
        callback: called after every iteration; a true return value stops the solve.

    A scene far from the origin for its size, as georeferenced ones are, is moved there to be solved, and back
    (`preprocess.FAR`).

    Many problems of many shapes may be solved in one process: before their programs exceed what Linux lets a process
    map, all compiled programs of JAX are dropped (`process.release_programs`), and compiled anew where they are needed.

    Returns:
        Parameters as NumPy float64 arrays, histories and timings.

    Raises:
        ValueError: unknown names, or options that do not go together.
        ProblemError: the cost at the start is not finite, a factorisation would take more memory than there is, or the
            step asked for cannot hold the problem's lenses.
    """
    options = SolveOptions() if options is None else options
    with jax.enable_x64(options.dtype != "float32"), process.single_blas_thread():
        prepared = prepare(problem, options, policy=policy)
        layout, state, step_options = prepared.layout, prepared.state, prepared.options
        before = _stages(options.compilation, problem, step_options)
        run = functools.partial(run_stepwise, callback=callback or (lambda _: None), stages=before)
        if callback is None and not any(before.values()):
            run = _run_compiled
        final, history, quick_count, compile_s, total_s = run(
            layout, state, prepared.policy, options.tolerances, step_options, options.max_iterations
        )
        if prepared.compile_s + compile_s > 0:
            process.release_programs()  # many problems in one process would end it
        count = int(final.iteration)
        history = History(*(np.asarray(field)[:count] for field in history))
        return Solution(
            problem=prepared.problem_at(final.state),
            initial_cost=float(state.cost),
            final_cost=float(final.state.cost),
            iterations=count,
            accepted=int(np.sum(history.accepted)),
            termination=Termination(int(final.termination)),
            history=history,
            linear_solver=step_options.solver_name,
            setup_s=prepared.setup_s,
            compile_s=compile_s + prepared.compile_s,
            total_s=total_s,
            capacity=prepared.capacity,
            quick_iterations=quick_count,
        )


def _stages(compilation: str, problem: BundleProblem, options: StepOptions) -> dict[str, tuple[Stage, ...]]:
    """How each part of a step is compiled before it is optimised."""
    parts: dict[str, Part] = {"round": "decomposition"}
    if options.single_solve:
        factors = options.forms_reduced_system and options.truncated is None
        parts = {"propose": "factorization" if factors else "iterative", "try_step": "acceptance"}
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
