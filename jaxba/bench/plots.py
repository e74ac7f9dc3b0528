"""Panels drawn with matplotlib, for files. Each function returns a `Figure`.

pyplot is not used, so that there is no global state and no display is needed.
"""

from __future__ import annotations

import math
import os
import re
import warnings
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import AutoLocator, FuncFormatter, LogLocator, MaxNLocator, NullLocator

from jaxba.bench import profile
from jaxba.bench.panels import Panel, Series, merged, on, problem_panels, profile_panel, representatives
from jaxba.bench.profile import Target
from jaxba.solver.record import Record

ZOOM_ITERATIONS = 10
"""Iterations in the zoomed part of the damping chart. Source: the paper's figure."""

DENSE_TICKS = 200.0
"""A logarithmic axis has ticks at 1, 2 and 5 up to this ratio of its limits; up to a ratio of 5, ticks are linear."""


def plot_profiles(
    records: Sequence[Record], targets: Sequence[Target], known_best: Mapping[str, float] | None = None
) -> Figure:
    """Performance profiles by time and by iterations, over alpha on a logarithmic axis.

    Args:
        records: of at least one solver.
        targets: one column for each, with time above and iterations below. A single target has them side by side.
        known_best: best known costs, see `profile.best_cost`.
    """
    alone = len(targets) == 1
    size = {"width": 9.6, "height": 4.2} if alone else {"width": 1.0 + 3.6 * len(targets), "height": 6.4}
    figure, axes = _figure(*((1, 2) if alone else (2, len(targets))), **size)
    panels = [profile_panel(records, target, known_best) for target in targets]
    for column, panel in enumerate(panels):
        pair = axes[0] if alone else axes[:, column]
        for one, axis in zip(pair, ("time", "iterations"), strict=True):
            _draw(one, panel, axis)
        for one in pair if alone else pair[:1]:
            one.set_title(panel.title, parse_math=False, fontsize="medium")
    for one in axes[:1, 0] if alone else axes[:, 0]:
        one.set_ylabel(panels[0].y.label)
    _legend(figure, panels[0].series, marker=False)
    return figure


def plot_convergence(
    records: Sequence[Record], problem: str, tolerance: float = 1e-3, known_best: Mapping[str, float] | None = None
) -> Figure:
    """Accepted cost (above) and distance to the best cost (below) of every solver on one problem, over time (left) and
    iterations (right); see `problem_panels`."""
    *panels, damping = problem_panels(records, problem, tolerance, known_best)
    figure, axes = _figure(2, 2, width=10.5, height=7.6)
    figure.suptitle(_safe(problem))
    for row, panel in zip(axes, panels, strict=True):
        for one, axis in zip(row, ("time", "iterations"), strict=True):
            _draw(one, panel, axis)
        row[0].set_ylabel(panel.y.label)
        _log_ticks(row[0].yaxis)  # shared with the right column
        _dashed(row, panel.dashed)
    _legend(figure, damping.series)
    return figure


def plot_lambda(records: Sequence[Record], problem: str) -> Figure:
    """Lambda of each iteration on one problem, with hollow markers for rejected steps, and a zoomed part.

    As in the paper's figure, the zoomed part shows the last ten iterations of the solver `classic`. If that did not
    converge, it shows those of the longest converged solve, else of the longest solve. It is left out if no solve has
    more than ten iterations. lambda = 0 is drawn at the lower edge. The repeat of median time is drawn.
    """
    *_, panel = problem_panels(records, problem, profile.OWN_END_TOLERANCE)
    lines = [one for one in panel.series if _points(one, "iterations")]
    places = [x for one in lines for x, _, _ in _points(one, "iterations")] or [1]
    heights = [y for one in lines for _, y, _ in _points(one, "iterations")] or [1e-2, 1.0]
    zoomed = max(places) > ZOOM_ITERATIONS
    figure = Figure(figsize=(10.5, 4.6), layout="constrained")
    main, *zoom = figure.subplots(1, 1 + zoomed, width_ratios=(2, 1)[: 1 + zoomed], squeeze=False)[0]
    figure.suptitle(_safe(problem))
    for axes in (main, *zoom):
        for one in lines:
            _hollow_line(axes, one, 4.5 if axes is main else 6.0)
        axes.set_yscale("log")
        axes.set_xlabel(panel.x["iterations"].label)
        axes.xaxis.set_major_locator(_whole_ticks())
        axes.grid(alpha=0.25)
    main.set_xlim(0, max(places) + 1)
    main.set_ylim((panel.floor or min(heights) / 3) / 2, 3 * max(heights))
    _log_ticks(main.yaxis)
    main.set_ylabel("damping λ (hollow: rejected)")
    if panel.floor:
        where = {"transform": main.get_yaxis_transform(), "ha": "right", "va": "center", "fontsize": "small"}
        main.text(0.99, panel.floor, "λ = 0", **where)
    if zoom:
        runs = representatives(records, problem)
        _zoom(main, zoom[0], lines, _zoom_range({one.name: runs[one.name] for one in lines}))
    _legend(figure, lines)
    return figure


def plot_curves(panels: Sequence[Panel], axis: str) -> Figure:
    """Curves of a training side by side, over what `axis` names."""
    figure = Figure(figsize=(4.0 * len(panels), 4.4), layout="constrained")
    for axes, panel in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels, strict=True):
        _draw(axes, panel, axis)
        axes.set_title(panel.title, fontsize="medium")
        axes.set_ylim(bottom=0)
        axes.grid(alpha=0.25)
    lines = {one.label or one.name: one for panel in panels for one in panel.series if not one.thin}
    _legend(figure, list(lines.values()))
    return figure


def _draw(axes: Axes, panel: Panel, axis: str) -> None:
    """Draws the lines of a panel, over what `axis` names."""
    x = panel.x[axis]
    thick = [one for one in panel.series if not one.thin]
    for rank, one in enumerate(thick):
        points = [(a, b) for a, b, _ in _points(one, axis) if a > 0 or not x.log]
        a, b = [point[0] for point in points], [point[1] for point in points]
        width = 1.3 + 1.3 * (len(thick) - 1 - rank) / max(len(thick) - 1, 1)  # equal curves stay visible
        if one.between:
            axes.fill_between(on(one.x, axis), *one.between, color=one.style.color, alpha=0.25, linewidth=0)
        if panel.steps:
            axes.step(a, b, where="post", zorder=3, clip_on=False, **_line(one, width))
        else:
            marks = {"marker": one.style.marker, "markersize": 3.5, "markevery": max(1, len(a) // 12)}
            axes.plot(a, b, zorder=3, **_line(one, width), **(marks if one.marked else {}))
    axes.set_xlabel(x.label)
    axes.set_xscale("log" if x.log else "linear")
    axes.set_yscale("log" if panel.y.log else "linear")
    if x.limits:
        axes.set_xlim(*x.limits)
    if panel.y.limits:
        axes.set_ylim(*panel.y.limits)
    if x.log:
        _log_ticks(axes.xaxis)
    elif axis == "iterations":
        axes.xaxis.set_major_locator(_whole_ticks())


def _points(one: Series, axis: str) -> list[tuple[Any, Any, bool]]:
    """Place, height and hollowness of the points that are finite."""
    x, y = on(one.x, axis), on(one.y, axis)
    every = zip(x, y, one.hollow or [False] * len(x), strict=True)
    return [point for point in every if math.isfinite(point[0]) and math.isfinite(point[1])]


def _line(one: Series, width: float) -> dict[str, Any]:
    """Keyword arguments of `Axes.plot`, without the marker; `width` in points."""
    return {"color": one.style.color, "linestyle": one.style.linestyle, "linewidth": width}


def _hollow_line(axes: Axes, one: Series, size: float) -> None:
    points, style = _points(one, "iterations"), one.style
    axes.plot([x for x, _, _ in points], [y for _, y, _ in points], alpha=0.8, zorder=2, **_line(one, 1.1))
    for hollow, fill in ((False, style.color), (True, "white")):
        chosen = [(x, y) for x, y, empty in points if empty == hollow]
        marks = {"marker": style.marker, "markersize": size, "markeredgecolor": style.color, "markerfacecolor": fill}
        axes.plot([x for x, _ in chosen], [y for _, y in chosen], linestyle="none", zorder=3, **marks)


def _zoom(main: Axes, zoom: Axes, lines: Sequence[Series], span: tuple[int, int]) -> None:
    start, end = span
    inside = [y for one in lines for x, y, _ in _points(one, "iterations") if start <= x <= end]
    zoom.set_xlim(start - 0.5, end + 0.5)
    zoom.set_ylim(min(inside) / 3, max(inside) * 3)
    _log_ticks(zoom.yaxis)
    zoom.set_title(f"iterations {start} to {end}", fontsize="medium")
    main.indicate_inset_zoom(zoom, edgecolor="0.4", alpha=0.6)


def _zoom_range(runs: Mapping[str, Record]) -> tuple[int, int]:
    """First and last iteration of the zoomed part of `plot_lambda`."""
    finished = {solver: r for solver, r in runs.items() if profile.converged(r)}
    chosen = [finished["classic"]] if "classic" in finished else list((finished or runs).values())
    end = max((r.trace[-1].iteration for r in chosen), default=1)
    return max(end - ZOOM_ITERATIONS + 1, 1), end


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
    for y, labels in merged(lines, *last.get_ylim()):
        where: dict[str, Any] = {"xy": (1.0, y), "xycoords": ("axes fraction", "data"), "textcoords": "offset points"}
        last.annotate("\n".join(labels[::-1]), **where, xytext=(4, 0), va="center", fontsize="small", color="0.25")


def _legend(figure: Figure, lines: Sequence[Series], marker: bool = True) -> None:
    """Adds one legend below all axes."""
    if not lines:
        return
    mark = lambda one: one.style.marker if marker and one.marked else ""
    handles = [Line2D([], [], **_line(one, 1.6), marker=mark(one), markersize=5) for one in lines]
    labels = [_safe(one.label or one.name) for one in lines]
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
