"""The figure of a solve: cost and lambda over its iterations."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from jaxba.lm.records import StepInfo

if TYPE_CHECKING:
    from jaxba.problem.display import Picture

COLOURS = ("#000000", "#0072B2", "#D55E00", "#009E73", "#E69F00", "#CC79A7", "#56B4E9", "#7F7F7F")
"""Okabe and Ito's palette, safe for colour-blind readers; grey for its yellow, which is too light
for lines."""

COST = COLOURS[1]
DAMPING = COLOURS[2]
REJECTED = COLOURS[-1]


def plot_history(history: StepInfo, initial_cost: float) -> Picture:
    """Cost above and lambda below, over the iterations, on logarithmic axes; steps that were
    rejected are grey. The history is that of a solution, NumPy arrays; the initial cost is
    pixels^2."""
    from jaxba.problem.display import Picture  # late: the import of matplotlib takes 0.3 s

    figure = Picture(figsize=(6.4, 5.2), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True)
    iterations = np.arange(1, len(history.cost) + 1)
    rejected = ~np.asarray(history.accepted, bool)
    above.plot(
        [0, *iterations], [initial_cost, *history.cost], color=COST, marker="o", markersize=3
    )
    above.set_ylabel("cost (px²)")
    below.plot(iterations, history.damping, color=DAMPING, marker="o", markersize=3)
    below.set_ylabel("λ")
    for axes, values in ((above, np.asarray(history.cost)), (below, np.asarray(history.damping))):
        if rejected.any():
            axes.plot(
                iterations[rejected],
                values[rejected],
                "o",
                color=REJECTED,
                markersize=5,
                label="rejected",
            )
            axes.legend(frameon=False)
        axes.set_yscale("log")
        axes.grid(alpha=0.25)
    below.set_xlabel("iteration")
    below.xaxis.get_major_locator().set_params(integer=True)
    return figure
