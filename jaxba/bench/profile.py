"""What "solved to a tolerance" means, and performance profiles. Pure functions over records.

Costs are accepted costs in pixels squared, times are seconds without compilation, iterations are linear
solves, accepted or rejected. "Never" is infinity everywhere. Repeats of one solver on one problem enter by
their median, so a solver that fails in half of its repeats or more counts as failed there.

Source: rootba's performance profiles (Demmel et al. 2021, after Dolan and More 2002), with one change:
problems that no solver finishes stay in the denominator.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from jaxba.bench.records import Record

ITERATION_LIMIT = 100
"""A solve that has not converged within this many iterations is a failure. Source: the paper."""

RELATIVE_TOLERANCES = (1e-2, 1e-3, 1e-4)
"""The epsilons of `f <= f*(1 + epsilon)`. Source: design contract."""

OWN_END_TOLERANCE = 1e-3
"""Distance from a solver's own final cost at which it counts as arrived. Source: design contract."""

ZERO_RESIDUAL_FLOOR = 1e-12
"""Share of f0 above f* that always counts as reached by the relative tolerances. Without it a problem whose best
cost is rounding noise (f* ~ 1e-26) would ask every solver for the same noise."""

INITIAL_COST_TOLERANCE = 1e-2
"""Relative difference of initial costs above which two solvers did not start alike. Source: rootba."""

COST_DEFINITION_TOLERANCE = 1e-5
"""Relative difference of initial costs that rounding does not explain: COLMAP's zeroing of the 31 points behind
cameras of Ladybug-49 makes 1.3e-4, float32 about 1e-6."""

CONVERGED = frozenset({"cost", "step", "gradient", "rounding", "converged", "convergence", "ftol", "xtol", "gtol"})
"""Words in `Record.termination` that mean converged, in lower case; every other word is a failure. The first four
are the names of `jaxba.solve.Termination`; peers write "converged" or Ceres' "CONVERGENCE"."""


@dataclass(frozen=True)
class Target:
    """A point of a solve that is timed."""

    kind: Literal["tau", "relative", "own_end", "converged"]
    """`tau`: f* + tau (f0 - f*). `relative`: f*(1 + e). `own_end`: the solver's own final cost (1 + e), for solves
    that converged. `converged`: the end of a solve that converged within `ITERATION_LIMIT` iterations."""

    value: float = 0.0
    """tau or epsilon; unused for `converged`."""

    @property
    def key(self) -> str:
        """Name in `summary.json`, e.g. `tau_0.001`."""
        return self.kind if self.kind == "converged" else f"{self.kind}_{self.value:g}"

    @property
    def label(self) -> str:
        """Name for tables and figures."""
        if self.kind == "converged":
            return "converged"
        return {"tau": "τ = {:g}", "relative": "f*(1+{:g})", "own_end": "own end (1+{:g})"}[self.kind].format(
            self.value
        )


def standard_targets(tolerance: float) -> tuple[Target, ...]:
    """Every target that tables show: the tau tolerance given, the relative ones, own end, converged."""
    relative = (Target("relative", epsilon) for epsilon in RELATIVE_TOLERANCES)
    return (Target("tau", tolerance), *relative, Target("own_end", OWN_END_TOLERANCE), Target("converged"))


@dataclass(frozen=True)
class Reach:
    """When a target was reached; both infinite if never."""

    iterations: float
    """Linear solves until then; 0 if the start already satisfies it."""

    seconds: float
    """Solve time until then."""


NEVER = Reach(math.inf, math.inf)
"""A target that was not reached."""


def problem_names(records: Iterable[Record]) -> list[str]:
    """Problems in the order of their first record."""
    return list(dict.fromkeys(record.problem for record in records))


def solver_names(records: Iterable[Record]) -> list[str]:
    """Solvers in the order of their first record."""
    return list(dict.fromkeys(record.solver for record in records))


def initial_costs(records: Iterable[Record]) -> dict[str, float]:
    """f0 of each problem: the largest finite initial cost of its records, NaN if there is none."""
    return _extreme(((r.problem, [r.initial_cost]) for r in records), max)


def best_cost(records: Iterable[Record], known_best: Mapping[str, float] | None = None) -> dict[str, float]:
    """f* of each problem: the lowest accepted cost that any solver reached, NaN if none is finite.

    Args:
        records: every solver counts, converged or not; of float32 only the ends, which were computed in float64.
        known_best: costs known from elsewhere (pixels squared) for some problems; the lower one is used.
    """
    costs = [(r.problem, [r.initial_cost, lowest_cost(r)]) for r in records]
    known = [(name, [(known_best or {}).get(name, math.nan)]) for name in dict.fromkeys(name for name, _ in costs)]
    return _extreme([*costs, *known], min)


def lowest_cost(record: Record) -> float:
    """The lowest cost that a run may be said to have reached, NaN if none is finite."""
    trace = [] if record.dtype == "float32" else [point.cost for point in record.trace]
    return min((cost for cost in (record.final_cost, *trace) if math.isfinite(cost)), default=math.nan)


def _extreme(costs: Iterable[tuple[str, Sequence[float]]], choose) -> dict[str, float]:
    found: dict[str, float] = {}
    for name, values in costs:
        finite = [value for value in (*values, found.get(name, math.nan)) if math.isfinite(value)]
        found[name] = choose(finite) if finite else math.nan
    return found


def threshold(f0: float, f_star: float, tolerance: float) -> float:
    """`f* + tau (f0 - f*)`, the cost that counts as solved for tolerance tau."""
    return f_star + tolerance * (f0 - f_star)


def relative_threshold(f0: float, f_star: float, epsilon: float) -> float:
    """`f*(1 + epsilon)`, but never below `f* + ZERO_RESIDUAL_FLOOR f0`."""
    return f_star + max(epsilon * f_star, ZERO_RESIDUAL_FLOOR * f0)


def converged(record: Record) -> bool:
    """Whether the solve converged within the paper's limit of iterations."""
    return record.termination.strip().lower() in CONVERGED and record.iterations <= ITERATION_LIMIT


def own_end_threshold(record: Record) -> float:
    """The cost at which a solve is within 1e-3 of its own final cost; NaN (never reached) if it did not converge.

    A solve that stalls at its start is within 1e-3 of its end from iteration 0; only a converged end is an end.
    """
    if not converged(record):
        return math.nan
    return relative_threshold(record.initial_cost, record.final_cost, OWN_END_TOLERANCE)


def first_time(record: Record, cost: float) -> float:
    """Seconds until the accepted cost is first <= `cost`; infinity if never (NaN costs never are)."""
    return next((_time(p.time_s) for p in record.trace if p.cost <= cost), math.inf)


def first_iteration(record: Record, cost: float) -> float:
    """Iterations until the accepted cost is first <= `cost`; infinity if never."""
    return next((float(p.iteration) for p in record.trace if p.cost <= cost), math.inf)


def _time(seconds: float) -> float:
    return seconds if math.isfinite(seconds) else math.inf


def reach(record: Record, target: Target, f0: float, f_star: float) -> Reach:
    """When one solve reached a target, given the problem's initial and best cost."""
    if target.kind == "converged":
        if not converged(record):
            return NEVER
        return Reach(float(record.iterations), _time(record.trace[-1].time_s if record.trace else record.total_s))
    if target.kind == "own_end":
        cost = own_end_threshold(record)
    elif target.kind == "relative":
        cost = relative_threshold(f0, f_star, target.value)
    else:
        cost = threshold(f0, f_star, target.value)
    return Reach(first_iteration(record, cost), first_time(record, cost))


def reach_table(
    records: Sequence[Record], target: Target, known_best: Mapping[str, float] | None = None
) -> dict[str, dict[str, Reach]]:
    """`table[solver][problem]`, the median over repeats; pairs that were not run are absent."""
    starts, bests = initial_costs(records), best_cost(records, known_best)
    found: dict[str, dict[str, list[Reach]]] = {}
    for r in records:
        item = reach(r, target, starts[r.problem], bests[r.problem])
        found.setdefault(r.solver, {}).setdefault(r.problem, []).append(item)
    return {solver: {name: _median_reach(items) for name, items in row.items()} for solver, row in found.items()}


def _median_reach(items: Sequence[Reach]) -> Reach:
    iterations = statistics.median(item.iterations for item in items)
    return Reach(float(iterations), float(statistics.median(item.seconds for item in items)))


@dataclass(frozen=True)
class Curve:
    """A solver's step function: the share of all problems solved within alpha times the fastest solver's time."""

    alphas: tuple[float, ...]
    """Where the curve steps, ascending, dimensionless; the first is 1."""

    shares: tuple[float, ...]
    """Value from each alpha on, in [0, 1]."""

    def share_at(self, alpha: float) -> float:
        """The share at `alpha`; 0 below 1."""
        return max((share for step, share in zip(self.alphas, self.shares, strict=True) if step <= alpha), default=0.0)


def performance_profile(times: Mapping[str, Mapping[str, float]]) -> dict[str, Curve]:
    """Performance profile of each solver.

    Args:
        times: `times[solver][problem]`, any positive measure; infinite, NaN or absent means not solved.

    Returns:
        One curve per solver. The denominator is every problem that any solver has an entry for, also those that
        nobody solved. Where the best time is 0 (solved at the start), only times of 0 are within any factor.
    """
    names = list(dict.fromkeys(name for row in times.values() for name in row))
    best = {
        name: min((row[name] for row in times.values() if row.get(name, math.nan) >= 0), default=math.inf)
        for name in names
    }
    curves = {}
    for solver, row in times.items():
        ratios = sorted(_ratio(row.get(name, math.inf), best[name]) for name in names)
        solved = [ratio for ratio in ratios if math.isfinite(ratio)]
        steps = {1.0: 0.0} | {ratio: (i + 1) / len(names) for i, ratio in enumerate(solved)}
        curves[solver] = Curve(tuple(steps), tuple(steps.values()))
    return curves


def _ratio(time: float, best: float) -> float:
    if not math.isfinite(time):
        return math.inf
    if time == best:
        return 1.0
    return time / best if best > 0 else math.inf


def cost_warnings(records: Sequence[Record]) -> list[str]:
    """One line for each problem whose solvers disagree about the initial cost: they minimised different things."""
    lines = []
    for name in problem_names(records):
        costs = {r.solver: r.initial_cost for r in records if r.problem == name and math.isfinite(r.initial_cost)}
        if not costs:
            lines.append(f"{name}: no solver has a finite initial cost")
            continue
        low, high = min(costs, key=costs.__getitem__), max(costs, key=costs.__getitem__)
        gap = (costs[high] - costs[low]) / max(abs(costs[high]), abs(costs[low]), 1e-300)
        if gap > COST_DEFINITION_TOLERANCE:
            reason = "they did not start alike" if gap > INITIAL_COST_TOLERANCE else "more than rounding explains"
            lines.append(
                f"{name}: initial costs differ by {100 * gap:.2g} % ({low} {costs[low]:.7g}, {high} {costs[high]:.7g}),"
                f" {reason}; comparisons on it mislead"
            )
    return lines
