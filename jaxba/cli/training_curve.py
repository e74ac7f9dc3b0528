"""The training curve: held-out iterations over updates, with the baselines as horizontal lines."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from jaxba.bench.plots import COLOURS, LINES, MARKERS
from jaxba.training.log import Row

SHOWN = {"score": "mean iterations", "p90": "90th percentile of the iterations", "failures": "failures (%)"}
"""Panels: fields of a held-out score and their labels."""


def plot_curve(rows: Sequence[Row], rules: Mapping[str, Mapping[str, float]], tolerance: float) -> Figure:
    """Held-out scores of every agent over its updates.

    Args:
        rows: of the log; those without an evaluation are left out.
        rules: fields of a score (`score` is the mean) by name of the baseline.
        tolerance: of success, for the labels.
    """
    figure = Figure(figsize=(12.0, 4.4), layout="constrained")
    panels = figure.subplots(1, len(SHOWN))
    seeds = sorted({row["seed"] for row in rows})
    handles = []
    for k, seed in enumerate(seeds):
        style = {"color": COLOURS[(1 + k) % len(COLOURS)], "marker": MARKERS[k % len(MARKERS)], "markersize": 3.5}
        own_rows = [row for row in rows if row["seed"] == seed and row.get("held_out/score") is not None]
        for axes, field in zip(panels, SHOWN, strict=True):
            points = [(row["updates"], row.get(f"held_out/{field}")) for row in own_rows]
            points = [(x, _shown(field, y)) for x, y in points if y is not None]
            axes.plot([x for x, _ in points], [y for _, y in points], zorder=3, linewidth=1.6, **style)
        handles.append(Line2D([], [], linewidth=1.6, label=f"learned, agent {seed + 1}", **style))
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
