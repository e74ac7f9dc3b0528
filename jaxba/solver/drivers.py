"""Who runs the iterations of a solve, and what they show of each: one compiled program, on one
device or several.

The third way, from Python, is stepwise.py."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxba.lm.records import LMState, StepInfo
from jaxba.lm.termination import Termination, Tolerances
from jaxba.problem.bundle_problem import BundleProblem
from jaxba.runtime.compilation import CompileClock, compile_and_run
from jaxba.solver.iteration import Carry
from jaxba.solver.loop import solve_loop
from jaxba.solver.prepare import Setup
from jaxba.solver.sharded import Shards


class IterationRecord(NamedTuple):
    """The argument of a callback."""

    iteration: int
    """Number of the iteration, from 1."""

    time_s: float
    """Seconds since the start of the first iteration, without compilation."""

    step: StepInfo
    """Record of the iteration, as Python scalars."""


Callback = Callable[[IterationRecord], bool | None]
"""Gets the record of an iteration; a true return value ends the solve."""

Watch = Callable[[IterationRecord, Callable[[], BundleProblem]], None]
"""Gets the record of an iteration, and a function that gives the problem with the parameters after
it."""

MIN_LENGTH = 128
"""Smallest length of the record of a compiled loop, so that all lower limits use one program;
larger limits are rounded up to a power of two."""


def record_length(max_iterations: int) -> int:
    """The length of the record of a compiled loop."""
    return max(MIN_LENGTH, 1 << (max(1, int(max_iterations)) - 1).bit_length())


class Driver:
    """What all ways to run the iterations of a solve have in common. Each has `begin`, which gives
    the state at the start, and `finish`, which runs all iterations as one program, or `iterate`,
    which runs one, or both."""

    carry: Carry
    """The state of the loop; from `begin`, or `finish`, on."""

    whole = True
    """Whether all iterations may be one program. In that of a problem in parts an iteration takes
    half as long again, and it compiles in twice the time."""

    quick_iterations = 0
    """Iterations in which some program was not fully optimised."""

    compiling: Callable[[], AbstractContextManager] = nullcontext
    """The context in which programs compile after `begin`."""

    def __init__(
        self, setup: Setup, tolerances: Tolerances, max_iterations: int, clock: CompileClock
    ) -> None:
        self.setup = setup
        self.tolerances = tolerances
        self.clock = clock
        # a conversion by JAX is a program
        self.limit = np.asarray(max(1, max_iterations), np.int32)
        self.length = record_length(max_iterations)

    def compile_s(self) -> float:
        """Seconds of compilation so far."""
        return self.clock.seconds

    def end(self) -> None:
        """After the last iteration: notes what later solves should know."""

    def _ended(self, found: tuple[Carry, StepInfo]) -> tuple[StepInfo, Termination]:
        """The records of all iterations as one, and why the solve ended."""
        self.carry, columns = jax.block_until_ready(found)
        count = int(self.carry.iteration)
        steps = jax.tree.map(lambda column: np.asarray(column)[:count], columns)
        return steps, Termination(int(self.carry.termination))


class Compiled(Driver):
    """All iterations as one program on one device."""

    def begin(self) -> LMState:
        """The state at the start."""
        self._start = jax.block_until_ready(self.setup.initial(compile_and_run))
        return self._start

    def finish(self) -> tuple[StepInfo, Termination]:
        """Runs to the end; the records of all iterations as one, and why it ended."""
        setup = self.setup
        options = setup.policy, self.tolerances, setup.options, self.length, self.limit
        return self._ended(solve_loop(setup.layout, self._start, *options))


class OnDevices(Driver):
    """Several devices, all iterations as one program or one at a time."""

    def __init__(self, shards: Shards, *arguments: Any) -> None:
        super().__init__(*arguments)
        self._shards, self.whole = shards, not shards.in_parts

    def begin(self) -> LMState:
        """The state at the start."""
        self.carry = self._shards.begin(self.setup.policy, self.limit)
        if not self.whole:
            self._shards.compile(self.carry, self.setup.policy, self.tolerances, self.limit)
        return jax.block_until_ready(self.carry.state)

    def finish(self) -> tuple[StepInfo, Termination]:
        """See `Compiled`."""
        return self._ended(
            self._shards.run(
                self.carry, self.setup.policy, self.tolerances, self.limit, self.length
            )
        )

    def iterate(self) -> tuple[StepInfo, Termination]:
        """One iteration: its record, of Python scalars, and whether it ended the solve."""
        self.carry, step = self._shards.run(
            self.carry, self.setup.policy, self.tolerances, self.limit
        )
        step = jax.tree.map(lambda x: x.item(), jax.device_get(step))
        return step, Termination(int(self.carry.termination))
