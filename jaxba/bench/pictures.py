"""Charts of a page as pictures for papers and slides, drawn by matplotlib."""

from __future__ import annotations

import html
import os
import warnings
from typing import TYPE_CHECKING, Any

from jaxba.bench.charts import Chart
from jaxba.runtime.atomic import atomic_write

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PANEL_INCHES = (5.2, 4.0)


def save_picture(chart: Chart, path: str | os.PathLike[str]) -> None:
    """Writes the `picture` of a chart as a PNG file of 150 dpi. Raises OSError."""
    with atomic_write(path) as file, warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph .* missing", category=UserWarning)  # names in other scripts
        picture(chart).savefig(file, format="png", dpi=150)


def picture(chart: Chart) -> Figure:
    """A matplotlib figure of a chart, with a panel for each of its x axes; `savefig` writes it."""
    from matplotlib.figure import Figure  # late: its import takes 0.3 s

    width, height = PANEL_INCHES
    figure = Figure(figsize=(width * len(chart["xaxes"]), height), layout="constrained")
    panels = figure.subplots(1, len(chart["xaxes"]), squeeze=False, sharey=True)[0]
    for panel, (name, x_axis) in zip(panels, chart["xaxes"].items(), strict=True):
        for trace in chart["data"]:
            x, y = (values[name] if isinstance(values, dict) else values for values in (trace["x"], trace["y"]))
            _draw(panel, trace, x, y)
        _scale(panel, "x", x_axis)
        if x_axis["type"] == "log" and x_axis.get("range", [0, 9])[1] < 2:
            panel.xaxis.set_major_formatter("{x:g}")
            panel.xaxis.set_minor_formatter("{x:g}")
        _scale(panel, "y", chart["layout"]["yaxis"])
        panel.grid(alpha=0.3)
    panels[-1].set_ylabel("" if len(panels) > 1 else panels[0].get_ylabel())
    names = [html.unescape(trace["name"]).replace("$", r"\$") for trace in chart["data"]]
    panels[0].legend(panels[0].get_lines(), names, fontsize="small", frameon=False)  # also names that begin with _
    figure.suptitle(chart["title"], fontsize="medium", parse_math=False)
    return figure


def _draw(panel: Axes, trace: dict[str, Any], x: Any, y: Any) -> None:
    line = trace["line"]
    dashes = [float(part.removesuffix("px")) for part in line["dash"].split(",") if part[0].isdigit()]
    style = (0, [part / line["width"] for part in dashes]) if dashes else "-"
    where = "steps-post" if line.get("shape") == "hv" else "default"
    own = {"color": line["color"], "linewidth": line["width"], "linestyle": style, "drawstyle": where}
    panel.plot(x, y, **own)


def _scale(panel: Axes, side: str, axis: dict[str, Any]) -> None:
    panel.set(**{f"{side}label": axis["title"]["text"], f"{side}scale": axis["type"]})
    if "range" in axis:
        low, high = (10**limit for limit in axis["range"]) if axis["type"] == "log" else axis["range"]
        panel.set(**{f"{side}lim": (low, high)})
