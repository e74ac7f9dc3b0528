"""Time and iterations to a tolerance, and performance profiles. Pure functions of records.

Costs are accepted costs in pixels squared. Times are seconds without compilation. Iterations are
linear solves, accepted or rejected. A target that is never reached has infinite time and
iterations. Repeats are combined by their median, so that a solver that fails in at least half of
its repeats counts as failed.

Source: performance profiles of rootba (Demmel et al. 2021, after Dolan and Moré 2002), with one
change: problems that no solver finishes stay in the denominator."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from jaxba.game.statistics import Reached
from jaxba.solver.record import Record

# a solve that has not converged within this many iterations is a failure. Source: the paper
ITERATION_LIMIT = 100
# values of tau in the target `f <= f* + tau (f0 - f*)`. Source: the paper's figures
PAPER_TOLERANCES = (0.1, 0.001)
RELATIVE_TOLERANCES = (1e-2, 1e-3, 1e-4)  # values of epsilon in the target `f <= f*(1 + epsilon)`
# costs to f* plus this times f0 are within every tolerance, as f* may be rounding (1e-26)
ZERO_RESIDUAL_FLOOR = 1e-12
# relative difference of costs above which two solvers started elsewhere. Source: rootba
INITIAL_COST_TOLERANCE = 1e-2

COST_DEFINITION_TOLERANCE = 1e-5
"""Relative difference of initial costs above which rounding cannot be the reason. float32 makes
about 1e-6; ignoring the 31 observations of Ladybug-49 whose points are behind their cameras, as
COLMAP does, makes 1.3e-4."""

CONVERGED = frozenset(
    {
        "cost",
        "step",
        "gradient",
        "rounding",
        "within",
        "converged",
        "convergence",
        "ftol",
        "xtol",
        "gtol",
    }
)
"""Values of `Record.termination`, in lower case, that mean converged; the first five are those of
`Termination`."""


@dataclass(frozen=True)
class Target:
    """A cost threshold, or convergence, at which the time and iterations of a solve are
    measured."""

    kind: Literal["tau", "relative", "converged"]
    """`tau`: cost at most f* + tau (f0 - f*). `relative`: cost at most f*(1 + epsilon).
    `converged`: the end of a solve that converged within `ITERATION_LIMIT` iterations."""

    value: float = 0.0
    """tau or epsilon; unused for `converged`."""

    @property
    def key(self) -> str:
        """Name in tables of numbers, e.g. `tau_0.001`."""
        return self.kind if self.kind == "converged" else f"{self.kind}_{self.value:g}"

    @property
    def label(self) -> str:
        """Name for tables and figures."""
        if self.kind == "converged":
            return "converged"
        return f"τ = {self.value:g}" if self.kind == "tau" else f"f*(1+{self.value:g})"


def taus(tolerance: float) -> list[float]:
    """The paper's values of tau and the given one, the largest first."""
    return sorted({*PAPER_TOLERANCES, tolerance}, reverse=True)


def cost_targets(tolerance: float) -> tuple[Target, ...]:
    """Costs relative to the best one: the paper's values of tau and the given one, and the relative
    tolerances."""
    relative = (Target("relative", epsilon) for epsilon in RELATIVE_TOLERANCES)
    return (*(Target("tau", tau) for tau in taus(tolerance)), *relative)


NEVER = Reached(math.inf, math.inf)  # the value for a target that is never reached


def by_problem(records: Iterable[Record]) -> dict[str, list[Record]]:
    """The records of each problem, in the order of their first one."""
    found: dict[str, list[Record]] = {}
    for record in records:
        found.setdefault(record.problem, []).append(record)
    return found


def problem_names(records: Iterable[Record]) -> list[str]:
    """Problems in the order of their first record."""
    return list(by_problem(records))


def solver_names(records: Iterable[Record]) -> list[str]:
    """Solvers in the order of their first record."""
    return list(dict.fromkeys(record.solver for record in records))


def initial_costs(records: Iterable[Record]) -> dict[str, float]:
    """f0 of each problem: the largest finite initial cost of its records, NaN if there is none."""
    starts = {
        name: filter(math.isfinite, (r.initial_cost for r in runs))
        for name, runs in by_problem(records).items()
    }
    return {name: max(costs, default=math.nan) for name, costs in starts.items()}


def best_cost(records: Iterable[Record]) -> dict[str, float]:
    """f* of each problem: the lowest accepted cost of any solver, converged or not, NaN if none is
    finite. Of float32 solvers only the initial and final costs count, which were computed in
    float64."""
    found = {}
    for name, runs in by_problem(records).items():
        costs = [cost for r in runs for cost in (r.initial_cost, lowest_cost(r))]
        found[name] = min(filter(math.isfinite, costs), default=math.nan)
    return found


def lowest_cost(record: Record) -> float:
    """The lowest finite accepted cost of a run, or NaN. A float32 run's trace is ignored for its
    rounding errors."""
    trace = [] if record.dtype == "float32" else [point.cost for point in record.trace]
    return min(filter(math.isfinite, (record.final_cost, *trace)), default=math.nan)


def threshold(f0: float, f_star: float, tolerance: float) -> float:
    """`f* + tau (f0 - f*)`, the largest cost that counts as solved for tolerance tau."""
    return f_star + tolerance * (f0 - f_star)


def relative_threshold(f0: float, f_star: float, epsilon: float) -> float:
    """`f*(1 + epsilon)`, but never below `f* + ZERO_RESIDUAL_FLOOR f0`."""
    return f_star + max(epsilon * f_star, ZERO_RESIDUAL_FLOOR * f0)


def converged(record: Record) -> bool:
    """Whether the solve converged within the paper's limit of iterations."""
    return record.termination.strip().lower() in CONVERGED and record.iterations <= ITERATION_LIMIT


def first(record: Record, cost: float) -> Reached:
    """Iterations and seconds until the accepted cost is at most `cost`."""
    return next((_reach(p.iteration, p.time_s) for p in record.trace if p.cost <= cost), NEVER)


def _reach(iterations: int, seconds: float) -> Reached:
    return Reached(float(iterations), seconds if math.isfinite(seconds) else math.inf)


def reach(record: Record, target: Target, f0: float, f_star: float) -> Reached:
    """Iterations and time of one solve to a target, given the problem's initial cost f0 and best
    cost f*."""
    if target.kind == "converged":
        end = record.trace[-1].time_s if record.trace else record.total_s
        return _reach(record.iterations, end) if converged(record) else NEVER
    level = relative_threshold if target.kind == "relative" else threshold
    return first(record, level(f0, f_star, target.value))


def reach_table(records: Sequence[Record], target: Target) -> dict[str, dict[str, Reached]]:
    """Iterations and time to a target, `table[solver][problem]`, medians over repeats, without
    pairs not run."""
    starts = initial_costs(records)
    bests = best_cost(records)
    found: dict[str, dict[str, list[Reached]]] = {}
    for r in records:
        item = reach(r, target, starts[r.problem], bests[r.problem])
        found.setdefault(r.solver, {}).setdefault(r.problem, []).append(item)

    def median(items):
        return Reached(*(float(statistics.median(values)) for values in zip(*items, strict=True)))

    return {
        solver: {name: median(items) for name, items in row.items()}
        for solver, row in found.items()
    }


def reached(row: Mapping[str, Reached], names: Sequence[str]) -> Reached:
    """A row of `reach_table` as arrays over problems; a problem that was not run counts as not
    reached."""
    found = [row.get(name, NEVER) for name in names]
    return Reached(np.array([r.iterations for r in found]), np.array([r.seconds for r in found]))


Curve: TypeAlias = tuple[tuple[float, ...], tuple[float, ...]]
"""Performance profile of a solver: the fraction of all problems solved within alpha times the
fastest solver's time, a step function of alpha. Positions of the steps, ascending from 1, and the
value from each position on, in [0, 1]."""


def performance_profile(times: Mapping[str, Mapping[str, float]]) -> dict[str, Curve]:
    """Performance profile of each solver. `times[solver][problem]` is a time or another positive
    cost; infinite, NaN or absent means not solved. The denominator is the number of problems that
    have an entry for any solver, solved or not. If the best time of a problem is 0 (solved at the
    start), only times of 0 count as within any factor."""
    names = list(dict.fromkeys(name for row in times.values() for name in row))
    best = {
        name: min(
            (row[name] for row in times.values() if row.get(name, math.nan) >= 0), default=math.inf
        )
        for name in names
    }
    curves = {}
    for solver, row in times.items():
        ratios = sorted(_ratio(row.get(name, math.inf), best[name]) for name in names)
        solved = [ratio for ratio in ratios if math.isfinite(ratio)]
        steps = {1.0: 0.0} | {ratio: (i + 1) / len(names) for i, ratio in enumerate(solved)}
        curves[solver] = tuple(steps), tuple(steps.values())
    return curves


def _ratio(time: float, best: float) -> float:
    if not math.isfinite(time):
        return math.inf
    if time == best:
        return 1.0
    return time / best if best > 0 else math.inf


def cost_warnings(records: Sequence[Record]) -> list[str]:
    """A warning for each problem on which initial costs of solvers differ: they minimised different
    functions."""
    lines = []
    for name, runs in by_problem(records).items():
        costs = {r.solver: r.initial_cost for r in runs if math.isfinite(r.initial_cost)}
        if not costs:
            lines.append(f"{name}: no solver has a finite initial cost")
            continue
        low = min(costs, key=costs.__getitem__)
        high = max(costs, key=costs.__getitem__)
        gap = (costs[high] - costs[low]) / max(abs(costs[high]), abs(costs[low]), 1e-300)
        if gap > COST_DEFINITION_TOLERANCE:
            reason = (
                "they did not start alike"
                if gap > INITIAL_COST_TOLERANCE
                else "more than rounding explains"
            )
            lines.append(
                f"{name}: initial costs differ by {100 * gap:.2g} % ({low} {costs[low]:.7g}, "
                f"{high} {costs[high]:.7g}),"
                f" {reason}; comparisons on it mislead"
            )
    return lines
