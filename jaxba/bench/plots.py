"""Figures from records: performance profiles, convergence, damping. Each function returns a matplotlib `Figure`.

pyplot is not used, so that there is no global state and no display is needed. A solver has the same colour, line style
and marker in all figures made from the same records.
"""

from __future__ import annotations

import itertools
import math
import os
import re
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import AutoLocator, FuncFormatter, LogLocator, MaxNLocator, NullLocator

from jaxba.bench import profile
from jaxba.bench.levels import levels, merged, representatives, time_is_log
from jaxba.bench.profile import Target
from jaxba.solver.figure import COLOURS
from jaxba.solver.record import Record, TracePoint

LINES = ("-", (0, (6, 1.5)), (0, (6, 1.5, 1, 1.5)), (0, (1.5, 1.2)))
"""Line styles, a different one for each next solver, so that curves can be told apart in black and white."""

MARKERS = "osD^vP*X"
"""Markers, one per colour."""

RESERVED = ("classic", "ceres", "learned", "guarded", "bold", "ceres+refine3", "ceres+embedded", "nielsen+embedded")
"""Solvers that have the first styles in every figure, those of the documents included."""

ZOOM_ITERATIONS = 10
"""Iterations in the zoomed part of the damping chart. Source: the paper's figure."""

DENSE_TICKS = 200.0
"""A logarithmic axis has ticks at 1, 2 and 5 up to this ratio of its limits; up to a ratio of 5, ticks are linear."""

LABEL_DISTANCE = 0.06
"""Fraction of the axis height below which the labels of two dashed lines would overlap."""


@dataclass(frozen=True)
class Style:
    """Colour, line style and marker of a solver."""

    color: str
    linestyle: Any
    marker: str

    def line(self, width: float = 1.6) -> dict[str, Any]:
        """Keyword arguments of `Axes.plot`, without the marker; `width` in points."""
        return {"color": self.color, "linestyle": self.linestyle, "linewidth": width}


def solver_styles(solvers: Iterable[str]) -> dict[str, Style]:
    """A style for each solver: one of `RESERVED` has its own, others the first that are free, in the given order."""
    names, n = list(dict.fromkeys(solvers)), len(COLOURS)
    taken = {name: RESERVED.index(name) for name in names if name in RESERVED}
    free = (i for i in itertools.count() if i not in taken.values())
    rank = {name: taken[name] if name in taken else next(free) for name in names}
    return {name: Style(COLOURS[i % n], LINES[(i + i // n) % len(LINES)], MARKERS[i % n]) for name, i in rank.items()}


def plot_profiles(
    records: Sequence[Record], targets: Sequence[Target], known_best: Mapping[str, float] | None = None
) -> Figure:
    """Performance profiles by time and by iterations, over alpha on a logarithmic axis.

    Args:
        records: of at least one solver.
        targets: one column for each, with time above and iterations below. A single target has them side by side.
        known_best: best known costs, see `profile.best_cost`.
    """
    styles = solver_styles(profile.solver_names(records))
    count = len(profile.problem_names(records))
    if len(targets) == 1:
        figure, axes = _figure(1, 2, width=9.6, height=4.2)
        axes = axes.T
    else:
        figure, axes = _figure(2, len(targets), width=1.0 + 3.6 * len(targets), height=6.4)
    for column, target in enumerate(targets):
        table = profile.reach_table(records, target, known_best)
        for row, measure in enumerate(("seconds", "iterations")):
            values = {s: {name: getattr(item, measure) for name, item in line.items()} for s, line in table.items()}
            name = "time" if measure == "seconds" else "iterations"
            curves = profile.performance_profile(values)
            _profile_axes(axes[row][column], curves, styles, rf"$\alpha$ = {name} / least {name} of any solver")
        for one in axes[:1, column] if len(targets) > 1 else axes[:, column]:
            one.set_title(target.label, parse_math=False, fontsize="medium")
    for one in axes[:, 0] if len(targets) > 1 else axes[:1, 0]:
        one.set_ylabel(f"fraction of all problems (%, n = {count})")
    _legend(figure, styles, marker=False)
    return figure


def _profile_axes(axes: Axes, curves: Mapping[str, profile.Curve], styles: Mapping[str, Style], label: str) -> None:
    last = max((alpha for curve in curves.values() for alpha in curve.alphas), default=1.0)
    limit = max(2.0, 1.3 * last)
    for rank, (solver, curve) in enumerate(curves.items()):
        x, y = [*curve.alphas, limit], [100 * value for value in (*curve.fractions, curve.fractions[-1])]
        width = 1.3 + 1.3 * (len(curves) - 1 - rank) / max(len(curves) - 1, 1)  # equal curves stay visible
        axes.step(x, y, where="post", zorder=3, clip_on=False, **styles[solver].line(width))
    axes.set_xscale("log")
    axes.set_xlim(1.0, limit)
    _log_ticks(axes.xaxis)
    axes.set_ylim(-2, 102)
    axes.set_xlabel(label)


def plot_convergence(
    records: Sequence[Record], problem: str, tolerance: float = 1e-3, known_best: Mapping[str, float] | None = None
) -> Figure:
    """Accepted cost of every solver on one problem, over time (left) and iterations (right).

    Upper row: the cost, with dashed lines at `f* + tau (f0 - f*)` for the paper's tolerances and the given one.
    Lower row: `f - f*` relative to f* (to f0 for zero-residual problems), with dashed lines at the relative tolerances.
    Distances far below the lowest line are drawn at the bottom. The repeat of median time is drawn.
    """
    styles = solver_styles(profile.solver_names(records))
    runs = representatives(records, problem)
    lines = levels(records, problem, tolerance, known_best)
    figure, axes = _figure(2, 2, width=10.5, height=7.6)
    figure.suptitle(_safe(problem))
    for column, measure in enumerate(("time_s", "iteration")):
        scale = "log" if measure == "time_s" and time_is_log(runs.values()) else "linear"
        for solver, run in runs.items():
            points = [p for p in run.trace if math.isfinite(p.cost) and math.isfinite(p.time_s)]
            points = [p for p in points if p.time_s > 0] if scale == "log" else points
            x = [getattr(p, measure) for p in points]
            style = {"marker": styles[solver].marker, "markersize": 3.5, "markevery": max(1, len(points) // 12)}
            style |= {"zorder": 3} | styles[solver].line()
            axes[0][column].plot(x, [max(p.cost, lines.lowest / 10) for p in points], **style)
            axes[1][column].plot(x, [lines.gap(p.cost) for p in points], **style)
        for one in axes[:, column]:
            one.set_yscale("log")
            one.set_xscale(scale)
            if measure == "iteration":
                one.xaxis.set_major_locator(_whole_ticks())
            elif scale == "log":
                _log_ticks(one.xaxis)
        axes[1][column].set_xlabel("solve time (s)" if measure == "time_s" else "iteration")
    for one in axes[:, 0]:
        _log_ticks(one.yaxis)  # shared with the right column
    _dashed(axes[0], lines.costs)
    _dashed(axes[1], lines.gaps)
    axes[0][0].set_ylabel("cost (pixels²)")
    axes[1][0].set_ylabel(rf"$(f - f^*)\,/\,{'f_0' if lines.unit_name == 'f0' else 'f^*'}$")
    _legend(figure, {solver: styles[solver] for solver in runs})
    return figure


def plot_lambda(records: Sequence[Record], problem: str) -> Figure:
    """Lambda of each iteration on one problem, with hollow markers for rejected steps, and a zoomed part.

    As in the paper's figure, the zoomed part shows the last ten iterations of the solver `classic`. If that did not
    converge, it shows those of the longest converged solve, else of the longest solve. It is left out if no solve has
    more than ten iterations. lambda = 0 is drawn at the lower edge. The repeat of median time is drawn.
    """
    styles = solver_styles(profile.solver_names(records))
    runs = representatives(records, problem)
    lines = {s: [p for p in r.trace[1:] if math.isfinite(p.damping)] for s, r in runs.items()}
    lines = {solver: line for solver, line in lines.items() if line}
    values = [p.damping for line in lines.values() for p in line]
    positive = [value for value in values if value > 0] or [1e-2, 1.0]
    low, high = min(positive) / (100 if 0.0 in values else 3), max(positive) * 3
    longest = max((p.iteration for line in lines.values() for p in line), default=1)
    zoomed = longest > ZOOM_ITERATIONS
    figure = Figure(figsize=(10.5, 4.6), layout="constrained")
    main, *zoom = figure.subplots(1, 1 + zoomed, width_ratios=(2, 1)[: 1 + zoomed], squeeze=False)[0]
    figure.suptitle(_safe(problem))
    for axes, size in zip((main, *zoom), (4.5, 6.0), strict=False):
        for solver, line in lines.items():
            _damping_line(axes, line, styles[solver], low, size)
        axes.set_yscale("log")
        axes.set_xlabel("iteration")
        axes.xaxis.set_major_locator(_whole_ticks())
        axes.grid(alpha=0.25)
    main.set_xlim(0, longest + 1)
    main.set_ylim(low / 2, high)
    _log_ticks(main.yaxis)
    main.set_ylabel("damping λ (hollow: rejected)")
    if 0.0 in values:
        main.text(0.99, low, "λ = 0", transform=main.get_yaxis_transform(), ha="right", va="center", fontsize="small")
    if zoom:
        _zoom(main, zoom[0], lines, _zoom_range({solver: runs[solver] for solver in lines}), low)
    _legend(figure, {solver: styles[solver] for solver in lines})
    return figure


def _zoom(main: Axes, zoom: Axes, lines: Mapping[str, Sequence[TracePoint]], span: tuple[int, int], low: float) -> None:
    start, end = span
    inside = [max(p.damping, low) for line in lines.values() for p in line if start <= p.iteration <= end]
    zoom.set_xlim(start - 0.5, end + 0.5)
    zoom.set_ylim(min(inside) / 3, max(inside) * 3)
    _log_ticks(zoom.yaxis)
    zoom.set_title(f"iterations {start} to {end}", fontsize="medium")
    main.indicate_inset_zoom(zoom, edgecolor="0.4", alpha=0.6)


def _log_ticks(axis: Axis) -> None:
    """Sets few ticks with plain labels such as 1e-5 on a logarithmic axis whose limits are set.

    matplotlib's own labels are not used, since rendering their powers of ten takes half of the time of a figure.
    """
    low, high = axis.get_view_interval()
    dense = LogLocator(subs=(1.0, 2.0, 5.0)) if high < DENSE_TICKS * low else LogLocator()
    axis.set_major_locator(AutoLocator() if high < 5 * low else dense)
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(
        FuncFormatter(lambda value, _: re.sub(r"e([+-])0?", r"e\1", f"{value:g}").replace("e+", "e"))
    )


def _whole_ticks() -> MaxNLocator:
    return MaxNLocator(integer=True, steps=[1, 2, 5, 10])


def _zoom_range(runs: Mapping[str, Record]) -> tuple[int, int]:
    """First and last iteration of the zoomed part of `plot_lambda`."""
    finished = {solver: r for solver, r in runs.items() if profile.converged(r)}
    chosen = [finished["classic"]] if "classic" in finished else list((finished or runs).values())
    end = max((r.trace[-1].iteration for r in chosen), default=1)
    return max(end - ZOOM_ITERATIONS + 1, 1), end


def _damping_line(axes: Axes, line: Sequence[TracePoint], style: Style, low: float, size: float) -> None:
    y = {p.iteration: p.damping if p.damping > 0 else low for p in line}
    axes.plot(list(y), list(y.values()), alpha=0.8, zorder=2, **style.line(1.1))
    for accepted, fill in ((True, style.color), (False, "white")):
        x = [p.iteration for p in line if p.accepted == accepted]
        marks = {"marker": style.marker, "markersize": size, "markeredgecolor": style.color, "markerfacecolor": fill}
        axes.plot(x, [y[i] for i in x], linestyle="none", zorder=3, **marks)


def _figure(rows: int, columns: int, width: float, height: float) -> tuple[Figure, Any]:
    figure = Figure(figsize=(width, height), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False, sharey="row")
    for one in axes.flat:
        one.grid(alpha=0.25)
    return figure, axes


def _dashed(row: Iterable[Axes], lines: Mapping[str, float]) -> None:
    """Draws horizontal dashed lines in axes that share y, labelled at the right. Lines too close share a label."""
    *_, last = row = list(row)
    for axes in row:
        for y in lines.values():
            if math.isfinite(y) and y > 0:
                axes.axhline(y, color="0.35", linestyle=(0, (4, 3)), linewidth=0.8, zorder=1)
    for y, labels in merged(lines, *last.get_ylim(), LABEL_DISTANCE):
        where: dict[str, Any] = {"xy": (1.0, y), "xycoords": ("axes fraction", "data"), "textcoords": "offset points"}
        last.annotate("\n".join(labels[::-1]), **where, xytext=(4, 0), va="center", fontsize="small", color="0.25")


def _legend(figure: Figure, styles: Mapping[str, Style], marker: bool = True) -> None:
    """Adds one legend below all axes."""
    if not styles:
        return
    handles = [Line2D([], [], **s.line(), marker=s.marker if marker else "", markersize=5) for s in styles.values()]
    labels = [_safe(name) for name in styles]
    columns = max(1, min(len(labels), int(figure.get_figwidth() * 11 / (max(map(len, labels)) + 8))))
    figure.legend(
        handles, labels, loc="outside lower center", ncols=columns, frameon=False, fontsize="small", handlelength=3.2
    )


def _safe(name: str, longest: int = 48) -> str:
    """A name as a label: shortened, without mathematics mode, and without a leading underscore, which would hide it."""
    short = name if len(name) <= longest else f"{name[: longest // 2 - 1]}…{name[-(longest // 2) :]}"
    return (" " + short if short.startswith("_") else short).replace("$", r"\$")


def save_figure(figure: Figure, stem: str | os.PathLike[str]) -> list[Path]:
    """Writes `stem.png` (150 dpi) and `stem.svg`, reproducibly to the byte. Raises OSError."""
    paths = [Path(f"{os.fspath(stem)}.{kind}") for kind in ("png", "svg")]
    with warnings.catch_warnings(), matplotlib.rc_context({"svg.hashsalt": "jaxba"}):
        warnings.filterwarnings("ignore", message="Glyph .* missing", category=UserWarning)  # names in other scripts
        figure.draw_without_rendering()
        figure.set_layout_engine("none")  # keeps the layout, since computing it again for each file is slow
        figure.savefig(paths[0], dpi=150)
        figure.savefig(paths[1], metadata={"Date": None})
    return paths
