"""Costs of recorded solves above the lowest, as curves in the panel, with a dot at the iteration
that is shown."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from jaxba.solver.figure import COLOURS
from jaxba.viewer.extra import viser
from jaxba.viewer.stage import Stage

TITLE = "log10 (f - f*) / f*, f* the lowest"  # what the curve shows of the cost f

FONT = {"font": "10px sans-serif"}


def colour_of(stage: int) -> str:
    """The colour of the curve of a stage."""
    return COLOURS[(stage + 1) % len(COLOURS)]


def add_curve(server: viser.ViserServer, stages: Sequence[Stage]) -> Any:
    """A chart in the panel."""
    series: list[dict] = [{}]
    for k in range(len(stages)):
        colour = colour_of(k)
        series.append({"stroke": colour, "width": 2, "points": {"show": False}})
        series.append(
            {"stroke": colour, "width": 0, "points": {"show": True, "size": 9, "fill": colour}}
        )
    looks: Any = {"series": tuple(series), "axes": (FONT, FONT), "legend": {"show": False}}
    data, scales = curve_of(stages)
    return server.gui.add_uplot(
        data, scales=scales, padding=(14, 14, 0, 0), title=TITLE, aspect=2.0, **looks
    )


def curve_of(stages: Sequence[Stage]) -> tuple[tuple[np.ndarray, ...], Any]:
    """Rows and scales. Rows: iteration; per stage the logarithm of its excess over the lowest cost
    of those that start at the same cost, the last repeated; that of the shown iteration, else NaN.
    Zeros are a tenth of the least above."""
    found = [np.arange(max(stage.shown.recording.last for stage in stages) + 1.0)]
    costs = [stage.shown.recording.cost for stage in stages]
    best = [
        min(other.min() for other in costs if other is cost or other[0] == cost[0])
        for cost in costs
    ]
    excess = [(cost - least) / least for cost, least in zip(costs, best, strict=True)]
    above = np.concatenate(excess)
    floor = 0.1 * above[above > 0].min(initial=1.0)
    for stage, one in zip(stages, excess, strict=True):
        padded = np.pad(
            np.log10(np.maximum(one, floor)), (0, len(found[0]) - len(one)), mode="edge"
        )
        found += [padded, np.where(found[0] == stage.iteration, padded, np.nan)]
    within = np.nan_to_num(found[1:])
    return tuple(found), {
        "x": {"time": False},
        "y": {"range": (float(within.min()), float(within.max()))},
    }
