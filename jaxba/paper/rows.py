"""Rows of the tables: iterations, success and time of a method over problems and seeds. Pure functions over records.

Means are arithmetic, as the paper's "average", and a failure counts as the limit of 100 iterations in them. The mean
over problems is taken for each seed first; spread is the lowest and highest of those means.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from jaxba.bench import profile
from jaxba.bench.profile import ITERATION_LIMIT
from jaxba.bench.records import Record
from jaxba.paper.store import Play

NEAR = 1e-3
"""Distance from the best known cost, relative to it, of the second count in every row."""

GOOD_END = 1e-2
"""Distance from the best known cost within which an end counts as good: who stops early in a worse place is fast for
the wrong reason."""


@dataclass(frozen=True)
class Outcome:
    """One solve."""

    iterations: float
    """Until it converged; `ITERATION_LIMIT` for a failure."""

    converged: bool
    """Within that limit."""

    near: float
    """Iterations to `NEAR`, at least 1, at most the limit."""

    end: float
    """Last cost over the best known, less one."""

    seconds: float = math.nan
    """Set-up and iterations, without compilation."""


@dataclass(frozen=True)
class Row:
    """A method in a table."""

    method: str
    """Name in records."""

    iterations: float
    """Mean, failures counting as the limit. NaN where nothing was run."""

    low: float
    """Of the seeds' means, the lowest."""

    high: float
    """The highest."""

    near: float
    """Mean iterations to `NEAR`, where never counts as the limit."""

    success: float
    """Share of the solves that converged within the limit."""

    good_ends: float
    """Share that ended within `GOOD_END` of the best known cost."""

    seeds: int
    """Training runs; 0 for a rule, which has none."""

    solves: int
    """Problems or scenes of each."""

    seconds: float = math.nan
    """Mean of set-up and iterations, without compilation. NaN where no time was taken."""

    @property
    def halfwidth(self) -> float:
        """Half of the spread over the seeds."""
        return 0.5 * (self.high - self.low)


def row(method: str, outcomes: Mapping[int, Sequence[Outcome]], trained: bool) -> Row:
    """The row of a method.

    Args:
        method: name.
        outcomes: solves by seed; the same problems for each.
        trained: whether the seeds are training runs; a rule has one entry and no seed.
    """
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
    """The solves of a set of scenes."""
    cells = zip(play.iterations, play.converged, play.near, play.end, strict=True)
    return [_outcome(iterations, converged, near, end) for iterations, converged, near, end in cells]


def of_records(records: Sequence[Record], best: Mapping[str, float]) -> list[Outcome]:
    """Solves of problems, repeats of one by their median time.

    Args:
        records: of one method.
        best: lowest known cost by problem.
    """
    found = []
    for name in profile.problem_names(records):
        runs = [r for r in records if r.problem == name]
        first = runs[0]
        near = profile.first_iteration(first, profile.relative_threshold(first.initial_cost, best[name], NEAR))
        end = first.final_cost / best[name] - 1 if best[name] > 0 else 0.0
        seconds = statistics.median(r.setup_s + (r.trace[-1].time_s if r.trace else r.total_s) for r in runs)
        found.append(_outcome(first.iterations, profile.converged(first), near, end, seconds))
    return found


def _outcome(iterations: int, converged: bool, near: float, end: float, seconds: float = math.nan) -> Outcome:
    good = converged and iterations <= ITERATION_LIMIT
    return Outcome(
        iterations=float(iterations) if good else float(ITERATION_LIMIT),
        converged=good,
        near=min(max(near, 1.0), float(ITERATION_LIMIT)),
        end=end,
        seconds=seconds,
    )


def ratio(one: float, other: float) -> float:
    """One over the other; NaN where that says nothing."""
    return one / other if other > 0 and math.isfinite(one) else math.nan
