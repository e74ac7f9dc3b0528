"""The training curve: held-out iterations over updates, with the baselines as horizontal lines."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from jaxba.bench.plots import LINES, MARKERS
from jaxba.solver.figure import COLOURS
from jaxba.training.log import Row

SHOWN = {"score": "mean iterations", "p90": "90th percentile of the iterations", "failures": "failures (%)"}
"""Panels: fields of a held-out score and their labels."""


def plot_curve(rows: Sequence[Row], rules: Mapping[str, Mapping[str, float]], tolerance: float) -> Figure:
    """Mean held-out scores over the updates of an agent, and the range of several agents.

    Args:
        rows: of the log; those without an evaluation are left out.
        rules: fields of a score (`score` is the mean) by name of the baseline.
        tolerance: of success, for the labels.
    """
    figure = Figure(figsize=(12.0, 4.4), layout="constrained")
    panels = figure.subplots(1, len(SHOWN))
    scored = [row for row in rows if row.get("held_out/score") is not None]
    updates = sorted({row["updates"] for row in scored})
    agents = len({row["seed"] for row in rows})
    style = {"color": COLOURS[1 % len(COLOURS)], "linewidth": 1.6}
    for axes, field in zip(panels, SHOWN, strict=True):
        name = f"held_out/{field}"
        found = {x: [row[name] for row in scored if row["updates"] == x and row.get(name) is not None] for x in updates}
        shown = [(x, [_shown(field, y) for y in ys]) for x, ys in found.items() if ys]
        places, values = [x for x, _ in shown], [ys for _, ys in shown]
        if agents > 1:
            low, high = [min(ys) for ys in values], [max(ys) for ys in values]
            axes.fill_between(places, low, high, color=style["color"], alpha=0.25, linewidth=0)
        means = [sum(ys) / len(ys) for ys in values]
        axes.plot(places, means, zorder=3, marker=MARKERS[0], markersize=3.5, **style)
    label = "trained" if agents == 1 else f"trained, mean and range of {agents} agents"
    handles = [Line2D([], [], label=label, marker=MARKERS[0], markersize=3.5, **style)]
    for k, (name, numbers) in enumerate(rules.items()):
        color = COLOURS[0] if k < len(LINES) else COLOURS[-1]
        style = {"color": color, "linestyle": LINES[k % len(LINES)], "linewidth": 1.0}
        for axes, field in zip(panels, SHOWN, strict=True):
            if field in numbers:
                axes.axhline(_shown(field, numbers[field]), zorder=2, **style)
        handles.append(Line2D([], [], label=name, **style))
    for axes, label in zip(panels, SHOWN.values(), strict=True):
        axes.set_xlabel("gradient updates")
        axes.set_title(label, fontsize="medium")
        axes.set_ylim(bottom=0)
        axes.grid(alpha=0.25)
    panels[0].set_ylabel(f"to f*(1 + {tolerance:g}) on held-out scenes")
    figure.legend(handles=handles, loc="outside lower center", ncols=5, frameon=False, fontsize="small", handlelength=3)
    return figure


def _shown(field: str, value: float) -> float:
    return 100 * value if field == "failures" else value
