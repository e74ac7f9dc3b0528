"""Charts of a page in the words of plotly.js: lines over one of several x axes, and the charts of a
benchmark.

A trace's `meta` is the chip that hides it; `x` and `y` are `{axis: values}` by the switch, or the
same for all."""

from __future__ import annotations

import html
import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple, TypeAlias

from jaxba.bench import profile
from jaxba.bench.profile import Target
from jaxba.solver.figure import COLOURS
from jaxba.solver.record import Record

AXES = ("iterations", "time")  # what the charts of a benchmark have on x

DASHES = ("solid", "12px,3px", "12px,3px,2px,3px", "3px,2.4px")
"""Line styles, a different one for each next solver, so that curves can be told apart in black and
white."""

# markers
SYMBOLS = ("circle", "square", "diamond", "triangle-up", "triangle-down", "cross", "star", "x")

RESERVED = (
    "classic",
    "ceres",
    "learned",
    "guarded",
    "bold",
    "ceres+refine3",
    "ceres+embedded",
    "nielsen+embedded",
)
"""Solvers that have the first styles in every figure, those of the documents included."""

CLIPPING = 1e3  # a convergence plot reaches below the lowest tolerance line by this factor
# the time axis is logarithmic if the longest solve takes more than this times the shortest
LOG_TIME_SPREAD = 20.0
# fraction of the axis height below which the labels of two dashed lines would overlap
LABEL_DISTANCE = 0.06
LABEL_WIDTH = 100  # pixels of their labels, beside the chart

_ROWS = (
    "<b>%{fullData.name}</b> %{customdata[0]}: cost %{customdata[2]:.7g}, λ "
    "%{customdata[3]:.1e}%{customdata[4]}"
    "<extra></extra>"
)
_STEPS = "<b>%{fullData.name}</b> %{y:.3g} % of the problems within %{x:.3g} times<extra></extra>"
_POINT = "<b>%{fullData.name}</b> %{y:.4g} at %{x:.4g}<extra></extra>"

# of a line's points, or by what is on x; NaN is a gap
Values: TypeAlias = Sequence[Any] | Mapping[str, Sequence[Any]]
# title, note, traces, layout, and the x axis of every position of the switch
Chart: TypeAlias = dict[str, Any]


class Style(NamedTuple):
    """Colour, dashes and marker of a solver."""

    color: str
    dash: str
    symbol: str


def solver_styles(solvers: Iterable[str]) -> dict[str, Style]:
    """A style for each solver: one of `RESERVED` has its own, others the first that are free, in
    the given order."""
    names = list(dict.fromkeys(solvers))
    n = len(COLOURS)
    taken = {name: RESERVED.index(name) for name in names if name in RESERVED}
    free = (i for i in itertools.count() if i not in taken.values())
    rank = {name: taken[name] if name in taken else next(free) for name in names}

    # other ones when colours come again
    def pick(values, i):
        return values[(i + i // n) % len(values)]

    return {
        name: Style(COLOURS[i % n], pick(DASHES, i), pick(SYMBOLS, i)) for name, i in rank.items()
    }


def line(
    name: str,
    x: Values,
    y: Values,
    style: Style,
    *,
    label: str = "",
    marked: bool = True,
    **own: Any,
) -> Chart:
    """The trace of a solver's or policy's line through points, with markers if `marked`. `label` is
    what it is called, if not by its name; `own` are further keys."""
    marker = {"symbol": style.symbol, "size": 6, "color": style.color, "maxdisplayed": 14}
    how = {"mode": "lines+markers", "marker": marker} if marked else {"mode": "lines"}
    drawn = {
        "line": {"color": style.color, "dash": style.dash},
        "hovertemplate": _POINT,
        **how,
        **own,
    }
    return {"name": html.escape(label or name), "meta": name, "x": x, "y": y, **drawn}


def hollow(trace: Chart, empty: Sequence[bool]) -> Chart:
    """The line with all of its markers, hollow ones where said."""
    symbols = [f"{trace['marker']['symbol']}{'-open' * one}" for one in empty]
    marker = {**trace["marker"], "symbol": symbols, "maxdisplayed": 0, "size": 7}
    return {**trace, "marker": marker, "line": {**trace["line"], "width": 1.5}}


def axis(
    label: str, *, log: bool = False, limits: tuple[float, float] | None = None, zero: bool = False
) -> Chart:
    """An axis, which begins at zero or has limits if that is asked for."""
    found: Chart = {"title": {"text": label}, "type": "log" if log else "linear"}
    if limits is not None:
        found["range"] = [*map(math.log10, limits)] if log else [*limits]
    return {**found, **({"rangemode": "tozero"} if zero else {})}


def chart(
    title: str,
    traces: Sequence[Chart],
    x: Mapping[str, Chart],
    y: Chart,
    *,
    dashed: Mapping[str, float] | None = None,
    note: str = "",
    height: int = 400,
) -> Chart:
    """A chart of lines, which get thinner one by one, so that of equal ones all are seen. `x` has
    an axis for every position of the switch, `dashed` the heights of dashed lines by their labels;
    the note stands below, and the height is in pixels."""
    count = max(len(traces) - 1, 1)
    thick = [
        {**one["line"], "width": one["line"].get("width", 1.5 + 2 * (1 - k / count))}
        for k, one in enumerate(traces)
    ]
    every = (
        v
        for one in traces
        for v in (one["y"].values() if isinstance(one["y"], Mapping) else [one["y"]])
    )
    heights = [v for values in every for v in values if v == v and v > 0]
    low, high = (min(heights), max(heights)) if heights else (1.0, 1.0)
    if y["type"] == "log":  # powers of ten alone where there is more than one
        y = {
            **y,
            "exponentformat": "power",
            "minorloglabels": "none" if high > 20 * low else "small digits",
        }
    return {
        "title": title,
        "note": note,
        "data": [{**one, "line": own} for one, own in zip(traces, thick, strict=True)],
        "layout": {
            "height": height,
            "yaxis": y,
            **_dashed(dashed or {}, low, max(high, 10 * low), y["type"] == "log"),
        },
        "xaxes": dict(x),
    }


def _dashed(lines: Mapping[str, float], low: float, high: float, log: bool) -> dict[str, Any]:
    """Dashed lines over the width of a chart, with labels beside it; those close to each other
    share a label."""
    heights = {label: y for label, y in lines.items() if math.isfinite(y) and y > 0}
    labels: dict[float, list[str]] = {}
    for y, label in sorted((y, label) for label, y in heights.items()):
        if labels and math.log(y / next(reversed(labels))) < LABEL_DISTANCE * math.log(high / low):
            labels[next(reversed(labels))].append(label)
        else:
            labels[y] = [label]
    stroke = {"color": "#8a8f94", "dash": "4px,4px", "width": 1}
    shapes = [
        {
            "type": "line",
            "xref": "paper",
            "x0": 0,
            "x1": 1,
            "y0": y,
            "y1": y,
            "layer": "above",
            "line": stroke,
        }
        for y in heights.values()
    ]
    beside = {"xref": "paper", "x": 1, "xanchor": "left", "showarrow": False, "font": {"size": 11}}
    notes = [
        {**beside, "y": math.log10(y) if log else y, "text": "<br>".join(text)}
        for y, text in labels.items()
    ]
    return (
        {"shapes": shapes, "annotations": notes, "margin": {"r": LABEL_WIDTH}}
        if heights
        else {"shapes": []}
    )


def profile_chart(records: Sequence[Record], target: Target, styles: Mapping[str, Style]) -> Chart:
    """Performance profiles by iterations and by time."""
    count = len(profile.problem_names(records))
    table = profile.reach_table(records, target)
    found: dict[str, dict[str, profile.Curve]] = {}
    for name, measure in zip(AXES, ("iterations", "seconds"), strict=True):
        values = {
            s: {problem: getattr(item, measure) for problem, item in row.items()}
            for s, row in table.items()
        }
        found[name] = profile.performance_profile(values)
    last = {
        name: max((alphas[-1] for alphas, _ in curves.values()), default=1.0)
        for name, curves in found.items()
    }
    limits = {name: (1.0, max(2.0, 1.3 * most)) for name, most in last.items()}
    traces = []
    for solver in table:
        x = {name: [*found[name][solver][0], limits[name][1]] for name in AXES}
        parts = {name: found[name][solver][1] for name in AXES}
        y = {name: [100 * value for value in (*own, own[-1])] for name, own in parts.items()}
        one = line(solver, x, y, styles[solver], hovertemplate=_STEPS)
        one["line"]["shape"], one["marker"]["maxdisplayed"] = "hv", 0
        traces.append(one)
    label = "\N{GREEK SMALL LETTER ALPHA} = {0} / least {0} of any solver"
    axes = {name: axis(label.format(name), log=True, limits=limits[name]) for name in AXES}
    height = axis(f"% of all {count} problems", limits=(0.0, 100.0))
    return chart(target.label, traces, axes, height, height=340)


def problem_charts(
    records: Sequence[Record], problem: str, tolerance: float, styles: Mapping[str, Style]
) -> list[Chart]:
    """Accepted cost, distance to the best cost, and lambda on one problem, by the records of all.

    The cost has dashed lines at `f* + tau (f0 - f*)` for the paper's tolerances and the given one;
    the distance, `f - f*` over f* (over f0 for zero-residual problems), at the relative tolerances.
    Distances far below the lowest line are drawn at the bottom. The repeat of median time is
    drawn."""
    runs = representatives(records, problem)
    ends = [end for end in map(_end, runs.values()) if 0 < end < math.inf]
    log = bool(ends) and max(ends) / min(ends) > LOG_TIME_SPREAD
    axes = {"iterations": axis("iteration"), "time": axis("solve time (s)", log=log)}
    f0 = profile.initial_costs(records)[problem]
    f_star = profile.best_cost(records)[problem]
    gaps = {
        e: profile.relative_threshold(f0, f_star, e) - f_star for e in profile.RELATIVE_TOLERANCES
    }
    floored = {e for e in gaps if not e * f_star > profile.ZERO_RESIDUAL_FLOOR * f0}
    unit, unit_name = (f0, "f0") if len(floored) == len(gaps) else (f_star, "f*")
    unit = unit if unit > 0 else 1.0
    least = min(gaps.values()) / unit / CLIPPING or 1e-30
    lowest = min(
        (p.cost for r in records if r.problem == problem for p in r.trace if p.cost > 0),
        default=1e-30,
    )
    dampings = [
        p.damping for run in runs.values() for p in run.trace[1:] if math.isfinite(p.damping)
    ]
    zero = min((value for value in dampings if value > 0), default=1e-2) / 100
    costs = []
    distances = []
    lambdas = []
    for solver, run in runs.items():
        rows = [
            [p.iteration, p.time_s, p.cost, p.damping, "" if p.accepted else ", rejected"]
            for p in run.trace
        ]
        x = {name: [row[k] for row in rows] for k, name in enumerate(AXES)}
        # of NaN, `max` keeps the first
        known = [p.cost if math.isfinite(p.cost) else math.nan for p in run.trace]

        def own(y, solver=solver, x=x, rows=rows):
            return line(solver, x, y, styles[solver], customdata=rows, hovertemplate=_ROWS)

        costs.append(own([max(cost, lowest / 10) for cost in known]))
        distances.append(own([max((cost - f_star) / unit, least) for cost in known]))
        heights = [
            p.damping if p.damping > 0 or not math.isfinite(p.damping) else zero for p in run.trace
        ]
        heights = [x if k and math.isfinite(x) else math.nan for k, x in enumerate(heights)]
        lambdas.append(hollow(own(heights), [not p.accepted for p in run.trace]))
    taus = {f"τ = {tau:g}": profile.threshold(f0, f_star, tau) for tau in profile.taus(tolerance)}
    floors = {
        "zero-residual floor" if e in floored else f"f*(1+{e:g})": gap / unit
        for e, gap in gaps.items()
    }
    note = (
        "Hollow: the step was "
        f"rejected.{f' λ = 0 is drawn at {zero:.1g}.' if 0.0 in dampings else ''}"
    )
    cost, distance, damping = (
        axis(x, log=True) for x in ("cost (pixels²)", f"(f - f*) / {unit_name}", "λ")
    )
    return [
        chart("Accepted cost (pixels²)", costs, axes, cost, dashed=taus),
        chart("Distance to the best cost", distances, axes, distance, dashed=floors),
        chart("Damping λ", lambdas, axes, damping, note=note),
    ]


def representatives(records: Sequence[Record], problem: str) -> dict[str, Record]:
    """For each solver, the repeat with the (lower) median solve time."""
    own = [r for r in records if r.problem == problem]
    runs = {solver: [r for r in own if r.solver == solver] for solver in profile.solver_names(own)}
    return {
        solver: sorted(items, key=_end)[(len(items) - 1) // 2] for solver, items in runs.items()
    }


def _end(record: Record) -> float:
    return (
        record.trace[-1].time_s
        if record.trace and math.isfinite(record.trace[-1].time_s)
        else math.inf
    )
