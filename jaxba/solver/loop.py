"""The loop that `solve` runs: iterations by a driver, with their records, the clock, and who looks at them."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable
from typing import NamedTuple

from jaxba.lm.records import LMState, StepInfo
from jaxba.lm.termination import Termination
from jaxba.problem.bundle_problem import BundleProblem
from jaxba.runtime.compilation import CompileClock
from jaxba.solver.driver import Compiled, OnDevices
from jaxba.solver.options import SolveOptions
from jaxba.solver.prepare import Setup
from jaxba.solver.stepwise import Stepwise, quick_runs_of


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
"""Gets the record of an iteration, and a function that gives the problem with the parameters after it."""


class Run(NamedTuple):
    """What a solve came to."""

    state: LMState
    """After the last iteration."""

    steps: StepInfo
    """Records of all iterations, NumPy arrays."""

    termination: Termination
    """Why it ended."""

    initial_cost: float
    """Pixels^2."""

    quick_iterations: int
    """Iterations in which some program was not fully optimised."""

    compile_s: float
    """Seconds of compilation."""

    total_s: float
    """Seconds of the iterations."""


def run(setup: Setup, options: SolveOptions, callback: Callback | None, watch: Watch | None) -> Run:
    """Runs iterations until a stopping rule or the callback ends the solve.

    Args:
        setup: the solve.
        options: tolerances, limit and level of compilation.
        callback: called with every record; a true return value ends the solve.
        watch: called before the callback; its time counts nowhere.

    Raises:
        ProblemError: the cost of the initial state is not finite.
    """
    alone = callback is None and watch is None
    callback, watch = callback or _go_on, watch or _look_away
    with CompileClock() as clock:
        driver = _driver(setup, options, clock, alone)
        start = driver.begin()
        setup.check_cost(start)
        initial_cost, compiled, watched, began = float(start.cost), driver.compile_s(), 0.0, time.perf_counter()
        elapsed = lambda: time.perf_counter() - began - watched - (driver.compile_s() - compiled)
        steps, records = None, []
        end = Termination.RUNNING if options.max_iterations else Termination.MAX_ITERATIONS
        if alone and end == Termination.RUNNING and not isinstance(driver, Stepwise):
            steps, end = driver.finish()
        while end == Termination.RUNNING and not isinstance(driver, Compiled):
            step, end = driver.iterate()
            records.append(step)
            record = IterationRecord(len(records), elapsed(), step)
            looked = time.perf_counter()
            watch(record, functools.partial(setup.problem_at, driver.carry.state))
            watched += time.perf_counter() - looked
            if callback(record) and end == Termination.RUNNING:
                end = Termination.STOPPED
        total_s = elapsed()
    state = driver.carry.state if options.max_iterations else start
    steps = steps or StepInfo.stacked(records)
    return Run(state, steps, end, initial_cost, driver.quick_iterations, driver.compile_s(), total_s)


def _driver(setup: Setup, options: SolveOptions, clock: CompileClock, alone: bool) -> Compiled | OnDevices | Stepwise:
    """The way to run the iterations: in stages of compilation, or where somebody looks at them, from Python."""
    arguments = setup, options.tolerances, options.max_iterations, clock
    if setup.shards is not None:
        return OnDevices(setup.shards, *arguments)
    first = quick_runs_of(options.compilation, setup.placed.here.num_observations, setup.options)
    if options.max_iterations and (any(first.values()) or not alone):
        return Stepwise(first, *arguments)
    return Compiled(*arguments)


def _go_on(record: IterationRecord) -> bool:
    """A callback that never stops a solve."""
    return False


def _look_away(record: IterationRecord, now: Callable[[], BundleProblem]) -> None:
    """A watch that does nothing."""
