"""`solve_many`: a stream of problems of any shapes, solved as few programs.

Problems are padded to cells (structure/cells.py), chosen from the first ones that come. A bank
holds problems of one cell and is solved by one call of a program (lanes.py), in a thread: as many
threads as there are cores, or GPUs. What fits no cell, and what would not pay for compiling, is
solved by `solve`."""

from __future__ import annotations

import atexit
import itertools
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Generator, Iterable, Sequence, Sized
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxba.damping import DampingPolicy
from jaxba.lm.records import LMState
from jaxba.lm.termination import Termination
from jaxba.problem.bundle_problem import BundleProblem
from jaxba.problem.checks import shown
from jaxba.runtime import process
from jaxba.runtime.compilation import Level, ParallelCompilation, program
from jaxba.runtime.numerics import numerics
from jaxba.solver.drivers import record_length
from jaxba.solver.lanes import Ends, Starts, solve_rows
from jaxba.solver.names import resolve_policy
from jaxba.solver.options import SolveOptions, checked_options
from jaxba.solver.place import check_problem, placed
from jaxba.solver.prepare import DEFAULT_POLICY, Setup, set_up
from jaxba.solver.solve import Solution, solution_of, solve
from jaxba.solver.start import as_measured
from jaxba.solver.time_limit import TimeLimit
from jaxba.structure.cells import NO_CELL, Sizes, cell_for, choose_cells

BANK = 32  # problems of a bank for each lane; on a CPU it has one lane, and half a second of work
GPU_LANES = 256  # lanes of a bank on a GPU
SEEN = 512  # most problems from whose sizes cells are chosen at a time
SEEN_S = 0.5  # longest time, in seconds, that is waited for them

WORTH = 16
"""Problems of a cell that pay for compiling its program; those of a smaller cell go to a larger
one, if they fit."""

ENDLESS = 10_000  # problems that are expected of a stream of unknown length
COMPILING_S = 0.1  # seconds after which a thread that waits for a program looks for other work
AHEAD = 4 * SEEN  # most problems in memory

Result = Solution | Exception
"""What a problem ends with."""


def solve_many(
    problems: Iterable[BundleProblem | Exception],
    policy: str | DampingPolicy = DEFAULT_POLICY,
    options: SolveOptions | None = None,
) -> Generator[Result, None, None]:
    """Solves any number of problems of any shapes, and gives their results in order, each as soon
    as it is there.

    What a problem of the stream ends with is what `solve` alone gives, to rounding (padding changes
    the order of sums). One that cannot be solved gives the exception that `solve` would raise, and
    the others go on. The first result comes before any program for many is compiled; problems of
    sizes that are rare are solved by `solve`. An endless stream runs in constant memory: at most
    `AHEAD` problems are read before their turn.

    Lanes are for the method `lm` with a factorisation, on one device each; with other options, and
    with a limit of time, which is that of each problem from when its solve begins, every problem is
    solved by `solve`. Problems with lenses, rigs or residuals share a program where they have as
    many cameras, and as many rows of each residual.

    Args:
        problems: starts of the optimisation, read by the thread that asks for results; an exception
            among them, for one that could not be made, is its own result.
        policy: as for `solve`.
        options: as for `solve`; they hold for all.

    Raises:
        ValueError: bad options, or several processes, before the first result.
        Exception: what reading `problems` raises, after the results of those that were read."""
    if jax.distributed.is_initialized():
        raise ValueError(
            "solve_many is for one process: start others without connecting them, and divide the "
            "problems"
        )
    if not isinstance(problems, Iterable):
        raise ValueError(f"problems must be several, in a list or a stream, not {shown(problems)}")
    options = checked_options(options)
    if isinstance(policy, str):
        policy, options = resolve_policy(policy, options)
    options.step_options(policy)
    return _results(problems, policy, options)


def _results(
    problems: Iterable[BundleProblem | Exception], policy: DampingPolicy, options: SolveOptions
) -> Generator[Result, None, None]:
    failures = list[Exception]()
    stream = _read(problems, failures)
    for first in stream:
        yield (result := _alone(policy, options, first))
        if isinstance(result, Solution):
            break
    many = _Many(policy, options, len(problems) - 1 if isinstance(problems, Sized) else ENDLESS)
    try:
        waiting = deque[Future[Result]]()
        for problem in stream:
            waiting.append(many.add(problem))
            while waiting and (waiting[0].done() or len(waiting) >= AHEAD):
                yield many.result(waiting.popleft())
        many.flush()
        while waiting:
            yield waiting.popleft().result()
    finally:
        many.close()
    if failures:
        raise failures[0]


def _read(problems: Iterable[Any], failures: list[Exception]) -> Generator[Any, None, None]:
    """The problems up to the first that cannot be read, whose exception is then among the
    failures."""
    try:
        yield from problems
    except Exception as error:
        failures.append(error)


def _alone(policy: DampingPolicy, options: SolveOptions, problem: Any) -> Result:
    if isinstance(problem, Exception):
        return problem
    try:
        return solve(problem, policy, options)
    except Exception as error:
        return error


class _Job(NamedTuple):
    """A problem of the stream, and the result that it will have."""

    problem: BundleProblem
    result: Future[Result]


class _Many:
    """Cells, banks that are being filled, and the threads that solve them."""

    def __init__(self, policy: DampingPolicy, options: SolveOptions, expected: int) -> None:
        """`expected`: how many problems come."""
        self._policy = policy
        self._options = options
        self._expected = expected
        here = jax.local_devices()
        on_cpu = here[0].platform == "cpu"
        self._devices = here[:1] * process.threads() if on_cpu else here
        self._lanes = 1 if on_cpu else GPU_LANES
        self._bank = BANK * self._lanes
        self._unsorted: list[tuple[_Job, Sizes]] = []
        self._began = time.monotonic()
        self._seen = 0
        self._cells = list[Sizes]()
        self._filling: dict[Sizes, list[_Job]] = {}
        self._programs: dict[Any, _Program] = {}
        self._lock = threading.Lock()
        plain = (
            options.linear_solver in ("auto", "explicit")
            and not options.step_options(policy).method
        )
        one_device = options.devices in (None, 1)
        self._in_lanes = (
            plain and options.max_iterations > 0 and one_device and not TimeLimit(options).exists
        )
        # two solves on several devices at a time would wait for each other
        self._threads = len(self._devices) if one_device else 1
        self._pool = ThreadPoolExecutor(self._threads)
        self._pending = deque[tuple[Sequence[_Job], Callable[..., None], tuple[Any, ...]]]()
        self._busy = 0  # works that are pending or under way
        self._turn = itertools.count()
        self._closed = False
        # a generator that lives until then is closed when modules are gone
        atexit.register(self.close)

    def add(self, problem: Any) -> Future[Result]:
        """The result that a problem will have; perhaps that it is none."""
        job = _Job(problem, Future())
        try:
            if isinstance(problem, Exception):
                raise problem
            check_problem(problem)
            if self._options.max_iterations:
                problem = as_measured(problem)
            job = _Job(problem, job.result)
            sizes = _sizes(problem)
        except Exception as error:
            job.result.set_result(error)
            return job.result
        self._seen += 1
        cell = cell_for(sizes, self._cells)
        if sizes.too_large or not self._in_lanes:
            self._begin([job], self._solve_alone)
        elif cell != NO_CELL:
            self._fill(cell, job)
            # rather than wait for a full bank
            if self._filling and self._busy < len(self._devices):
                self._submit(max(self._filling, key=lambda cell: len(self._filling[cell])))
        else:
            self._began = self._began if self._unsorted else time.monotonic()
            self._unsorted.append((job, sizes))
            if len(self._unsorted) >= SEEN or time.monotonic() - self._began > SEEN_S:
                self._sort(endless=True)
        return job.result

    def result(self, of: Future[Result]) -> Result:
        """A result whose turn it is, though other problems are to come."""
        if not of.done():
            self.flush(endless=True)
        return of.result()

    def flush(self, *, endless: bool = False) -> None:
        """Begins what was added, though banks are not full; `endless`: more will come."""
        self._sort(endless=endless)
        for cell in list(self._filling):
            self._submit(cell)

    def close(self) -> None:
        """Begins nothing more. Does not wait: it may be the garbage collector in one of the threads
        that calls it."""
        if self._closed:
            return
        self._closed = True
        atexit.unregister(self.close)
        self._pending.clear()
        self._pool.shutdown(wait=False)

    def _sort(self, *, endless: bool) -> None:
        """Chooses cells for problems that fit none."""
        unsorted = self._unsorted
        self._unsorted = []
        if not unsorted:
            return
        every = [sizes for _, sizes in unsorted]
        times = max(1.0, endless * self._expected / self._seen)
        cells = choose_cells(every, times)
        members = Counter(cell_for(sizes, cells) for sizes in every)
        cells = [cell for cell in cells if members[cell] * times >= WORTH]
        for job, sizes in unsorted:
            cell = cell_for(sizes, cells)
            if cell == NO_CELL:
                self._begin([job], self._solve_alone)
            else:
                self._fill(cell, job)

    def _fill(self, cell: Sizes, job: _Job) -> None:
        if cell not in self._cells:
            self._cells.append(cell)
        self._filling.setdefault(cell, []).append(job)
        if len(self._filling[cell]) == self._bank:
            self._submit(cell)

    def _submit(self, cell: Sizes) -> None:
        if bank := self._filling.pop(cell, None):
            self._begin(
                bank, self._solve, cell, self._devices[next(self._turn) % len(self._devices)]
            )

    def _begin(self, jobs: Sequence[_Job], work: Callable[..., None], *arguments: Any) -> None:
        """Work for a thread (`_guarded`). The pool has no more of it than threads: it does all that
        it has, also when Python ends."""
        self._pending.append((jobs, work, arguments))
        with self._lock:
            self._busy += 1
            is_idle = self._busy <= self._threads
        if is_idle:
            self._pool.submit(self._work)

    def _work(self) -> None:
        """Does what is pending first, and lets the pool go on."""
        jobs, work, arguments = self._pending.popleft()
        _guarded(jobs, work, *arguments)
        with self._lock:
            self._busy -= 1
            more = self._busy >= self._threads
        if more:
            self._pool.submit(self._work)

    def _solve_alone(self, jobs: Sequence[_Job]) -> None:
        for job in jobs:
            job.result.set_result(_alone(self._policy, self._options, job.problem))

    def _solve(self, bank: Sequence[_Job], cell: Sizes, device: jax.Device) -> None:
        """Solves a bank."""
        groups: dict[Any, list[tuple[Setup, _Job]]] = {}
        with (
            numerics(np.float32 if self._options.dtype == "float32" else np.float64),
            jax.default_device(device),
        ):
            for job in bank:
                try:
                    setup = set_up(job.problem, self._policy, self._options, capacity=cell.capacity)
                except Exception as error:
                    job.result.set_result(error)
                    continue
                leaves, tree = jax.tree.flatten(setup.layout)
                shapes = [(x.shape, x.dtype) for x in leaves]
                groups.setdefault((setup.options, tree, *shapes), []).append((setup, job))
            for key, group in groups.items():
                if len(group) < len(bank) / 4 and key not in self._programs:  # of unusual shape
                    self._begin([job for _, job in group], self._solve_alone)
                else:
                    _guarded(
                        [job for _, job in group],
                        self._solve_group,
                        key,
                        device,
                        [one for one, _ in group],
                    )

    def _solve_group(
        self, jobs: Sequence[_Job], key: Any, device: jax.Device, setups: Sequence[Setup]
    ) -> None:
        """Solves problems of one shape. A program is compiled by the first thread that needs it;
        others do what else there is."""
        with self._lock:
            one = self._programs.setdefault(
                key, _Program("quick" if self._options.compilation == "quick" else "full")
            )
        if not one.ready.is_set() and not one.first.acquire(blocking=False):
            one.ready.wait(COMPILING_S)
            return self._begin(jobs, self._solve_group, key, device, setups)
        began = time.perf_counter()
        try:
            with numerics(setups[0].dtype), jax.default_device(device):
                ends = one.run(setups, self._bank, self._options, self._lanes)
        finally:
            one.ready.set()  # if it failed, others try it themselves
        seconds = (time.perf_counter() - began) / len(setups)
        for number, (setup, job) in enumerate(zip(setups, jobs, strict=True)):
            job.result.set_result(
                _solution(setup, jax.tree.map(lambda x, k=number: x[k], ends), seconds)
            )
        return None


class _Program:
    """The program of problems of one shape."""

    def __init__(self, level: Level) -> None:
        self._function = program(solve_rows, "options", "length", "lanes", level=level)
        self._programs = ParallelCompilation()
        self.first, self.ready = threading.Lock(), threading.Event()

    def run(self, setups: Sequence[Setup], size: int, options: SolveOptions, lanes: int) -> Ends:
        """The ends of a bank of so many problems, of which there may be fewer."""
        one = setups[0]
        dtype = setups[0].dtype
        rows = [Starts(each.layout, *(x.astype(dtype) for x in each.start)) for each in setups]
        rows += [rows[-1]] * (size - len(rows))
        starts = jax.tree.map(lambda *leaves: np.stack(leaves), *rows)
        limit, used = (np.asarray(n, np.int32) for n in (options.max_iterations, len(setups)))
        tolerances = options.tolerances._replace(seconds=None)
        given = (
            starts,
            one.policy,
            tolerances,
            limit,
            used,
            one.options,
            record_length(int(limit)),
            lanes,
        )
        return jax.tree.map(np.asarray, self._programs.run(self._function, *given))


def _guarded(jobs: Sequence[_Job], work: Callable[..., None], *arguments: Any) -> None:
    """`work(jobs, *arguments)`. If it fails, that is the result of its jobs."""
    try:
        work(jobs, *arguments)
    except Exception as error:
        for job in jobs:
            if not job.result.done():
                job.result.set_result(error)


def _sizes(problem: BundleProblem) -> Sizes:
    """Those of a problem as it is laid out."""
    return Sizes.of(placed(problem).here if problem.rigs or problem.residuals else problem)


def _solution(setup: Setup, end: Ends, seconds: float) -> Result:
    try:
        setup.check_cost(LMState(*end.state[:2], end.initial_cost))
        count = int(end.iterations)
        steps = jax.tree.map(lambda x: x[:count], end.history)
        return solution_of(
            setup,
            end.state,
            float(end.initial_cost),
            steps,
            Termination(int(end.termination)),
            seconds,
        )
    except Exception as error:
        return error
