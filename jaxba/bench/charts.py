"""The interactive charts of a benchmark's report, as data for plotly.js: the same numbers as the figures of `plots`."""

from __future__ import annotations

import html
import math
import operator
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from jaxba.bench import profile
from jaxba.bench.levels import levels, merged, representatives, time_is_log
from jaxba.bench.page import SYMBOLS, Chart, line
from jaxba.bench.plots import LABEL_DISTANCE, Style, solver_styles
from jaxba.bench.profile import Target
from jaxba.solver.record import Record

AXES = ("iterations", "time")
"""Positions of the switch."""

COLUMNS = ("iteration", "time_s", "cost", "damping", "gain_ratio", "accepted")
"""Fields of a `TracePoint` in the rows of a run."""

SAME_COST = 1e-9
"""Largest relative difference of the costs of two runs that are said to be equal."""

_HOVER = (
    "<b>%{fullData.name}</b><br>iteration %{customdata[0]}, %{customdata[1]:.3g} s<br>cost %{customdata[2]:.7g}<br>"
    "λ %{customdata[3]:.3g}, gain %{customdata[4]:.3g}, %{customdata[5]}<extra></extra>"
)


def profile_charts(
    records: Sequence[Record], tolerance: float, known_best: Mapping[str, float] | None = None
) -> list[Chart]:
    """A performance profile for each tau (the paper's and the given one) and for each relative tolerance."""
    styles, count = solver_styles(profile.solver_names(records)), len(profile.problem_names(records))
    return [_profile(records, target, styles, count, known_best) for target in profile.cost_targets(tolerance)]


def _profile(
    records: Sequence[Record],
    target: Target,
    styles: Mapping[str, Style],
    count: int,
    known_best: Mapping[str, float] | None,
) -> Chart:
    table = profile.reach_table(records, target, known_best)
    found: dict[str, dict[str, profile.Curve]] = {}
    for axis in AXES:
        measure = "seconds" if axis == "time" else "iterations"
        values = {s: {name: getattr(item, measure) for name, item in row.items()} for s, row in table.items()}
        found[axis] = profile.performance_profile(values)
    limits = {axis: _limit(curves) for axis, curves in found.items()}
    traces = []
    for rank, solver in enumerate(table):
        curves = {axis: found[axis][solver] for axis in AXES}
        traces.append(
            {
                **_named(solver),
                "x": {axis: [*curve.alphas, limits[axis]] for axis, curve in curves.items()},
                "y": {axis: [100 * y for y in (*c.fractions, c.fractions[-1])] for axis, c in curves.items()},
                "mode": "lines+markers",
                "line": {**line(styles[solver], _width(rank, len(table))), "shape": "hv"},
                "marker": {"symbol": SYMBOLS[styles[solver].marker], "size": 5, "color": styles[solver].color},
                "hovertemplate": "<b>%{fullData.name}</b><br>%{y:.3g} % of the problems within %{x:.3g} times<br>the "
                "best solver's<extra></extra>",
            }
        )
    xaxes = {
        axis: {
            "title": {"text": f"\N{GREEK SMALL LETTER ALPHA} = {axis} / least {axis} of any solver"},
            "range": [0, math.log10(limit)],
        }
        for axis, limit in limits.items()
    }
    layout = {
        "xaxis": {"type": "log"},
        "yaxis": {"title": {"text": f"% of all {count} problems"}, "range": [-3, 103]},
    }
    return Chart(target.label, traces, layout, _equal({s: found["iterations"][s] for s in table}), xaxes)


def _limit(curves: Mapping[str, profile.Curve]) -> float:
    return max(2.0, 1.3 * max((alpha for curve in curves.values() for alpha in curve.alphas), default=1.0))


def _width(rank: int, count: int) -> float:
    """Lines get thinner from solver to solver, so that of equal curves all are seen."""
    return 1.5 + 2.0 * (count - 1 - rank) / max(count - 1, 1)


def _named(solver: str) -> dict[str, Any]:
    return {"name": html.escape(solver), "meta": solver}  # plotly.js takes a name for HTML


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


def rows_of(record: Record) -> list[list[Any]]:
    """A row for every iteration, the start first, with `COLUMNS`."""
    return [
        [*(getattr(p, name) for name in COLUMNS[:-1]), "accepted" if p.accepted else "rejected"] for p in record.trace
    ]


def problem_charts(
    records: Sequence[Record],
    problem: str,
    tolerance: float,
    known_best: Mapping[str, float] | None = None,
    first_row: int = 0,
) -> tuple[list[Chart], list[list[list[Any]]]]:
    """Convergence (cost, distance to the best cost) and lambda on one problem.

    Args:
        records: of all problems, so that colours are those of all other charts.
        problem: name of one of them.
        tolerance: tau of a dashed line.
        known_best: best known costs, see `profile.best_cost`.
        first_row: number of the first of the returned tables in the page.

    Returns:
        The charts, and the table of every solver that was run (`rows_of`) to which their traces refer.
    """
    styles, runs = solver_styles(profile.solver_names(records)), representatives(records, problem)
    marks = levels(records, problem, tolerance, known_best)
    x = {axis: COLUMNS.index("iteration" if axis == "iterations" else "time_s") for axis in AXES}
    xaxes = {
        "iterations": {"title": {"text": "iteration"}, "type": "linear"},
        "time": {"title": {"text": "solve time (s)"}, "type": "log" if time_is_log(runs.values()) else "linear"},
    }
    costs, gaps, dampings = [], [], []
    values = [p.damping for run in runs.values() for p in run.trace[1:] if math.isfinite(p.damping)]
    zero = min((value for value in values if value > 0), default=1e-2) / 100
    for k, (solver, run) in enumerate(runs.items()):
        style = styles[solver]
        marker = {"symbol": SYMBOLS[style.marker], "size": 6, "color": style.color, "maxdisplayed": 14}
        base = {**_named(solver), "rows": first_row + k, "x": x, "mode": "lines+markers", "hovertemplate": _HOVER}
        lines = {**base, "line": line(style, _width(k, len(runs))), "marker": marker}
        finite = [p.cost if math.isfinite(p.cost) else math.nan for p in run.trace]
        costs.append({**lines, "y": [max(c, marks.lowest / 10) if c == c else c for c in finite]})
        gaps.append({**lines, "y": [marks.gap(c) if c == c else c for c in finite]})
        symbols = [SYMBOLS[style.marker] + ("" if p.accepted else "-open") for p in run.trace]
        shown = [math.nan if k == 0 else p.damping if p.damping > 0 else zero for k, p in enumerate(run.trace)]
        own = {"marker": {**marker, "symbol": symbols, "maxdisplayed": 0, "size": 7}, "line": line(style, 1.5)}
        dampings.append({**base, **own, "y": [v if math.isfinite(v) else math.nan for v in shown]})
    same = _equal(runs, _same_costs)
    log = lambda title, low_high, lines: {
        "yaxis": {"type": "log", "title": {"text": title}, **log_labels(*low_high)},
        "height": 400,
        "shapes": _dashed(lines, *low_high),
    }
    hollow = "Hollow: the step was rejected."
    if 0.0 in values:
        hollow += f" λ = 0 is drawn at {zero:.1g}."
    distance = log(f"(f - f*) / {marks.unit_name}", _range(gaps), marks.gaps)
    return [
        Chart("Accepted cost (pixels²)", costs, log("cost", _range(costs), marks.costs), same, xaxes),
        Chart("Distance to the best cost", gaps, distance, "", xaxes),
        Chart("Damping λ", dampings, log("λ", _range(dampings), {}), hollow, xaxes),
    ], [rows_of(run) for run in runs.values()]


def _same_costs(one: Record, other: Record) -> bool:
    """Whether two runs had the same costs up to rounding."""
    pairs = zip(one.trace, other.trace, strict=False)
    return len(one.trace) == len(other.trace) and all(math.isclose(a.cost, b.cost, rel_tol=SAME_COST) for a, b in pairs)


def _range(traces: Sequence[Mapping[str, Any]]) -> tuple[float, float]:
    values = [y for trace in traces for y in trace["y"] if y == y and y > 0]
    return (min(values), max(values)) if values else (1.0, 1.0)


def log_labels(low: float, high: float) -> dict[str, Any]:
    """Labels of a logarithmic axis: powers of ten alone where it has more than one."""
    return {"exponentformat": "power", "minorloglabels": "none" if high > 20 * low else "small digits"}


def _dashed(lines: Mapping[str, float], low: float, high: float) -> list[dict[str, Any]]:
    """Dashed lines over the width of a chart, labelled; those close to each other share a label."""
    labels = {y: ", ".join(names) for y, names in merged(lines, low, max(high, 10 * low), LABEL_DISTANCE)}
    return [
        {
            **{"type": "line", "xref": "paper", "x0": 0, "x1": 1, "y0": y, "y1": y, "layer": "below"},
            "line": {"color": "#8a8f94", "dash": "4px,4px", "width": 1},
            "label": {"text": labels.get(y, ""), "textposition": "end", "yanchor": "bottom", "font": {"size": 11}},
        }
        for y in lines.values()
        if math.isfinite(y) and y > 0
    ]
