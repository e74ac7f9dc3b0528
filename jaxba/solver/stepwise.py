"""Iterations run from Python, for callbacks and for programs that are replaced while they run.

The iteration is that of iteration.py. It consists of three programs (linear solve, accept decision, policy), which are
compiled in parallel, each with its own level of optimisation, and replaced by better ones when that pays
(runtime/compilation.py). In one program the candidates of a step are turns of a loop (refinement/candidates.py). Here
Python is that loop, so that camera rounds are compiled only if a solve has some. What is computed is the same.
"""

from __future__ import annotations

import sys
import time
from collections import Counter
from collections.abc import Callable, Mapping
from typing import Any

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
    Part,
    Program,
    compiler_options,
    program,
    quick_runs,
)
from jaxba.solver.drivers import Driver
from jaxba.solver.iteration import Carry, advance, begin, problem_info
from jaxba.structure.layout import Layout, num_partitions

WORTH_S = 0.15
"""Seconds of quickly compiled iterations from which on better programs are compiled for later calls: a seventh of the
shortest call."""

NEVER = sys.maxsize
"""Runs of a quick program after which a better one is compiled, if it never is."""

Call = Callable[..., Any]
"""Runs a program with these arguments, or compiles it for them."""


class Stepwise(Driver):
    """Iterations one at a time on one device, of programs at their own levels."""

    def __init__(self, first: Mapping[str, int], *arguments: Any) -> None:
        """`first` are runs of each part of a step before it is fully optimised (`quick_runs_of`); other arguments as
        for `Driver`."""
        super().__init__(*arguments)
        self._first, self._runs = first, Counter[str]()
        self._levels = self._levels_now()
        self._wanted: dict[str, Wanted] = {}  # fully optimised programs of which the quick ones were run
        self._seen, self._ran_quick, self._quick_s = set[str](), False, 0.0
        self._programs, self._compile_s = ParallelCompilation(), 0.0

    def _levels_now(self) -> dict[str, Level]:
        return {name: "quick" if self._runs[name] < runs else "full" for name, runs in self._first.items()}

    def _run(self, function: Program, *arguments: Any) -> Any:
        self._runs[function.function.__name__] += 1
        return self._programs.run(function, *arguments)

    def compile_s(self) -> float:
        """See `Driver`."""
        return self._compile_s + self._programs.late_s

    def begin(self) -> LMState:
        """The state at the start."""
        began, setup = time.perf_counter(), self.setup
        with self._programs as compile_programs:
            self._iterate(compile_programs, self._begin(compile_programs, setup.initial(compile_programs)))
        state = jax.block_until_ready(setup.initial(self._run))
        self.carry = jax.block_until_ready(self._begin(self._run, state))
        if self.clock.seconds > 0 or self._programs.loaded:
            self._compile_s = time.perf_counter() - began - self._programs.late_s
        return state

    def iterate(self) -> tuple[StepInfo, Termination]:
        """One iteration: its record, of Python scalars, and whether it ended the solve."""
        if self._levels != (now := self._levels_now()):
            self._levels, began = now, time.perf_counter()
            with self.compiling(), self._programs:
                self._iterate(self._programs, self.carry)
            self._compile_s += time.perf_counter() - began
        self._ran_quick, began = False, time.perf_counter()
        self.carry, step, report = self._iterate(self._run, self.carry)
        unpacked = _unpack(report, step)
        if self._ran_quick:
            self.quick_iterations += 1
            self._quick_s += time.perf_counter() - began
        return unpacked

    def end(self) -> None:
        """See `Driver`."""
        if self._quick_s > WORTH_S and (wanted := [one for one in self._wanted.values() if not one.path.exists()]):
            compile_later(wanted)

    def _part(self, function: Callable[..., Any], *arguments: Any) -> tuple[Any, ...]:
        """The program of a part of the step at its level, and its arguments. A fully optimised one that is on disk is
        taken; one that is not is noted."""
        name = function.__name__
        if name not in self._seen and 0 < self._first[name] < NEVER:
            self._seen.add(name)
            path = self._programs.path(program(function, "options"), *arguments)
            if path and path.exists():
                self._first = {**self._first, name: 0}
                self._levels = self._levels_now()
            elif path:
                self._wanted[name] = Wanted(function, outline(arguments), path)
        self._ran_quick |= self._levels[name] == "quick"
        return program(function, "options", level=self._levels[name]), *arguments

    def _begin(self, call: Call, state: LMState) -> Carry:
        """The carry before the first iteration, from the initial state."""
        setup = self.setup
        info_program = program(problem_info, "options", level="quick")
        info = call(info_program, setup.layout, state, setup.options, self.limit)
        # without the parameters, whose shapes differ, the policy's program is compiled once for all problems
        return call(program(begin, level="quick"), info, setup.policy, None)._replace(state=state)

    def _iterate(self, call: Call, carry: Carry) -> tuple[Carry, StepInfo, Any]:
        """One iteration: the next carry, its record, and the packed report for the host."""
        state, layout, options, policy = carry.state, self.setup.layout, self.setup.options, self.setup.policy

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
        policy_arguments = (carry._replace(state=None), step, policy, self.tolerances, self.limit, partitions)
        carry, report = call(program(_advance_and_pack, level="quick"), *policy_arguments)
        return carry._replace(state=state), step, report


def parts_of(options: StepOptions) -> dict[str, Part]:
    """The parts into which a step with these options is compiled, by the names of their functions."""
    found: dict[str, Part] = {}
    factors = options.forms_reduced_system and options.truncated is None
    found[propose.__name__] = "factorization" if factors else "iterative"
    found[(try_candidate if has_repairs(options) else try_step).__name__] = "acceptance"
    if options.refinement.camera_rounds:
        found[camera_round.__name__] = "cameras"
    return found


def quick_runs_of(compilation: Compilation, observations: int, options: StepOptions) -> dict[str, int]:
    """How often each part of a step is run before it is fully optimised."""
    parts = parts_of(options)
    if compilation == "full" or not compiler_options("quick"):
        return dict.fromkeys(parts, 0)
    if compilation == "quick":
        return dict.fromkeys(parts, NEVER)
    return {name: quick_runs(part, observations) for name, part in parts.items()}


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
    """One turn of the search for the candidate of a step, and what comes next. Arguments as for `next_search`."""
    against = comparison(layout, *state[:3], proposal.reference, proposal.step, options, min_gain)
    search = next_search(against, search, refined)
    following = jnp.where(search.active, jnp.where(search.refining, CAMERA_ROUND, CANDIDATE), NOTHING)
    return search, following


def camera_round(layout: Layout, candidate: Candidate, options: StepOptions) -> Float[Array, "parameters cameras"]:
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
    """`try_step`, with the same arguments or their shapes and types, by programs that `call` runs or compiles.

    Camera rounds are read from disk, but not compiled, before they are run. `part` gives the program of a part of the
    step, at its present level, and the arguments."""
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
    return call(program(take_step, "options", level="quick"), layout, state, damping, proposal, search.best, options)


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
