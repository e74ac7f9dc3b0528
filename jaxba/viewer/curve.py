"""The costs of recorded solves as curves in the panel, with a dot at the iteration that is shown."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from jaxba.solver.figure import COLOURS
from jaxba.viewer.extra import viser
from jaxba.viewer.stage import Stage

ASPECT = 2.0
"""Width over height."""

DOT = 9
"""Diameter of the dot, pixels."""

LABELS, FONT = 80, "10px sans-serif"
"""Width of the numbers at the axis of costs, pixels: a thousand million has room."""


def colour_of(stage: int) -> str:
    """The colour of the curve of a stage."""
    return COLOURS[(stage + 1) % len(COLOURS)]


def add_curve(server: viser.ViserServer, stages: Sequence[Stage]) -> Any:
    """A chart in the panel, without data."""
    series: list[dict] = [{"label": "iteration"}]
    for k, stage in enumerate(stages):
        colour = colour_of(k)
        label = f"cost, {stage.shown.name}" if len(stages) > 1 else "cost (px²)"
        dot = {"show": True, "size": DOT, "fill": colour}
        series.append({"label": label, "stroke": colour, "width": 2, "points": {"show": False}})
        series.append({"label": "shown", "stroke": colour, "width": 0, "points": dot})
    return server.gui.add_uplot(
        curve_of(stages),
        tuple(series),  # pyright: ignore[reportArgumentType] (dictionaries of uPlot)
        scales={"x": {"time": False}, "y": {"distr": 3}},
        axes=({"font": FONT}, {"font": FONT, "size": LABELS}),
        padding=(14, 14, 0, 0),
        legend={"show": False},
        aspect=ASPECT,
    )


def curve_of(stages: Sequence[Stage]) -> tuple[np.ndarray, ...]:
    """Rows: iteration; per stage its cost (last value repeated); the shown iteration's cost, NaN elsewhere."""
    found = [np.arange(max(stage.shown.recording.last for stage in stages) + 1.0)]
    for stage in stages:
        recorded = stage.shown.recording.cost
        cost = np.pad(recorded, (0, len(found[0]) - len(recorded)), mode="edge")
        found += [cost, np.where(found[0] == stage.iteration, cost, np.nan)]
    return tuple(found)
