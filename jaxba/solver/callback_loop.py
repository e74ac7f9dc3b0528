"""The loop of a solve step by step, for whoever watches it or is in a hurry.

The same iteration as in solver/loop.py, run from Python: every record carries the wall-clock time at which it was
finished, and quickly compiled programs may give way to optimised ones (runtime/compilation.py). An iteration is three
programs (the linear solve, the verdict on the step, the policy), so that they compile beside each other and each only
as well as it pays.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from jaxba.damping import DampingPolicy, decides_effort, effort_of
from jaxba.lm.records import LMState, StepInfo
from jaxba.lm.step import lm_step, propose, try_step
from jaxba.lm.termination import Termination, Tolerances
from jaxba.problem.options import StepOptions
from jaxba.runtime.compilation import (
    RUNS_PER_REPAIR,
    CompileClock,
    Level,
    ParallelCompilation,
    Stage,
    level_after,
    program,
)
from jaxba.solver.loop import Carry, History, advance, begin, history_of, problem_info
from jaxba.structure.layout import Layout, num_partitions


class IterationRecord(NamedTuple):
    """What a callback sees."""

    iteration: int  # from 1
    time_s: float  # seconds since the first iteration started, compilation excluded
    step: StepInfo  # Python and NumPy scalars


class _Loop(NamedTuple):
    """What stays from one iteration to the next. `call` runs programs, or has them compiled."""

    layout: Layout
    policy: DampingPolicy
    tolerances: Tolerances
    options: StepOptions
    max_iterations: int

    def start(self, call: Callable[..., Any], state: LMState) -> Carry:
        """The carry before the first iteration."""
        inform = program(problem_info, "options", "max_iterations", level="quick")
        info = call(inform, self.layout, state, self.options, self.max_iterations)
        # without the parameters what is the policy's compiles once for all problems
        return call(program(begin, level="quick"), info, self.policy, None)._replace(state=state)

    def iterate(
        self, call: Callable[..., Any], carry: Carry, levels: Mapping[str, Level]
    ) -> tuple[Carry, StepInfo, Any]:
        """One iteration, its parts compiled at these levels: the carry after it, its record, and that for the host."""
        state, options = carry.state, self.options
        effort = None
        if decides_effort(self.policy):
            effort = call(program(effort_of, level="quick"), self.policy, carry.policy)
        part = lambda name, function: program(function, "options", level=levels[name])
        min_gain = jnp.asarray(self.policy.min_gain, state.cost.dtype)
        if options.single_solve:
            given = (self.layout, state, carry.damping)
            proposal = call(part("propose", propose), *given, options, carry.iteration, effort)
            state, step = call(part("try_step", try_step), *given, proposal, options, min_gain, effort)
        else:
            given = (self.layout, state, carry.damping, options, min_gain, carry.iteration, effort)
            state, step = call(part("round", lm_step), *given)
        limit = jnp.asarray(self.max_iterations, jnp.int32)
        own = (
            carry._replace(state=None),
            step,
            self.policy,
            self.tolerances,
            limit,
            jnp.asarray(num_partitions(self.layout)),
        )
        carry, facts = call(program(_advance_and_tell, level="quick"), *own)
        return carry._replace(state=state), step, facts


def run_stepwise(
    layout: Layout,
    state: LMState,
    policy: DampingPolicy,
    tolerances: Tolerances,
    options: StepOptions,
    max_iterations: int,
    *,
    callback: Callable[[IterationRecord], bool | None],
    stages: Mapping[str, tuple[Stage, ...]],
) -> tuple[Carry, History, int, float, float]:
    """Iterates until a stop rule or the callback ends it.

    Args:
        layout: the problem's observations.
        state: start.
        policy: chooses lambda.
        tolerances: convergence tests.
        options: static.
        max_iterations: limit of linear solves.
        callback: sees every record; a true answer ends the solve.
        stages: how each part of a step is compiled before it is optimised, `propose` and `try_step`, or `round`. A
            camera round or a further trial counts for `RUNS_PER_REPAIR` more runs.

    Returns:
        Final carry, histories of as many entries as there were iterations, how many of these had a part
        that was not optimised, seconds of compilation and seconds of everything else.
    """
    loop = _Loop(layout, policy, tolerances, options, max_iterations)
    runs = dict.fromkeys(stages, 0)

    def levels_now() -> dict[str, Level]:
        return {name: level_after(runs[name], of_part) for name, of_part in stages.items()}

    optimised = lambda levels: set(levels.values()) == {"full"}
    levels = levels_now()
    started = time.perf_counter()
    with CompileClock() as clock, ParallelCompilation() as compile_programs:
        loop.iterate(compile_programs, loop.start(compile_programs, state), levels)
    run = compile_programs.run
    carry = jax.block_until_ready(loop.start(run, state))
    compile_s = 0.0
    if clock.seconds > 0 or compile_programs.loaded:
        # a program's first run touches its memory for the first time; it is the time of later runs that is reported
        if optimised(levels):
            jax.block_until_ready(loop.iterate(run, carry, levels)[2])
        compile_s = time.perf_counter() - started
    records, quick_iterations = [], 0
    started, waited = time.perf_counter(), 0.0
    while True:
        if levels != (now := levels_now()):
            levels, began = now, time.perf_counter()
            with compile_programs:
                loop.iterate(compile_programs, carry, levels)
            waited += time.perf_counter() - began
        carry, step, facts = loop.iterate(run, carry, levels)
        step, end = _told(facts, step)
        records.append(step)
        quick_iterations += not optimised(levels)
        for name in runs:
            runs[name] += 1 + RUNS_PER_REPAIR * int(step.repairs) if name == "try_step" else 1
        wants_stop = callback(IterationRecord(len(records), time.perf_counter() - started - waited, step))
        if end != Termination.RUNNING:
            break
        if wants_stop:
            carry = carry._replace(termination=jnp.asarray(int(Termination.STOPPED), jnp.int32))
            break
    total_s = time.perf_counter() - started - waited
    history = jax.tree.map(lambda *values: np.array(values), *map(history_of, records))
    return carry, history, quick_iterations, compile_s + waited, total_s


def _advance_and_tell(
    carry: Carry, step: StepInfo, policy: DampingPolicy, tolerances: Tolerances, max_iterations: Any, turns: Any
) -> tuple[Carry, Float[Array, " facts"]]:
    """`advance` without the parameters, and for the host the step and the end, as one array: one transfer, not 15."""
    after = advance(carry, None, step, policy, tolerances, max_iterations, turns)
    return after, jnp.stack([x.astype(step.cost.dtype) for x in (*step, after.termination)])


def _told(facts: Float[Array, " facts"], shapes: StepInfo) -> tuple[StepInfo, Termination]:
    """The other end of `_advance_and_tell`: Python numbers of the types that `shapes` has."""
    *values, end = np.asarray(facts).tolist()
    kinds = {"b": bool, "i": int, "f": float}
    return StepInfo(*(kinds[x.dtype.kind](v) for v, x in zip(values, shapes, strict=True))), Termination(int(end))
