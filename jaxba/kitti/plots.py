"""Top view of a scene: points black, the path red, the true path blue, as in the first figure of the paper."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

PATH = "#D00000"
TRUTH = "#7099C8"
POINT = "#000000"

MARGIN = 30.0  # margin around the true path, metres


def draw_top_view(
    path: Path,
    views: Sequence[tuple[str, Float[np.ndarray, "points 3"], Float[np.ndarray, "poses 3"]]],
    truth: Float[np.ndarray, "poses 3"] | None,
) -> None:
    """Writes a picture (PNG) with a panel for each view, all with the same axes, equal along x and z.

    Points far outside the paths are not shown: a few distant ones would shrink the road to a line. `views` are titles,
    points and paths of the same cameras, for example before and after bundle adjustment, in the frame of the truth or
    of the first camera: x to the right, z forward. `truth` are true positions, metres; None if unknown. Raises
    OSError: it cannot be written."""
    paths = np.concatenate([*(centers for _, _, centers in views), *([] if truth is None else [truth])])[:, [0, 2]]
    low, high = paths.min(axis=0), paths.max(axis=0)
    margin = MARGIN if truth is not None else 0.3 * float((high - low).max())
    low, high = low - margin, high + margin
    wide, tall = (high - low).tolist()
    width = min(max(4.2 * wide / tall, 2.8), 9.0)
    figure = Figure(figsize=(width * len(views) + 0.8, 5.6), layout="constrained")
    axes = figure.subplots(1, len(views), squeeze=False, sharex=True, sharey=True)[0]
    for one, (title, points, centers) in zip(axes, views, strict=True):
        x, z = points[:, 0], points[:, 2]
        inside = (x > low[0]) & (x < high[0]) & (z > low[1]) & (z < high[1])
        one.scatter(x[inside], z[inside], s=1.0, c=POINT, alpha=0.5, linewidths=0, label="points")
        if truth is not None:
            one.plot(truth[:, 0], truth[:, 2], color=TRUTH, linewidth=3.0, label="ground truth", zorder=2)
        one.plot(centers[:, 0], centers[:, 2], color=PATH, linewidth=1.2, label="path", zorder=3)
        one.set_xlim(low[0], high[0])
        one.set_ylim(low[1], high[1])
        one.set_aspect("equal")
        one.set_title(title, fontsize="medium", parse_math=False)
        one.set_xlabel("x (m)" if truth is not None else "x")
    axes[0].set_ylabel("z (m)" if truth is not None else "z")
    handles, labels = axes[0].get_legend_handles_labels()
    legend = figure.legend(handles, labels, loc="outside lower center", ncols=3, frameon=False, fontsize="small")
    for handle in legend.legend_handles:
        if handle is not None and handle.get_label() == "points":
            handle.set_sizes([12.0])  # type: ignore[attr-defined]
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph .* missing", category=UserWarning)  # names in other scripts
        figure.savefig(path, dpi=150)
