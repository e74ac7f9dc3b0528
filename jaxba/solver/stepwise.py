"""Iterations run from Python, for callbacks and for programs that are replaced while they run.

The iteration is that of iteration.py. It consists of three programs (linear solve, accept decision,
policy), which are compiled in parallel, each with its own level of optimisation, and replaced by
better ones when that pays (runtime/compilation.py). In one program the candidates of a step are
turns of a loop (refinement/candidates.py). Here Python is that loop, so that camera rounds are
compiled only if a solve has some. What is computed is the same."""

from __future__ import annotations

import sys
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float, Int

from jaxba.damping import DampingPolicy
from jaxba.lm.records import LMState, StepInfo
from jaxba.lm.step import Proposal, propose, take_step, try_step
from jaxba.lm.termination import Termination, Tolerances
from jaxba.problem.options import StepOptions
from jaxba.refinement.acceptance import Candidate, comparison
from jaxba.refinement.cameras import refine_cameras
from jaxba.refinement.candidates import Search, first_search, has_repairs, next_search
from jaxba.runtime.background import Wanted, compile_later, outline
from jaxba.runtime.compilation import (
    Compilation,
    Level,
    ParallelCompilation,
    compiler_options,
    program,
    quick_iterations,
)
from jaxba.solver.drivers import Driver
from jaxba.solver.iteration import Carry, advance, begin, problem_info
from jaxba.structure.layout import Layout, num_partitions

WORTH_S = 0.3
"""Seconds of quickly compiled iterations, of all solves of a process together, from which on better
programs are compiled for later calls, which spares them three quarters of it."""

# of programs that were not fully optimised, by files
_quick_seconds: defaultdict[Path, float] = defaultdict(float)

NEVER = sys.maxsize  # iterations before a step is fully optimised, if it never is

Call = Callable[..., Any]
"""Runs a program with these arguments, or compiles it for them."""


class Stepwise(Driver):
    """Iterations one at a time on one device, of programs at their own levels."""

    def __init__(self, first: int, *arguments: Any) -> None:
        """`first` are the iterations before the step is fully optimised (`iterations_before`);
        other arguments as for `Driver`."""
        super().__init__(*arguments)
        self._first = first
        self._done = 0
        # whether the fully optimised program of a part is on disk
        self._stored: dict[str, bool] = {}
        self._wanted: list[Wanted] = []  # those of which the quick ones were run
        self._ran_quick = False
        self._quick_s = 0.0
        self._programs = ParallelCompilation()
        self._compile_s = 0.0

    def compile_s(self) -> float:
        """See `Driver`."""
        return self._compile_s + self._programs.late_s

    def begin(self) -> LMState:
        """The state at the start."""
        began = time.perf_counter()
        setup = self.setup
        with self._programs as compile_programs:
            self._iterate(
                compile_programs, self._begin(compile_programs, setup.initial(compile_programs))
            )
        state = jax.block_until_ready(setup.initial(self._programs.run))
        self.carry = jax.block_until_ready(self._begin(self._programs.run, state))
        if self.clock.seconds > 0 or self._programs.loaded:
            self._compile_s = time.perf_counter() - began - self._programs.late_s
        return state

    def compile(self) -> None:
        """Compiles the programs of a solve, also those that it may do without, and runs none."""
        with ParallelCompilation(ahead=True) as compile_programs:
            state = self.setup.initial(compile_programs)
            self._iterate(compile_programs, self._begin(compile_programs, state))

    def iterate(self) -> tuple[StepInfo, Termination]:
        """One iteration: its record, of Python scalars, and whether it ended the solve."""
        if self._done == self._first > 0:
            began = time.perf_counter()
            with self.compiling(), self._programs:
                self._iterate(self._programs, self.carry)
            self._compile_s += time.perf_counter() - began
        self._ran_quick, began = False, time.perf_counter()
        self.carry, step, report = self._iterate(self._programs.run, self.carry)
        unpacked = _unpack(report, step)
        self._done += 1
        if self._ran_quick:
            self.quick_iterations += 1
            self._quick_s += time.perf_counter() - began
        return unpacked

    def end(self) -> None:
        """See `Driver`."""
        wanted = [each for each in self._wanted if not each.path.exists()]
        for each in wanted:
            _quick_seconds[each.path] += self._quick_s
        worth = [each for each in wanted if _quick_seconds[each.path] > WORTH_S]
        for each in worth:
            # where another process is at it already, later solves ask again
            del _quick_seconds[each.path]
        if worth:
            compile_later(worth)

    def _part(self, function: Callable[..., Any], *arguments: Any) -> tuple[Any, ...]:
        """The program of a part of the step at its level, and its arguments. A fully optimised one
        that is on disk is taken; one that is not is noted."""
        name = function.__name__
        level = "quick" if self._done < self._first else "full"
        if level == "quick" and self._first < NEVER:
            if name not in self._stored:
                path = self._programs.path(program(function, "options"), *arguments)
                self._stored[name] = bool(path and path.exists())
                if path and not self._stored[name]:
                    self._wanted.append(Wanted(function, outline(arguments), path))
            level = "full" if self._stored[name] else level
        self._ran_quick |= level == "quick"
        return program(function, "options", level=cast(Level, level)), *arguments

    def _begin(self, call: Call, state: LMState) -> Carry:
        """The carry before the first iteration, from the initial state."""
        setup = self.setup
        info_program = program(problem_info, "options", level="quick")
        info = call(info_program, setup.layout, state, setup.options, self.limit)
        # without the parameters, whose shapes differ, the policy's program is compiled once for all
        # problems
        return call(program(begin, level="quick"), info, setup.policy, None)._replace(state=state)

    def _iterate(self, call: Call, carry: Carry) -> tuple[Carry, StepInfo, Any]:
        """One iteration: the next carry, its record, and the packed report for the host."""
        state = carry.state
        layout = self.setup.layout
        options = self.setup.options
        policy = self.setup.policy

        # NumPy's: each conversion by JAX is a program
        min_gain = np.asarray(policy.min_gain, state.cost.dtype)
        arguments = (layout, state, carry.damping)
        proposal = call(*self._part(propose, *arguments, options, carry.iteration))
        arguments = (*arguments, proposal, options, min_gain)
        if has_repairs(options):
            state, step = try_step_by_parts(call, self._part, *arguments)
        else:
            state, step = call(*self._part(try_step, *arguments))
        partitions = np.int32(num_partitions(layout))
        policy_arguments = (
            carry._replace(state=None),
            step,
            policy,
            self.tolerances,
            self.limit,
            partitions,
        )
        carry, report = call(program(_advance_and_pack, level="quick"), *policy_arguments)
        return carry._replace(state=state), step, report


def iterations_before(compilation: Compilation, observations: int, options: StepOptions) -> int:
    """How many iterations are run before a step is fully optimised."""
    if compilation == "full" or not compiler_options("quick"):
        return 0
    factors = options.forms_reduced_system and options.truncated is None
    kind = "factorization" if factors else "iterative"
    return NEVER if compilation == "quick" else quick_iterations(kind, observations)


NOTHING, CANDIDATE, CAMERA_ROUND = range(3)
"""What a search does next."""


def try_candidate(
    layout: Layout,
    state: LMState,
    proposal: Proposal,
    options: StepOptions,
    min_gain: Float[Array, ""],
    search: Search,
    refined: Float[Array, "parameters cameras"],
) -> tuple[Search, Int[Array, ""]]:
    """One turn of the search for the candidate of a step, and what comes next. Arguments as for
    `next_search`."""
    against = comparison(layout, *state[:3], proposal.reference, proposal.step, options, min_gain)
    search = next_search(against, search, refined)
    following = jnp.where(
        search.active, jnp.where(search.refining, CAMERA_ROUND, CANDIDATE), NOTHING
    )
    return search, following


def camera_round(
    layout: Layout, candidate: Candidate, options: StepOptions
) -> Float[Array, "parameters cameras"]:
    """The cameras of a candidate, each re-optimised on its own."""
    return refine_cameras(layout, candidate.cameras, candidate.points, options)


def try_step_by_parts(
    call: Call,
    part: Callable[..., tuple[Any, ...]],
    layout: Layout,
    state: LMState,
    damping: Any,
    proposal: Proposal,
    options: StepOptions,
    min_gain: Any,
) -> tuple[LMState, StepInfo]:
    """`try_step`, with the same arguments or their shapes and types, by programs that `call` runs
    or compiles.

    Camera rounds are read from disk, but not compiled, before they are run. `part` gives the
    program of a part of the step, at its present level, and the arguments."""
    search = first_search(state.cameras, state.points, state.cost, proposal.step)
    refined = state.cameras
    while True:
        arguments = (layout, state, proposal, options, min_gain, search, refined)
        search, following = call(*part(try_candidate, *arguments))
        if isinstance(call, ParallelCompilation) and options.refinement.camera_rounds:
            call.read(*part(camera_round, layout, search.candidate, options))
        if not isinstance(following, Array) or int(following) == NOTHING:
            break
        if int(following) == CAMERA_ROUND:
            refined = call(*part(camera_round, layout, search.candidate, options))
    return call(
        program(take_step, "options", level="quick"),
        layout,
        state,
        damping,
        proposal,
        search.best,
        options,
    )


def _advance_and_pack(
    carry: Carry,
    step: StepInfo,
    policy: DampingPolicy,
    tolerances: Tolerances,
    max_iterations: Any,
    partitions: Any,
) -> tuple[Carry, Float[Array, " report"]]:
    """`advance` without the parameters, and the record with the termination as one array: one
    transfer to the host."""
    after = advance(carry, None, step, policy, tolerances, max_iterations, partitions)
    return after, jnp.stack([x.astype(step.cost.dtype) for x in (*step, after.termination)])


def _unpack(report: Float[Array, " report"], shapes: StepInfo) -> tuple[StepInfo, Termination]:
    """The record and the termination packed by `_advance_and_pack`, as Python scalars of the types
    of `shapes`."""
    *values, end = np.asarray(report).tolist()
    kinds = {"b": bool, "i": int, "f": float}
    return StepInfo(
        *(kinds[x.dtype.kind](v) for v, x in zip(values, shapes, strict=True))
    ), Termination(int(end))
