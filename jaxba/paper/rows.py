"""Rows of the tables: iterations, success and time of a method over problems and training runs. Pure functions.

Means are arithmetic, as the paper's "average", and a failure counts as 100 iterations. The mean over the problems is
taken for each training run; `low` and `high` are the extremes of these means.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from jaxba.bench import profile
from jaxba.bench.profile import ITERATION_LIMIT
from jaxba.paper.store import Play
from jaxba.solver.record import Record

NEAR = 1e-3
"""Relative tolerance of `Row.near`: iterations until the cost is within this of the best known cost."""

GOOD_END = 1e-2
"""Relative tolerance of `Row.good_ends`: the final cost is within this of the best known cost. A solver that converges
to a worse cost needs few iterations without being better."""


@dataclass(frozen=True)
class Outcome:
    """One solve."""

    iterations: float
    """Iterations to convergence; `ITERATION_LIMIT` for a failure."""

    converged: bool
    """Whether it converged within the limit."""

    near: float
    """Iterations until the cost is within `NEAR` of the best known cost, between 1 and the limit."""

    end: float
    """Final cost relative to the best known cost, minus 1."""

    seconds: float = math.nan
    """Set-up and iterations, without compilation."""


@dataclass(frozen=True)
class Row:
    """A method in a table."""

    method: str
    """Name in records."""

    iterations: float
    """Mean iterations to convergence, with the limit for a failure. NaN if nothing was run."""

    low: float
    """Lowest mean of a training run."""

    high: float
    """Highest mean of a training run."""

    near: float
    """Mean iterations until the cost is within `NEAR` of the best known cost, with the limit for never."""

    success: float
    """Fraction of the solves that converged within the limit."""

    good_ends: float
    """Fraction of the solves that ended within `GOOD_END` of the best known cost."""

    seeds: int
    """Number of training runs; 0 for a rule."""

    solves: int
    """Number of problems or scenes of each training run."""

    seconds: float = math.nan
    """Mean time of set-up and iterations, without compilation. NaN if it was not measured."""


def row(method: str, outcomes: Mapping[int, Sequence[Outcome]], trained: bool) -> Row:
    """The row of a method.

    Args:
        method: name.
        outcomes: by training run, the outcomes on the same problems; a rule has one entry.
        trained: whether the method has training runs.
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
    """The outcomes on a set of scenes."""
    cells = zip(play.iterations, play.converged, play.near, play.end, strict=True)
    return [_outcome(iterations, converged, near, end) for iterations, converged, near, end in cells]


def of_records(records: Sequence[Record], best: Mapping[str, float]) -> list[Outcome]:
    """The outcomes on problems, with the median time of repeats.

    Args:
        records: of one method.
        best: best known cost of each problem.
    """
    found = []
    for name, runs in profile.by_problem(records).items():
        first = runs[0]
        near = profile.first(first, profile.relative_threshold(first.initial_cost, best[name], NEAR)).iterations
        end = first.final_cost / best[name] - 1 if best[name] > 0 else 0.0
        seconds = statistics.median(r.setup_s + (r.trace[-1].time_s if r.trace else r.total_s) for r in runs)
        found.append(_outcome(first.iterations, profile.converged(first), near, end, seconds))
    return found


def _outcome(iterations: int, converged: bool, near: float, end: float, seconds: float = math.nan) -> Outcome:
    limit, good = float(ITERATION_LIMIT), converged and iterations <= ITERATION_LIMIT
    return Outcome(float(iterations) if good else limit, good, min(max(near, 1.0), limit), end, seconds)


def ratio(one: float, other: float) -> float:
    """`one / other`; NaN if `one` is not finite or `other` is not positive."""
    return one / other if other > 0 and math.isfinite(one) else math.nan
