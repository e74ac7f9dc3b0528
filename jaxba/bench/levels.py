"""What the figures of one problem show: a run of every solver, and the costs at which dashed lines stand."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from jaxba.bench import profile
from jaxba.solver.record import Record

CLIPPING = 1e3
"""A convergence plot reaches below the lowest tolerance line by this factor."""

LOG_TIME_SPREAD = 20.0
"""The time axis is logarithmic if the longest solve takes more than this times the shortest."""


@dataclass(frozen=True)
class Levels:
    """Dashed lines of the convergence of one problem, costs in pixels squared."""

    best: float
    """f*."""
    lowest: float
    """Lowest positive cost of any run."""
    unit: float
    """What distances to f* are divided by: f*, or f0 where all relative tolerances are the zero-residual floor."""
    unit_name: str
    """`f*` or `f0`."""
    costs: dict[str, float]
    """Thresholds of tau by their label."""
    gaps: dict[str, float]
    """Distances to f* of the relative tolerances, over the unit, by their label."""

    @property
    def least_gap(self) -> float:
        """Distances below this, over the unit, are drawn at this one."""
        return min(self.gaps.values()) / CLIPPING or 1e-30

    def gap(self, cost: float) -> float:
        """Distance of a cost to f* over the unit, at least `least_gap`."""
        return max((cost - self.best) / self.unit, self.least_gap)


def levels(
    records: Sequence[Record], problem: str, tolerance: float, known_best: Mapping[str, float] | None = None
) -> Levels:
    """The dashed lines of a problem. The arguments are those of `plots.plot_convergence`."""
    f0, f_star = profile.initial_costs(records)[problem], profile.best_cost(records, known_best)[problem]
    gaps = {e: profile.relative_threshold(f0, f_star, e) - f_star for e in profile.RELATIVE_TOLERANCES}
    floored = {e for e in gaps if not e * f_star > profile.ZERO_RESIDUAL_FLOOR * f0}
    unit, name = (f0, "f0") if len(floored) == len(gaps) else (f_star, "f*")
    unit = unit if unit > 0 else 1.0
    positive = (p.cost for r in records if r.problem == problem for p in r.trace if p.cost > 0)
    return Levels(
        best=f_star,
        lowest=min(positive, default=1e-30),
        unit=unit,
        unit_name=name,
        costs={f"τ = {tau:g}": profile.threshold(f0, f_star, tau) for tau in profile.taus(tolerance)},
        gaps={"zero-residual floor" if e in floored else f"f*(1+{e:g})": gap / unit for e, gap in gaps.items()},
    )


def representatives(records: Sequence[Record], problem: str) -> dict[str, Record]:
    """For each solver, the repeat with the (lower) median solve time."""
    runs: dict[str, list[Record]] = {}
    for r in records:
        if r.problem == problem:
            runs.setdefault(r.solver, []).append(r)
    return {solver: sorted(items, key=_end)[(len(items) - 1) // 2] for solver, items in runs.items()}


def time_is_log(runs: Iterable[Record]) -> bool:
    """Whether the time axis is logarithmic."""
    ends = [end for end in map(_end, runs) if 0 < end < math.inf]
    return bool(ends) and max(ends) / min(ends) > LOG_TIME_SPREAD


def _end(record: Record) -> float:
    return record.trace[-1].time_s if record.trace and math.isfinite(record.trace[-1].time_s) else math.inf


def merged(lines: Mapping[str, float], low: float, high: float, distance: float) -> list[tuple[float, list[str]]]:
    """Heights of dashed lines on a logarithmic axis from `low` to `high`, ascending, with the labels that stand there:
    those of lines nearer than a fraction `distance` of the axis share a place."""
    groups: list[tuple[float, list[str]]] = []
    for y, label in sorted((y, label) for label, y in lines.items() if math.isfinite(y) and y > 0):
        if groups and math.log(y / groups[-1][0]) < distance * math.log(high / low):
            groups[-1][1].append(label)
        else:
            groups.append((y, [label]))
    return groups
