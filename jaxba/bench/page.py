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

from jaxba.bench.plots import Style
from jaxba.bench.tables import Table

POLICY = "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data: blob:"
"""What the page may load: its own text, and pictures that it makes."""

SYMBOLS = {"o": "circle", "s": "square", "D": "diamond", "^": "triangle-up", "v": "triangle-down"}
SYMBOLS |= {"P": "cross", "*": "star", "X": "x"}
"""Names in plotly.js of the markers in `plots.MARKERS`."""

DIGITS = 7
"""Significant digits of the numbers in a page."""


@dataclass(frozen=True)
class Chart:
    """A chart. A trace is one of plotly.js with three keys of our own: `meta` is the name of the solver that hides it,
    `rows` the number of a table in `Page.rows`, and `x` and `y` may also be `{axis: values}`, one for each position of
    the page's switch, where values may be the number of a column of those rows."""

    title: str
    traces: list[dict[str, Any]]
    layout: dict[str, Any]
    note: str = ""
    xaxes: dict[str, dict[str, Any]] = field(default_factory=dict)
    """Extra settings of the x axis for each position of the switch."""


@dataclass(frozen=True)
class Page:
    """The content of a page."""

    title: str
    facts: Mapping[str, str]
    """Machine, versions and the like, on top; the value of `command` is set as code."""
    sections: Sequence[str]
    """HTML, from `section`, `table`, `charts` and `groups`."""
    charts: Sequence[Chart]
    """Every chart, in the order of their numbers."""
    styles: Mapping[str, Style] = field(default_factory=dict)
    """Of what a reader can show and hide, by its name."""
    axes: Sequence[str] = ()
    """Positions of the switch of the x axis, the first one at the start."""
    rows: Sequence[Sequence[Sequence[Any]]] = ()
    """Tables that traces refer to."""
    warnings: Sequence[str] = ()


def to_html(page: Page) -> str:
    """The document. Titles, names and notes are escaped, and so are names in charts, where plotly.js knows tags."""
    asset = lambda name: resources.files("jaxba.bench").joinpath("assets", name).read_text(encoding="utf-8")
    charts = [
        {"id": f"chart{k}", "data": chart.traces, "layout": {"height": 340, **chart.layout}, "xaxes": chart.xaxes}
        for k, chart in enumerate(page.charts)
    ]
    book = _json({"axes": list(page.axes), "rows": page.rows, "charts": charts})
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


def line(style: Style, width: float = 2.0) -> dict[str, Any]:
    """`line` of a trace; `width` in pixels."""
    return {"color": style.color, "dash": dash(style), "width": width}


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


def charts(numbered: Iterable[tuple[int, Chart]]) -> str:
    """Charts side by side, as many as there is room for."""
    return (
        '<div class="grid">'
        + "\n".join(
            f'<figure><h3>{html.escape(chart.title)}</h3><div id="chart{k}"></div>'
            f"<figcaption>{html.escape(chart.note)}</figcaption></figure>"
            for k, chart in numbered
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
