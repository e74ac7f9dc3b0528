"""`solve`: bundle adjustment of a problem with a damping policy, until convergence."""

from __future__ import annotations

import functools
import math
import os
import time
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Int

from jaxba.damping import DampingPolicy
from jaxba.lm.records import LMState, StepInfo
from jaxba.lm.termination import Termination, distance_to_end
from jaxba.model.registration import costs_by_kind
from jaxba.problem.bundle_problem import BundleProblem
from jaxba.problem.frames import num_unknowns
from jaxba.problem.hold import hold
from jaxba.problem.losses import Loss
from jaxba.problem.part import observed_part
from jaxba.problem.residuals import PIXELS
from jaxba.runtime import process
from jaxba.runtime.compilation import CompileClock
from jaxba.runtime.numerics import numerics
from jaxba.solver.checkpoint import Checkpoint, Saved
from jaxba.solver.diagnosis import cost_of_rounding
from jaxba.solver.drivers import Callback, Compiled, IterationRecord, OnDevices, Watch
from jaxba.solver.options import SolveOptions, checked_options, refuse_keywords
from jaxba.solver.place import check_problem
from jaxba.solver.prepare import DEFAULT_POLICY, Setup, set_up
from jaxba.solver.progress import SILENT, Waiting, shown
from jaxba.solver.start import as_measured
from jaxba.solver.stepwise import Stepwise, iterations_before
from jaxba.solver.time_limit import TimeLimit
from jaxba.structure.padding import Capacity
from jaxba.typing import ArrayRecord

if TYPE_CHECKING:
    from jaxba.problem.display import Picture


@dataclass(frozen=True, eq=False, repr=False)
class Solution(ArrayRecord):
    """Result of `solve`."""

    problem: BundleProblem
    """The input with optimised cameras and points. What has no observations is unchanged, except
    for shared intrinsics."""

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

    history: StepInfo
    """Record of the iterations, arrays of length `iterations`."""

    linear_solver: str
    """Name of the linear solver, or of the method that replaced it."""

    setup_s: float
    """Seconds for the layout and the transfer to the device."""

    compile_s: float
    """Seconds for compilation; nearly zero if the compiled program was cached."""

    total_s: float
    """Seconds for the iterations, and for retriangulations between them
    (results/alternation.py)."""

    capacity: Capacity | None = None
    """Sizes to which the problem was padded; None if it was not."""

    quick_iterations: int = 0
    """Number of iterations, the first ones, that ran at least in part in programs that were not
    fully optimised."""

    set_aside: Int[np.ndarray, " away"] = field(default_factory=lambda: np.zeros(0, int))
    """Cameras that face away from their points (problem/facing.py). Their views count in no cost,
    and they stay."""

    lenses_free: bool = True
    """Whether `SolveOptions.intrinsics` were."""

    loss: Loss = field(default=Loss())
    """Robust loss of the pixels."""

    start: BundleProblem | None = None
    """Where the solve began, for `notes`; None without residuals besides pixels."""

    rejected: Bool[np.ndarray, " observations"] | None = None
    """Wrong matches that `solve_graduated` found, which count in no cost; None of other solves."""

    @functools.cached_property
    def notes(self) -> tuple[str, ...]:
        """What was measured and does not fit: a line for each kind of residuals, besides pixels
        without a stated accuracy, that fails a test of its standard deviations (solver/fit.py),
        with the names of its largest rows. Computed when it is first asked for."""
        from jaxba.solver.notes import Solved, notes_of

        if not self.iterations:
            return ()
        intrinsics = "free" if self.lenses_free else "fixed"
        options = SolveOptions(loss=self.loss, intrinsics=intrinsics)
        again = functools.partial(_continued, options)
        return notes_of(
            Solved(
                self.start or self.problem,
                self.problem,
                self._counted,
                self.loss,
                intrinsics,
                again,
            )
        )

    @property
    def num_residuals(self) -> int:
        """Number of residuals: two of each observation, and those of other residuals' rows."""
        own = sum(len(rows) * rows.size for rows in self.problem.residuals.rows)
        return 2 * int(np.sum(self._counted)) + own

    @property
    def _counted(self) -> Bool[np.ndarray, " observations"]:
        """Which observations count in the cost."""
        away = np.isin(self.problem.camera_index, self.set_aside)
        return ~(away if self.rejected is None else away | self.rejected)

    @property
    def num_parameters(self) -> int:
        """Number of parameters that were optimised, without what is constant or not observed."""
        return num_unknowns(self.problem if self.lenses_free else hold(self.problem, lenses="all"))

    @property
    def converged(self) -> bool:
        """Whether a convergence test ended the solve."""
        return self.termination.converged

    @property
    def distance(self) -> float:
        """How far above its end the final cost is estimated to be, relative to it
        (`Tolerances.within`); infinite if the last accepted step was shortened."""
        kept = np.flatnonzero(self.history.accepted)[-1:]
        with np.errstate(all="ignore"):
            found = distance_to_end(
                StepInfo._make(np.asarray(x)[kept] for x in self.history), np.where
            )
        return float(found[0]) if len(kept) else math.inf

    @property
    def costs(self) -> dict[str, float]:
        """The final cost by kind: of `pixels`, and of each other residual by the name of its
        function; pixels^2."""
        others = costs_by_kind(self.problem)
        pixels = self.final_cost - sum(others.values()) if self.problem.num_observations else 0.0
        return {PIXELS: pixels, **others}

    def update(self, reconstruction: Any) -> None:
        """Gives a `pycolmap.Reconstruction` what was found of its problem
        (`jaxba.from_pycolmap`)."""
        from jaxba.io.reconstruction import update

        update(reconstruction, self.problem)

    def plot(self) -> Picture:
        """A matplotlib figure of cost and lambda over the iterations; `savefig` writes it, a
        notebook shows it."""
        from jaxba.solver.figure import plot_history

        return plot_history(self.history, self.initial_cost)

    def _told(self) -> dict[str, str]:
        return {
            "converged" if self.converged else "not converged": self.termination.reason,
            "cost": f"{self.initial_cost:.6g} -> {self.final_cost:.6g}",
            "iterations": f"{self.iterations} in {self.total_s:.3g} s, compilation "
            f"{self.compile_s:.3g} s",
        }

    def __repr__(self) -> str:
        return f"Solution({', '.join(f'{name}: {value}' for name, value in self._told().items())})"

    def _repr_html_(self) -> str:
        from jaxba.problem.display import card

        size = {"size": f"{self.num_residuals} residuals, {self.num_parameters} parameters"}
        return card(
            {"problem": repr(self.problem).partition("(")[2][:-1], **size, **self._told()},
            self.plot(),
        )


def solve(
    problem: BundleProblem,
    policy: str | DampingPolicy = DEFAULT_POLICY,
    options: SolveOptions | None = None,
    *,
    callback: Callback | None = None,
    watch: Watch | None = None,
    verbose: bool = False,
    checkpoint: str | os.PathLike[str] | None = None,
    **unknown: object,
) -> Solution:
    """Minimises the reprojection cost over cameras and points.

    A scene far from the origin relative to its size, as georeferenced scenes are, is shifted to the
    origin, solved and shifted back (`preprocess.FAR`).

    Where other residuals than those of pixels fit badly, the scene is first moved, turned and
    scaled as a whole to what they say, as far as constants, rigs and measured positions leave it
    free (solver/start.py); the initial cost is that there.

    An image with more than half of its views behind it is left out with a ProblemWarning
    (`Solution.set_aside`), unless half of the images are like that.

    Many problems of different shapes can be solved in one process: before compiled programs exceed
    the number of memory mappings that Linux allows a process, all of them are dropped
    (`process.release_programs`) and compiled again when needed.

    Args:
        problem: start of the optimisation.
        policy: damping policy, which chooses lambda in every iteration, or its name
            (`jaxba.make_policy`). A name may end with `+embedded`, all embedded iterations of the
            default agent around a rule, or `+refineK`, K point iterations and no other refinement.
        options: options of the solve; None: the defaults.
        callback: called after every iteration; a true return value stops the solve.
        watch: called before it, with the record and a function that gives the problem with the
            parameters after the iteration; the time that it takes is not counted.
        verbose: whether a row is printed for every iteration, and a line while programs compile.
        checkpoint: file that is written once a minute and at the end, and from which the same solve
            continues; the time of an earlier run does not count for `Tolerances.seconds`.

    Returns:
        The optimised problem in NumPy float64 arrays, histories and timings.

    Raises:
        ValueError: unknown names, or options that exclude each other, or that contradict the name
            of the policy.
        ProblemError: the cost at the start is not finite, a factorisation needs more memory than
            the machine has, or the method does not support what the problem has (shared lenses,
            priors, rigs), or the checkpoint is that of another solve.
        RuntimeError: this process was forked from one in which JAX had started.
        TypeError: called inside `jax.jit`, `jax.vmap` or `jax.grad`, or with an option as an
            argument of its own."""
    refuse_keywords("solve", unknown)
    for name, function in (("callback", callback), ("watch", watch)):
        if function and not callable(function):
            raise ValueError(f"{name} must be a function")
    callback, waiting = shown(callback, verbose)
    hooks: dict[str, Any] = {"callback": callback, "waiting": waiting}
    options = checked_options(options)
    limit = TimeLimit(options)
    check_problem(problem)
    if options.max_iterations:
        problem = as_measured(problem)
    part = observed_part(problem)
    whole = functools.partial(part.whole, problem)
    watched = watch and (lambda record, now: watch(record, lambda: whole(now())))
    if checkpoint:
        hooks["checkpoint"] = Checkpoint(checkpoint, part.problem, policy, options)
    found = solve_without(None, part.problem, policy, limit.rest(options), watch=watched, **hooks)
    limit.warn_if_too_short(found.termination, found.iterations)
    start = problem if problem.residuals else None
    return replace(
        found, problem=whole(found.problem), set_aside=part.cameras[found.set_aside], start=start
    )


def solve_without(
    away: Int[np.ndarray, " away"] | None,
    problem: BundleProblem,
    policy: str | DampingPolicy,
    options: SolveOptions | None,
    *,
    callback: Callback | None,
    watch: Watch | None,
    waiting: Waiting = SILENT,
    checkpoint: Checkpoint | None = None,
) -> Solution:
    """`solve` where it is known which images face away; None: it is not. `waiting` is told what
    takes time."""
    options = checked_options(options)
    limit = TimeLimit(options)
    saved = checkpoint and checkpoint.load()
    problem, away = (saved.problem, saved.away) if saved else (problem, away)
    setup = set_up(problem, policy, options, away, in_parts=True, tell=waiting.tell)
    steps = None
    records = saved.steps if saved else []
    end = (
        Termination.RUNNING if len(records) < options.max_iterations else Termination.MAX_ITERATIONS
    )
    if end == Termination.RUNNING and limit.is_over():
        end = Termination.TIME_LIMIT
        # the cost of the start needs no program of a step
        options = replace(options, max_iterations=0)
    alone = not (callback or watch or checkpoint or limit.exists)
    with numerics(setup.dtype), CompileClock() as clock:
        driver = _driver(setup, options, clock, alone)
        driver.compiling = waiting.compiling
        with waiting.compiling():
            state = driver.begin()
        setup.check_cost(state)
        initial_cost = float(state.cost)
        compiled = driver.compile_s()
        watched = 0.0
        began = time.perf_counter()
        initial_cost, before_s = (
            (saved.initial_cost, saved.total_s) if saved else (initial_cost, 0.0)
        )

        def elapsed():
            return (
                before_s + time.perf_counter() - began - watched - (driver.compile_s() - compiled)
            )

        if saved and end == Termination.RUNNING:
            driver.carry = saved.continued(driver.carry)
            waiting.resume(len(records), before_s)
        if end == Termination.RUNNING and limit.is_over():
            end = Termination.TIME_LIMIT
        if (
            alone
            and end == Termination.RUNNING
            and not isinstance(driver, Stepwise)
            and driver.whole
        ):
            steps, end = driver.finish()
        while end == Termination.RUNNING and not isinstance(driver, Compiled):
            with waiting.iterating(len(records) + 1):
                step, end = driver.iterate()
            records.append(step)
            record = IterationRecord(len(records), elapsed(), step)
            looked = time.perf_counter()
            if watch:
                watch(record, functools.partial(setup.problem_at, driver.carry.state))
            watched += time.perf_counter() - looked
            if callback and callback(record) and end == Termination.RUNNING:
                end = Termination.STOPPED
            if end == Termination.RUNNING and limit.is_over():
                end = Termination.TIME_LIMIT
            looked = time.perf_counter()
            if checkpoint and (checkpoint.due or end != Termination.RUNNING):
                now = (
                    setup.problem_at(driver.carry.state),
                    setup.away,
                    initial_cost,
                    record.time_s,
                    records,
                )
                checkpoint.save(Saved(*now, carry=driver.carry))
            watched += time.perf_counter() - looked
        total_s = elapsed()
        compile_s = driver.compile_s()
        driver.end()
        if compile_s > 0:
            process.release_programs()  # see above: too many programs end a process
        steps = steps or StepInfo.stacked(records)
        state = driver.carry.state if options.max_iterations else state
        found = solution_of(setup, state, initial_cost, steps, end, total_s)
        return replace(found, compile_s=compile_s, quick_iterations=driver.quick_iterations)


AGAIN = "ceres"
"""Policy of further solves: a rule, which compiles in half of the time."""


def _continued(options: SolveOptions, problem: BundleProblem, iterations: int) -> BundleProblem:
    """A problem after some more iterations, from Python, so that all limits use the same
    programs."""
    options = replace(options, max_iterations=iterations)

    def go_on(record):
        return False

    away = np.zeros(0, int)  # views of images that face away are left out already
    return solve_without(away, problem, AGAIN, options, callback=go_on, watch=None).problem


def solution_of(
    setup: Setup,
    state: LMState,
    initial_cost: float,
    steps: StepInfo,
    end: Termination,
    total_s: float,
) -> Solution:
    """The solution of a solve that ended in a state, without the time of compilation;
    `initial_cost` in pixels^2, `total_s` in seconds."""
    count = len(steps.cost)
    final_cost = float(state.cost)
    counted = setup.placed.counted
    gave_up = end in (Termination.DAMPING_LIMIT, Termination.STALLED)
    if gave_up and final_cost <= cost_of_rounding(counted, setup.dtype):
        end = Termination.ROUNDING
    return Solution(
        problem=setup.problem_at(state) if count else _unchanged(setup.problem),
        initial_cost=initial_cost,
        final_cost=final_cost,
        iterations=count,
        accepted=int(np.sum(steps.accepted)),
        termination=end,
        history=steps,
        linear_solver=setup.options.solver_name,
        setup_s=setup.setup_s,
        compile_s=0.0,
        total_s=total_s,
        capacity=setup.capacity,
        set_aside=setup.away,
        lenses_free=setup.options.intrinsics == "free",
        loss=setup.options.loss,
        start=setup.problem if setup.problem.residuals else None,
    )


def _driver(
    setup: Setup, options: SolveOptions, clock: CompileClock, alone: bool
) -> Compiled | OnDevices | Stepwise:
    """The way to run the iterations: in stages of compilation, or where somebody looks at them,
    from Python."""
    # with which programs are the same as without a limit
    tolerances = options.tolerances._replace(seconds=None)
    arguments = setup, tolerances, options.max_iterations, clock
    if setup.shards is not None:
        return OnDevices(setup.shards, *arguments)
    first = iterations_before(
        options.compilation, len(setup.placed.here.camera_index), setup.options
    )
    if options.max_iterations and (first or not alone):
        return Stepwise(first, *arguments)
    return Compiled(*arguments)


def _unchanged(problem: BundleProblem) -> BundleProblem:
    """The problem itself, its parameters as NumPy float64."""
    cameras, points = (np.asarray(one, np.float64) for one in (problem.cameras, problem.points))
    return problem.replace(cameras=cameras, points=points)
