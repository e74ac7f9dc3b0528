"""Results of a reproduction run: files of one JSON object per line, and the row of a table that
they make.

`solves.jsonl` has solves of single problems in the format of `jaxba-bench`. `plays.jsonl` has runs
of a policy on a whole set of small scenes, a line for each policy and seed. A killed run loses at
most the line that it was writing.

Means are arithmetic, as the paper's "average", and a failure counts as 100 iterations. The mean
over the problems is taken for each training run; `low` and `high` are the extremes of these
means."""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, TypeVar

from jaxba.bench import profile
from jaxba.bench.profile import ITERATION_LIMIT
from jaxba.io import json_lines
from jaxba.solver.record import Record

T = TypeVar("T")

SOLVES = "solves.jsonl"
PLAYS = "plays.jsonl"

# relative tolerance of `Row.near`: iterations until the cost is within this of the best known cost
NEAR = 1e-3
# relative tolerance of `Row.good_ends`: a solver that ends higher needs few iterations
GOOD_END = 1e-2


@dataclass(frozen=True)
class Play:
    """Solves of all scenes of a set with one policy. Tuples have an entry for each scene."""

    scenes: str  # name of the set of scenes
    method: str  # name of the policy
    seed: int  # number of the training run, from 0; 0 for rules
    iterations: tuple[int, ...]  # linear solves
    converged: tuple[bool, ...]  # whether the solve converged before the limit of iterations
    # linear solves until the cost is within `NEAR` of the best known; infinite (null) if never
    near: tuple[float, ...]
    end: tuple[float, ...]  # final cost relative to the best known cost, minus 1
    first: tuple[tuple[float, ...], ...]  # first lambdas of each solve
    seconds: float  # for all scenes, with compilation, and so no measure of speed

    def __post_init__(self) -> None:
        for name in ("near", "end"):  # null in the file is read as NaN
            never = tuple(math.inf if math.isnan(x) else x for x in getattr(self, name))
            object.__setattr__(self, name, never)


class Store:
    """The results in the folder of a run. Only one process may write at a time."""

    def __init__(self, folder: Path) -> None:
        """Reads the existing results. Raises ProblemError: a file is damaged; names the file and
        line."""
        self.folder = folder
        self.solves = _read(folder / SOLVES, Record)
        self.plays = _read(folder / PLAYS, Play)

    def solve(self, problem: str, solver: str, repeat: int) -> Record | None:
        """The record of a solve, None if there is none."""
        wanted = (problem, solver, repeat)
        return next((r for r in self.solves if (r.problem, r.solver, r.repeat) == wanted), None)

    def play(self, scenes: str, method: str, seed: int) -> Play | None:
        """The play of a policy on a set of scenes, None if there is none."""
        wanted = (scenes, method, seed)
        return next((p for p in self.plays if (p.scenes, p.method, p.seed) == wanted), None)

    def add_solve(self, record: Record) -> None:
        """Appends a line to the file, followed by fsync. Raises OSError."""
        json_lines.append(self.folder / SOLVES, record)
        self.solves.append(record)

    def add_play(self, play: Play) -> None:
        """Appends a line to the file, followed by fsync. Raises OSError."""
        json_lines.append(self.folder / PLAYS, play)
        self.plays.append(play)

    def solves_of(self, problems: Sequence[str], solvers: Sequence[str]) -> list[Record]:
        """The solves of the given problems by the given solvers, in the order of these lists."""

        def rank(r):
            return (problems.index(r.problem), solvers.index(r.solver), r.repeat)

        return sorted(
            (r for r in self.solves if r.problem in problems and r.solver in solvers), key=rank
        )


def _read(path: Path, kind: type[T]) -> list[T]:
    return json_lines.read(path, kind) if path.is_file() else []


class Outcome(NamedTuple):
    """One solve: iterations to convergence (the limit for a failure), whether it converged within
    the limit, iterations until the cost is within `NEAR` of the best known one (between 1 and the
    limit), final cost relative to that one minus 1, and seconds of set-up and iterations."""

    iterations: float
    converged: bool
    near: float
    end: float
    seconds: float = math.nan


class Row(NamedTuple):
    """A method in a table: means over problems and training runs. Numbers are NaN if nothing was
    run."""

    method: str  # name in records
    iterations: float  # to convergence, with the limit for a failure
    low: float  # lowest mean of a training run
    high: float
    # iterations until the cost is within `NEAR` of the best known cost, with the limit for never
    near: float
    success: float  # fraction of the solves that converged within the limit
    good_ends: float  # fraction of the solves that ended within `GOOD_END` of the best known cost
    seeds: int  # training runs; 0 for a rule
    solves: int  # problems or scenes of each training run
    # set-up and iterations, without compilation; NaN if that was not measured
    seconds: float = math.nan
    # most training runs ended with a policy that does the same in every state
    collapsed: bool = False


def row_of(method: str, outcomes: Mapping[int, Sequence[Outcome]], trained: bool) -> Row:
    """A method's row, from outcomes on the same problems by training run; a rule has one, and is
    not `trained`."""
    every = [outcome for solves in outcomes.values() for outcome in solves]
    if not every:
        return Row(method, *[math.nan] * 6, seeds=0, solves=0)
    means = [statistics.fmean(o.iterations for o in solves) for solves in outcomes.values()]
    return Row(
        method=method,
        iterations=statistics.fmean(means),
        low=min(means),
        high=max(means),
        near=statistics.fmean(o.near for o in every),
        success=statistics.fmean(o.converged for o in every),
        good_ends=statistics.fmean(o.end <= GOOD_END for o in every),
        seeds=len(outcomes) if trained else 0,
        solves=max(map(len, outcomes.values())),
        seconds=statistics.fmean(o.seconds for o in every),
    )


def of_play(play: Play) -> list[Outcome]:
    """The outcomes on a set of scenes."""
    return [
        _outcome(*one)
        for one in zip(play.iterations, play.converged, play.near, play.end, strict=True)
    ]


def of_records(records: Sequence[Record], best: Mapping[str, float]) -> list[Outcome]:
    """A method's outcomes on problems, with the median time of repeats. `best` has each problem's
    best known cost."""
    found = []
    for name, runs in profile.by_problem(records).items():
        first = runs[0]
        near = profile.first(
            first, profile.relative_threshold(first.initial_cost, best[name], NEAR)
        ).iterations
        end = first.final_cost / best[name] - 1 if best[name] > 0 else 0.0
        seconds = statistics.median(
            r.setup_s + (r.trace[-1].time_s if r.trace else r.total_s) for r in runs
        )
        found.append(_outcome(first.iterations, profile.converged(first), near, end, seconds))
    return found


def _outcome(
    iterations: int, converged: bool, near: float, end: float, seconds: float = math.nan
) -> Outcome:
    limit = float(ITERATION_LIMIT)
    good = converged and iterations <= ITERATION_LIMIT
    return Outcome(
        float(iterations) if good else limit, good, min(max(near, 1.0), limit), end, seconds
    )


# values of a constant schedule. Source: the paper's schedule [1e-15, 1e-15, 0.194, 0.551]
SCHEDULE = 4


def average_schedule(
    series: Sequence[Sequence[float]], length: int = SCHEDULE
) -> tuple[float, ...]:
    """The constant schedule of the paper: arithmetic means of the first lambdas of several solves,
    in order, at least one in all. A solve that ended earlier does not enter the later means; if all
    did, there are fewer than `length`."""
    columns = [[row[k] for row in series if len(row) > k] for k in range(length)]
    return tuple(sum(column) / len(column) for column in columns if column)
