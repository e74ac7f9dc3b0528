"""One HTML page with interactive charts and sortable tables that opens without a server and fetches nothing.

Charts are drawn by plotly.js, which the page holds: 4.8 MB of the package plotly. The page forbids its browser every
address (Content-Security-Policy).
"""

from __future__ import annotations

import html
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import resources
from typing import Any

from jaxba.bench.panels import Axis, Panel, Series, Style, merged, on
from jaxba.bench.tables import Table

POLICY = "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data: blob:"
"""What the page may load: its own text, and pictures that it makes."""

SYMBOLS = {"o": "circle", "s": "square", "D": "diamond", "^": "triangle-up", "v": "triangle-down"}
SYMBOLS |= {"P": "cross", "*": "star", "X": "x"}
"""Names in plotly.js of the markers in `panels.MARKERS`."""

DIGITS = 7
"""Significant digits of the numbers in a page."""


_HOVER_ROWS = (
    "<b>%{fullData.name}</b><br>iteration %{customdata[0]}, %{customdata[1]:.3g} s<br>cost %{customdata[2]:.7g}<br>"
    "λ %{customdata[3]:.3g}, gain %{customdata[4]:.3g}, %{customdata[5]}<extra></extra>"
)
_HOVER_STEPS = (
    "<b>%{fullData.name}</b><br>%{y:.3g} % of the problems within %{x:.3g} times<br>the best solver's<extra></extra>"
)
_HOVER = "<b>%{fullData.name}</b><br>%{x:.4g}: %{y:.4g}<extra></extra>"


@dataclass(frozen=True)
class Page:
    """The content of a page."""

    title: str
    facts: Mapping[str, str]
    """Machine, versions and the like, on top; the value of `command` is set as code."""
    sections: Sequence[str]
    """HTML, from `section`, `table`, `charts` and `groups`."""
    panels: Sequence[Panel]
    """Every chart, in the order of their numbers."""
    styles: Mapping[str, Style] = field(default_factory=dict)
    """Of what a reader can show and hide, by its name."""
    axes: Sequence[str] = ()
    """Positions of the switch of the x axis, the first one at the start."""
    warnings: Sequence[str] = ()


def to_html(page: Page) -> str:
    """The document. Titles, names and notes are escaped, and so are names in charts, where plotly.js knows tags."""
    asset = lambda name: resources.files("jaxba.bench").joinpath("assets", name).read_text(encoding="utf-8")
    rows: dict[int, Any] = {}  # tables that traces refer to, by identity
    charts = [_chart(panel, f"chart{k}", page, rows) for k, panel in enumerate(page.panels)]
    book = _json({"axes": list(page.axes), "rows": list(rows.values()), "charts": charts})
    facts = "".join(
        f"<div><dt>{html.escape(name)}</dt><dd>{html.escape(value)}</dd></div>"
        for name, value in page.facts.items()
        if name != "command"
    )
    command = f"<pre>{html.escape(page.facts['command'])}</pre>" if "command" in page.facts else ""
    warnings = "".join(f'<p class="warning">{html.escape(text)}</p>' for text in page.warnings)
    body = "\n".join(page.sections)
    return (
        '<!DOCTYPE html>\n<html lang="en" data-theme="light"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{html.escape(page.title)}</title><style>{asset('page.css')}</style></head>\n<body>"
        f'<h1>{html.escape(page.title)}</h1>\n{command}<dl class="facts">{facts}</dl>{warnings}\n'
        '<noscript><p class="warning">The charts of this page need JavaScript.</p></noscript>\n'
        f"{_toolbar(page)}\n{body}\n"
        f'<script type="application/json" id="book">{book}</script>\n'
        f"<script>{_plotly()}</script>\n<script>{asset('page.js')}</script>\n</body></html>\n"
    )


def _chart(panel: Panel, name: str, page: Page, rows: dict[int, Any]) -> dict[str, Any]:
    """A panel in the words of plotly.js, with three keys of our own in its traces: `meta` is the chip that hides it,
    `rows` the number of a table, and `x` and `y` are `{axis: values}`, one for each position of the page's switch,
    where values may be the number of a column of those rows."""
    heights = [y for one in panel.series for axis in panel.x for y in on(one.y, axis) if y == y and y > 0]
    low, high = (min(heights), max(heights)) if heights else (1.0, 1.0)
    traces = [trace for rank, one in enumerate(panel.series) for trace in _traces(panel, one, rank, page.styles, rows)]
    yaxis = {"title": {"text": panel.y.label}, **_axis(panel.y)}
    if panel.y.log:  # powers of ten alone where there is more than one
        yaxis |= {"exponentformat": "power", "minorloglabels": "none" if high > 20 * low else "small digits"}
    shapes = _dashed(panel.dashed, low, max(high, 10 * low))
    xaxes = {axis: {"title": {"text": one.label}, **_axis(one)} for axis, one in panel.x.items()}
    return {
        "id": name,
        "data": traces,
        "layout": {"height": panel.height, "yaxis": yaxis, "shapes": shapes},
        "xaxes": xaxes,
    }


def _axis(axis: Axis) -> dict[str, Any]:
    if axis.limits is None:
        return (
            {"type": "log"} if axis.log else {"type": "linear", **({"rangemode": "tozero"} if axis.from_zero else {})}
        )
    return {"type": "log", "range": list(map(math.log10, axis.limits))} if axis.log else {"range": list(axis.limits)}


def _traces(
    panel: Panel, one: Series, rank: int, chips: Mapping[str, Style], rows: dict[int, Any]
) -> list[dict[str, Any]]:
    """The edges of a line's shaded range, if it has one, and the line. Lines get thinner one by one, so that of equal
    ones all are seen."""
    style, x = one.style, one.x
    base: dict[str, Any] = {"name": html.escape(one.label or one.name), "meta": one.name if one.name in chips else ""}
    found = []
    if one.between:
        edge = {"x": x, "meta": base["meta"], "mode": "lines", "line": {"width": 0, "color": style.color}}
        edge["hoverinfo"] = "skip"
        shade = {"fill": "tonexty", "fillcolor": _faint(style.color)}
        low, high = one.between
        found = [{**edge, "y": low}, {**edge, "y": high, **shade}]
    if one.rows:
        base["rows"] = list(rows).index(id(one.rows)) if id(one.rows) in rows else len(rows)
        rows[id(one.rows)] = one.rows
        x = {axis: column for column, axis in enumerate(panel.x)}
    symbol, count = SYMBOLS[style.marker], len(panel.series)
    width = 0.7 if one.thin else 1.5 if one.hollow else 1.5 + 2.0 * (count - 1 - rank) / max(count - 1, 1)
    marker = {"symbol": symbol, "size": 6, "color": style.color, "maxdisplayed": 0 if panel.steps else 14}
    if one.hollow:
        symbols = [f"{symbol}-open" if empty else symbol for empty in one.hollow]
        marker |= {"symbol": symbols, "maxdisplayed": 0, "size": 7}
    line = {"color": style.color, "dash": dash(style), "width": width, **({"shape": "hv"} if panel.steps else {})}
    hover = _HOVER_STEPS if panel.steps else _HOVER_ROWS if one.rows else _HOVER
    marked = {"mode": "lines+markers", "marker": marker} if one.marked and not one.thin else {"mode": "lines"}
    own = {"x": x, "y": one.y, "line": line, "hovertemplate": hover, **marked}
    return [*found, {**base, **own, **({"opacity": 0.5} if one.thin else {})}]


def _faint(color: str) -> str:
    return "rgba({}, {}, {}, 0.18)".format(*(int(color[k : k + 2], 16) for k in (1, 3, 5)))


def _dashed(lines: Mapping[str, float], low: float, high: float) -> list[dict[str, Any]]:
    """Dashed lines over the width of a chart, labelled; those close to each other share a label."""
    labels = {y: ", ".join(names) for y, names in merged(lines, low, high)}
    return [
        {
            **{"type": "line", "xref": "paper", "x0": 0, "x1": 1, "y0": y, "y1": y, "layer": "below"},
            "line": {"color": "#8a8f94", "dash": "4px,4px", "width": 1},
            "label": {"text": labels.get(y, ""), "textposition": "end", "yanchor": "bottom", "font": {"size": 11}},
        }
        for y in lines.values()
        if math.isfinite(y) and y > 0
    ]


def _plotly() -> str:
    """The text of plotly.js."""
    return resources.files("plotly").joinpath("package_data", "plotly.min.js").read_text(encoding="utf-8")


def _json(value: Any) -> str:
    """JSON that may stand inside of a script element; numbers that are not finite become null."""
    text = json.dumps(_plain(value), allow_nan=False, separators=(",", ":"), ensure_ascii=False)
    return text.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e")


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {name: _plain(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float):
        return float(f"{value:.{DIGITS}g}") if math.isfinite(value) else None
    return value


def _toolbar(page: Page) -> str:
    parts = ['<button id="theme" title="colours">dark</button>']
    parts += [
        f'<button data-axis="{name}" aria-pressed="{str(k == 0).lower()}">over {name}</button>'
        for k, name in enumerate(page.axes)
    ]
    parts += [
        f'<button class="chip" data-key="{html.escape(name)}" aria-pressed="true" title="click: hide or show; '
        f'double click: alone">{swatch(style)}{html.escape(name)}</button>'
        for name, style in page.styles.items()
    ]
    return f'<div class="bar">{"".join(parts)}</div>'


def swatch(style: Style) -> str:
    """A piece of a solver's line with its marker, as SVG."""
    ink = 'class="swatch black"' if style.color == "#000000" else 'class="swatch"'
    color = "currentColor" if style.color == "#000000" else style.color
    dashes = "" if style.linestyle == "-" else f' stroke-dasharray="{dash(style).replace("px", "")}"'
    return (
        f'<svg {ink} viewBox="0 0 36 12" aria-hidden="true"><path d="M0 6H36" fill="none" stroke="{color}" '
        f'stroke-width="2"{dashes}/><path d="{_SHAPES[style.marker]}" fill="{color}"/></svg>'
    )


_SHAPES = {
    "o": "M14 6a4 4 0 1 0 8 0a4 4 0 1 0-8 0",
    "s": "M14 2h8v8h-8z",
    "D": "M18 1l5 5l-5 5l-5-5z",
    "^": "M18 2l4.5 8h-9z",
    "v": "M18 10l4.5-8h-9z",
    "P": "M16.5 1.5h3v3h3v3h-3v3h-3v-3h-3v-3h3z",
    "*": "M18 1l1.4 3.6l3.8.2l-3 2.4l1 3.7l-3.2-2.1l-3.2 2.1l1-3.7l-3-2.4l3.8-.2z",
    "X": "M14.5 2.5l3.5 2.5l3.5-2.5l-2.5 3.5l2.5 3.5l-3.5-2.5l-3.5 2.5l2.5-3.5z",
}


def dash(style: Style) -> str:
    """The line style in the words of plotly.js."""
    return "solid" if style.linestyle == "-" else ",".join(f"{2 * x:g}px" for x in style.linestyle[1])


def section(title: str, *parts: str) -> str:
    """A part of a page under a heading."""
    return f"<section><h2>{html.escape(title)}</h2>\n" + "\n".join(parts) + "</section>"


def note(text: str) -> str:
    """A paragraph in small type."""
    return f'<p class="note">{html.escape(text)}</p>' if text else ""


def table(content: Table, styles: Mapping[str, Style] | None = None) -> str:
    """A table under its title; a click on a column's head sorts. Rows of a solver or policy are marked by its style."""
    key = next((i for i, name in enumerate(content.header) if name in ("solver", "policy")), None)
    styles = styles or {}
    kinds = [' class="name"' if i < content.text_columns else "" for i in range(len(content.header))]
    rows = []
    for cells in content.rows:
        name = None if key is None or cells[key] not in styles else cells[key]
        marked = "" if name is None else f' data-key="{html.escape(name)}"'
        inner = "".join(
            f"<td{kind}>{swatch(styles[cell]) if i == key and name is not None else ''}{html.escape(cell)}</td>"
            for i, (kind, cell) in enumerate(zip(kinds, cells, strict=True))
        )
        rows.append(f"<tr{marked}>{inner}</tr>")
    head = "".join(f"<th{kind}>{html.escape(c)}</th>" for kind, c in zip(kinds, content.header, strict=True))
    body = "\n".join(rows)
    grid = f'<div class="scroll"><table><thead><tr>{head}</tr></thead><tbody>\n{body}\n</tbody></table></div>'
    return section(content.title, grid, note(content.note))


def charts(numbered: Iterable[tuple[int, Panel]]) -> str:
    """Charts side by side, as many as there is room for."""
    return (
        '<div class="grid">'
        + "\n".join(
            f'<figure><h3>{html.escape(panel.title)}</h3><div id="chart{k}"></div>'
            f"<figcaption>{html.escape(panel.note)}</figcaption></figure>"
            for k, panel in numbered
        )
        + "</div>"
    )


def groups(label: str, parts: Mapping[str, str]) -> str:
    """Parts of which one is shown, chosen by its name."""
    options = "".join(f'<option value="{k}">{html.escape(name)}</option>' for k, name in enumerate(parts))
    blocks = "\n".join(
        f'<div data-group="{k}"{" hidden" if k else ""}>{part}</div>' for k, part in enumerate(parts.values())
    )
    return f'<p><label>{html.escape(label)} <select id="group">{options}</select></label></p>\n{blocks}'
