"""The solve loop run from Python, for callbacks and for programs that are replaced while it runs.

The iteration is that of solver/loop.py. Every record has the wall-clock time at which the iteration ended, and quickly
compiled programs can be replaced by optimised ones (runtime/compilation.py). An iteration consists of three programs
(linear solve, accept decision, policy), which are compiled in parallel, each with its own level of
optimisation.
"""

from __future__ import annotations

import functools
import time
from collections import Counter
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from jaxba.damping import DampingPolicy
from jaxba.lm.records import LMState, StepInfo
from jaxba.lm.step import lm_step, propose, try_step
from jaxba.lm.termination import Termination, Tolerances
from jaxba.problem.bundle_problem import BundleProblem
from jaxba.problem.options import StepOptions
from jaxba.refinement.candidates import has_repairs
from jaxba.runtime.compilation import (
    CompileClock,
    Level,
    ParallelCompilation,
    Part,
    Program,
    Stage,
    level_after,
    program,
)
from jaxba.solver.candidate_loop import camera_round, try_candidate, try_step_by_parts
from jaxba.solver.loop import Carry, History, advance, begin, history_of, problem_info
from jaxba.solver.prepare import Setup
from jaxba.structure.layout import Layout, num_partitions


class IterationRecord(NamedTuple):
    """The argument of a callback."""

    iteration: int
    """Number of the iteration, from 1."""

    time_s: float
    """Seconds since the start of the first iteration, without compilation."""

    step: StepInfo
    """Record of the iteration, as Python scalars."""


Watch = Callable[[IterationRecord, Callable[[], BundleProblem]], None]
"""Gets the record of an iteration, and a function that gives the problem with the parameters after it."""


class _Loop(NamedTuple):
    """The constants of a solve. The argument `call` of its functions either runs a program or compiles it."""

    layout: Layout
    policy: DampingPolicy
    tolerances: Tolerances
    options: StepOptions
    max_iterations: int

    def start(self, call: Callable[..., Any], state: LMState) -> Carry:
        """The carry before the first iteration, from the initial state."""
        info_program = program(problem_info, "options", "max_iterations", level="quick")
        info = call(info_program, self.layout, state, self.options, self.max_iterations)
        # without the parameters, whose shapes differ, the policy's program is compiled once for all problems
        return call(program(begin, level="quick"), info, self.policy, None)._replace(state=state)

    def iterate(
        self, call: Callable[..., Any], carry: Carry, levels: Mapping[str, Level]
    ) -> tuple[Carry, StepInfo, Any]:
        """One iteration: the next carry, its record, and the packed report for the host.

        Args:
            call: runs or compiles a program.
            carry: before the iteration.
            levels: level of compilation of each part of the step, by the name of its function.
        """
        state, options = carry.state, self.options
        part = lambda function: program(function, "options", level=levels[function.__name__])
        # NumPy's: each conversion by JAX is a program
        min_gain = np.asarray(self.policy.min_gain, state.cost.dtype)
        if options.single_solve:
            arguments = (self.layout, state, carry.damping)
            proposal = call(part(propose), *arguments, options, carry.iteration)
            arguments = (*arguments, proposal, options, min_gain)
            if has_repairs(options):
                state, step = try_step_by_parts(call, part, *arguments)
            else:
                state, step = call(part(try_step), *arguments)
        else:
            arguments = (self.layout, state, carry.damping, options, min_gain, carry.iteration)
            state, step = call(part(lm_step), *arguments)
        limit, partitions = np.int32(self.max_iterations), np.int32(num_partitions(self.layout))
        policy_arguments = (carry._replace(state=None), step, self.policy, self.tolerances, limit, partitions)
        carry, report = call(program(_advance_and_pack, level="quick"), *policy_arguments)
        return carry._replace(state=state), step, report


def parts_of(options: StepOptions) -> dict[str, Part]:
    """The parts into which a step with these options is compiled, by the names of their functions."""
    found: dict[str, Part] = {}
    if not options.single_solve:
        found[lm_step.__name__] = "decomposition"
        return found
    factors = options.forms_reduced_system and options.truncated is None
    found[propose.__name__] = "factorization" if factors else "iterative"
    found[(try_candidate if has_repairs(options) else try_step).__name__] = "acceptance"
    if options.refinement.camera_rounds:
        found[camera_round.__name__] = "cameras"
    return found


class Run(NamedTuple):
    """What a solve came to."""

    carry: Carry
    """After the last iteration."""

    history: History
    """At least one entry per iteration."""

    initial_cost: float
    """Pixels^2."""

    quick_iterations: int
    """Iterations in which some program was not fully optimised."""

    compile_s: float
    """Seconds of compilation."""

    total_s: float
    """Seconds of everything else."""


def run_stepwise(
    setup: Setup,
    tolerances: Tolerances,
    max_iterations: int,
    *,
    callback: Callable[[IterationRecord], bool | None],
    stages: Mapping[str, tuple[Stage, ...]],
    watch: Watch | None = None,
) -> Run:
    """Runs iterations until a stopping rule or the callback ends the solve.

    Args:
        setup: the solve; the program of its initial state is compiled with the others.
        tolerances: convergence tests.
        max_iterations: limit of linear solves.
        callback: called with every record; a true return value ends the solve.
        stages: stages of compilation of each part of a step, by the name of its function, before it is fully optimised
            (`parts_of`).
        watch: called before the callback; its time counts nowhere.

    Raises:
        ProblemError: the cost of the initial state is not finite.
    """
    loop = _Loop(setup.layout, setup.policy, tolerances, setup.options, max_iterations)
    runs: Counter[str] = Counter()

    def levels_now() -> dict[str, Level]:
        return {name: level_after(runs[name], of_part) for name, of_part in stages.items()}

    optimised = lambda levels: set(levels.values()) == {"full"}
    levels = levels_now()
    started = time.perf_counter()
    with CompileClock() as clock, ParallelCompilation() as compile_programs:
        loop.iterate(compile_programs, loop.start(compile_programs, setup.initial(compile_programs)), levels)

    def run(function: Program, *arguments: Any) -> Any:
        runs[function.function.__name__] += 1
        return compile_programs.run(function, *arguments)

    state = jax.block_until_ready(setup.initial(run))
    setup.check_cost(state)
    carry = jax.block_until_ready(loop.start(run, state))
    compile_s = 0.0
    if clock.seconds > 0 or compile_programs.loaded:
        # warm-up, so that the first iteration is timed like later ones: a first run also allocates memory
        if optimised(levels):
            jax.block_until_ready(loop.iterate(run, carry, levels)[2])
        compile_s = time.perf_counter() - started
    records, quick_iterations = [], 0
    started, waited, late_s = time.perf_counter(), 0.0, compile_programs.late_s
    while True:
        if levels != (now := levels_now()):
            levels, began = now, time.perf_counter()
            with compile_programs:
                loop.iterate(compile_programs, carry, levels)
            waited += time.perf_counter() - began
        carry, step, report = loop.iterate(run, carry, levels)
        waited, late_s = waited + compile_programs.late_s - late_s, compile_programs.late_s
        step, end = _unpack(report, step)
        records.append(step)
        quick_iterations += not optimised(levels)
        record = IterationRecord(len(records), time.perf_counter() - started - waited, step)
        if watch is not None:
            began = time.perf_counter()
            watch(record, functools.partial(setup.problem_at, carry.state))
            started += time.perf_counter() - began
        wants_stop = callback(record)
        if end != Termination.RUNNING:
            break
        if wants_stop:
            carry = carry._replace(termination=jnp.asarray(int(Termination.STOPPED), jnp.int32))
            break
    total_s = time.perf_counter() - started - waited
    history = jax.tree.map(lambda *values: np.array(values), *map(history_of, records))
    return Run(carry, history, float(state.cost), quick_iterations, compile_s + waited, total_s)


def _advance_and_pack(
    carry: Carry, step: StepInfo, policy: DampingPolicy, tolerances: Tolerances, max_iterations: Any, partitions: Any
) -> tuple[Carry, Float[Array, " report"]]:
    """`advance` without the parameters, and the record with the termination as one array: one transfer to the host."""
    after = advance(carry, None, step, policy, tolerances, max_iterations, partitions)
    return after, jnp.stack([x.astype(step.cost.dtype) for x in (*step, after.termination)])


def _unpack(report: Float[Array, " report"], shapes: StepInfo) -> tuple[StepInfo, Termination]:
    """The record and the termination packed by `_advance_and_pack`, as Python scalars of the types of `shapes`."""
    *values, end = np.asarray(report).tolist()
    kinds = {"b": bool, "i": int, "f": float}
    return StepInfo(*(kinds[x.dtype.kind](v) for v, x in zip(values, shapes, strict=True))), Termination(int(end))
