"""What figures show, described once for two engines: matplotlib (`plots`) draws files, plotly.js (`page`) a page."""

from __future__ import annotations

import itertools
import math
import operator
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeAlias

from jaxba.bench import profile
from jaxba.bench.profile import Target
from jaxba.solver.figure import COLOURS
from jaxba.solver.record import Record

AXES = ("iterations", "time")
"""What the figures of a benchmark have on x."""

LINES = ("-", (0, (6, 1.5)), (0, (6, 1.5, 1, 1.5)), (0, (1.5, 1.2)))
"""Line styles, a different one for each next solver, so that curves can be told apart in black and white."""

MARKERS = "osD^vP*X"
"""Markers, one per colour."""

RESERVED = ("classic", "ceres", "learned", "guarded", "bold", "ceres+refine3", "ceres+embedded", "nielsen+embedded")
"""Solvers that have the first styles in every figure, those of the documents included."""

COLUMNS = ("iteration", "time_s", "cost", "damping", "gain_ratio", "accepted")
"""Fields of a `TracePoint` in the rows of a run."""

SAME_COST = 1e-9
"""Largest relative difference of the costs of two runs that are said to be equal."""

CLIPPING = 1e3
"""A convergence plot reaches below the lowest tolerance line by this factor."""

LOG_TIME_SPREAD = 20.0
"""The time axis is logarithmic if the longest solve takes more than this times the shortest."""

LABEL_DISTANCE = 0.06
"""Fraction of the axis height below which the labels of two dashed lines would overlap."""


@dataclass(frozen=True)
class Style:
    """Colour, line style and marker of a solver, in the words of matplotlib."""

    color: str
    linestyle: Any
    marker: str


def solver_styles(solvers: Iterable[str]) -> dict[str, Style]:
    """A style for each solver: one of `RESERVED` has its own, others the first that are free, in the given order."""
    names, n = list(dict.fromkeys(solvers)), len(COLOURS)
    taken = {name: RESERVED.index(name) for name in names if name in RESERVED}
    free = (i for i in itertools.count() if i not in taken.values())
    rank = {name: taken[name] if name in taken else next(free) for name in names}
    return {name: Style(COLOURS[i % n], LINES[(i + i // n) % len(LINES)], MARKERS[i % n]) for name, i in rank.items()}


@dataclass(frozen=True)
class Axis:
    """An axis of a panel."""

    label: str
    log: bool = False
    limits: tuple[float, float] | None = None
    from_zero: bool = False


Values: TypeAlias = Sequence[Any] | Mapping[str, Sequence[Any]]
"""Numbers of the points of a line, or by what is on x."""


def on(values: Values, axis: str) -> Sequence[Any]:
    """The numbers where x is `axis`."""
    return values[axis] if isinstance(values, Mapping) else values


@dataclass(frozen=True)
class Series:
    """A line of a panel. NaN is a gap."""

    name: str
    """Solver or policy whose line it is."""
    x: Values
    y: Values
    style: Style
    label: str = ""
    """What the line is called, `name` if empty."""
    hollow: Sequence[bool] = ()
    """Points that are drawn hollow, if any."""
    between: tuple[Sequence[Any], Sequence[Any]] | None = None
    """Lower and upper edge of a shaded range."""
    rows: Sequence[Sequence[Any]] = ()
    """What the page tells of a point under the pointer, `COLUMNS`; `x` has its first two."""
    marked: bool = True
    thin: bool = False


@dataclass(frozen=True)
class Panel:
    """Lines over a common x, or one of several."""

    title: str
    series: list[Series]
    x: Mapping[str, Axis]
    y: Axis
    steps: bool = False
    dashed: Mapping[str, float] = field(default_factory=dict)
    """Heights of dashed lines by their label."""
    note: str = ""
    floor: float | None = None
    """Height at which zeros of a logarithmic axis are drawn, if there are any."""
    height: int = 340
    """Pixels in the page."""


def profile_panel(records: Sequence[Record], target: Target, known_best: Mapping[str, float] | None = None) -> Panel:
    """Performance profiles by iterations and by time."""
    styles, count = solver_styles(profile.solver_names(records)), len(profile.problem_names(records))
    table = profile.reach_table(records, target, known_best)
    found: dict[str, dict[str, profile.Curve]] = {}
    for axis, measure in (("iterations", "iterations"), ("time", "seconds")):
        values = {s: {name: getattr(item, measure) for name, item in row.items()} for s, row in table.items()}
        found[axis] = profile.performance_profile(values)
    last = {axis: max((c.alphas[-1] for c in curves.values()), default=1.0) for axis, curves in found.items()}
    limits = {axis: (1.0, max(2.0, 1.3 * most)) for axis, most in last.items()}
    series = []
    for solver in table:
        curves = {axis: found[axis][solver] for axis in AXES}
        x = {axis: [*curve.alphas, limits[axis][1]] for axis, curve in curves.items()}
        y = {axis: [100 * value for value in (*c.fractions, c.fractions[-1])] for axis, c in curves.items()}
        series.append(Series(solver, x, y, styles[solver]))
    axes = {
        axis: Axis(f"\N{GREEK SMALL LETTER ALPHA} = {axis} / least {axis} of any solver", True, limits[axis])
        for axis in AXES
    }
    same = _equal({solver: found["iterations"][solver] for solver in table})
    return Panel(target.label, series, axes, Axis(f"% of all {count} problems", False, (-3.0, 103.0)), True, note=same)


def problem_panels(
    records: Sequence[Record], problem: str, tolerance: float, known_best: Mapping[str, float] | None = None
) -> tuple[Panel, Panel, Panel]:
    """Accepted cost, distance to the best cost, and lambda on one problem.

    The cost has dashed lines at `f* + tau (f0 - f*)` for the paper's tolerances and the given one; the distance,
    `f - f*` over f* (over f0 for zero-residual problems), at the relative tolerances. Distances far below the lowest
    line are drawn at the bottom. The repeat of median time is drawn.

    Args:
        records: of all problems, so that colours are those of all other figures.
        problem: name of one of them.
        tolerance: tau of a dashed line.
        known_best: best known costs, see `profile.best_cost`.
    """
    styles, runs = solver_styles(profile.solver_names(records)), representatives(records, problem)
    x = {"iterations": Axis("iteration"), "time": Axis("solve time (s)", _time_is_log(runs.values()))}
    f0, f_star = profile.initial_costs(records)[problem], profile.best_cost(records, known_best)[problem]
    gaps = {e: profile.relative_threshold(f0, f_star, e) - f_star for e in profile.RELATIVE_TOLERANCES}
    floored = {e for e in gaps if not e * f_star > profile.ZERO_RESIDUAL_FLOOR * f0}
    unit, unit_name = (f0, "f0") if len(floored) == len(gaps) else (f_star, "f*")
    unit = unit if unit > 0 else 1.0
    least = min(gaps.values()) / unit / CLIPPING or 1e-30
    lowest = min((p.cost for r in records if r.problem == problem for p in r.trace if p.cost > 0), default=1e-30)
    dampings = [p.damping for run in runs.values() for p in run.trace[1:] if math.isfinite(p.damping)]
    zero = min((value for value in dampings if value > 0), default=1e-2) / 100
    drawn = (
        lambda _, p: max(p.cost, lowest / 10),
        lambda _, p: max((p.cost - f_star) / unit, least),
        lambda k, p: math.nan if k == 0 else p.damping if p.damping > 0 else zero,
    )
    lines: tuple[list[Series], ...] = ([], [], [])
    for solver, run in runs.items():
        rows = rows_of(run)
        places = {axis: [row[COLUMNS.index(name)] for row in rows] for axis, name in zip(AXES, COLUMNS, strict=False)}
        for k, (found, height) in enumerate(zip(lines, drawn, strict=True)):
            known = [p.damping if k == 2 else p.cost for p in run.trace]
            y = [height(i, p) if math.isfinite(known[i]) else math.nan for i, p in enumerate(run.trace)]
            hollow = [not p.accepted for p in run.trace] if k == 2 else ()
            found.append(Series(solver, places, y, styles[solver], hollow=hollow, rows=rows))
    taus = {f"τ = {tau:g}": profile.threshold(f0, f_star, tau) for tau in profile.taus(tolerance)}
    floors = {"zero-residual floor" if e in floored else f"f*(1+{e:g})": gap / unit for e, gap in gaps.items()}
    hollow_note = "Hollow: the step was rejected."
    if has_zero := 0.0 in dampings:
        hollow_note += f" λ = 0 is drawn at {zero:.1g}."
    cost = Panel(
        "Accepted cost (pixels²)", lines[0], x, Axis("cost (pixels²)", True), False, taus, _equal(runs, _same_costs)
    )
    distance = Panel("Distance to the best cost", lines[1], x, Axis(f"(f - f*) / {unit_name}", True), dashed=floors)
    damping = Panel("Damping λ", lines[2], x, Axis("λ", True), note=hollow_note, floor=zero if has_zero else None)
    return replace(cost, height=400), replace(distance, height=400), replace(damping, height=400)


def rows_of(record: Record) -> list[list[Any]]:
    """A row for every iteration, the start first, with `COLUMNS`."""
    return [
        [*(getattr(p, name) for name in COLUMNS[:-1]), "accepted" if p.accepted else "rejected"] for p in record.trace
    ]


def representatives(records: Sequence[Record], problem: str) -> dict[str, Record]:
    """For each solver, the repeat with the (lower) median solve time."""
    own = [r for r in records if r.problem == problem]
    runs = {solver: [r for r in own if r.solver == solver] for solver in profile.solver_names(own)}
    return {solver: sorted(items, key=_end)[(len(items) - 1) // 2] for solver, items in runs.items()}


def _time_is_log(runs: Iterable[Record]) -> bool:
    ends = [end for end in map(_end, runs) if 0 < end < math.inf]
    return bool(ends) and max(ends) / min(ends) > LOG_TIME_SPREAD


def _end(record: Record) -> float:
    return record.trace[-1].time_s if record.trace and math.isfinite(record.trace[-1].time_s) else math.inf


def _equal(curves: Mapping[str, Any], same: Callable[[Any, Any], bool] = operator.eq) -> str:
    """Says which curves lie on each other, by iterations."""
    groups: list[tuple[Any, list[str]]] = []
    for solver, curve in curves.items():
        names = next((names for first, names in groups if same(first, curve)), None)
        if names is None:
            groups.append((curve, [solver]))
        else:
            names.append(solver)
    shared = [" = ".join(names) for _, names in groups if len(names) > 1]
    return f"The same curve by iterations: {'; '.join(shared)}." if shared else ""


def _same_costs(one: Record, other: Record) -> bool:
    """Whether two runs had the same costs up to rounding."""
    pairs = zip(one.trace, other.trace, strict=False)
    return len(one.trace) == len(other.trace) and all(math.isclose(a.cost, b.cost, rel_tol=SAME_COST) for a, b in pairs)


def merged(lines: Mapping[str, float], low: float, high: float) -> list[tuple[float, list[str]]]:
    """Heights of dashed lines on a logarithmic axis from `low` to `high`, ascending, with the labels that stand there:
    those of lines nearer than `LABEL_DISTANCE` share a place."""
    groups: list[tuple[float, list[str]]] = []
    for y, label in sorted((y, label) for label, y in lines.items() if math.isfinite(y) and y > 0):
        if groups and math.log(y / groups[-1][0]) < LABEL_DISTANCE * math.log(high / low):
            groups[-1][1].append(label)
        else:
            groups.append((y, [label]))
    return groups
