"""One HTML page with interactive charts and sortable tables that opens without a server and fetches nothing.

It holds plotly.js: 4.8 MB. It forbids its browser every address (Content-Security-Policy).
"""

from __future__ import annotations

import html
import json
import math
from collections.abc import Mapping, Sequence
from importlib import resources
from typing import Any

from jaxba.bench.charts import SYMBOLS, Chart, Style
from jaxba.bench.tables import Table

POLICY = "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data: blob:"
"""What the page may load: its own text, and pictures that it makes."""

MARKS: dict[str, str] = dict(zip(SYMBOLS, "●■◆▲▼✚★✖", strict=True))  # characters that look like plotly's markers
DIGITS = 7  # significant digits of the numbers in a page


class Page:
    """A page, put together from top to bottom. Names, titles and notes are escaped, also in charts."""

    def __init__(self, title: str, facts: Mapping[str, str], styles: Mapping[str, Style], axes: Sequence[str]) -> None:
        """`facts` are machine, versions and the like, on top; the value of `command` is set as code. `styles` are of
        what a reader can hide, `axes` the positions of the switch of the x axis."""
        self.title, self.facts, self.styles, self.axes = title, facts, styles, axes
        self._charts: list[Chart] = []
        self._sections: list[str] = []

    def add(self, title: str, *parts: str) -> None:
        """Adds a section under a heading. The parts are HTML."""
        self._sections.append(f"<section><h2>{html.escape(title)}</h2>\n" + "\n".join(parts) + "</section>")

    def charts(self, charts: Sequence[Chart]) -> str:
        """Charts side by side, as many as there is room for."""
        figures = []
        for one in charts:
            name, note = f"chart{len(self._charts)}", html.escape(one["note"])
            title = f'<h3>{html.escape(one["title"])}</h3><div id="{name}"></div>'
            figures.append(f"<figure>{title}<figcaption>{note}</figcaption></figure>")
            self._charts.append({**one, "id": name, "note": ""})
        return f'<div class="grid">{"".join(figures)}</div>'

    def add_table(self, content: Table) -> None:
        """Adds a table; a click on a column's head sorts. Rows of a solver or policy are marked by its style."""
        key = next((i for i, name in enumerate(content.header) if name in ("solver", "policy")), None)
        kinds = [' class="name"' if i < content.text_columns else "" for i in range(len(content.header))]
        rows = []
        for cells in content.rows:
            name = None if key is None or cells[key] not in self.styles else cells[key]
            marked = "" if name is None else f' data-key="{html.escape(name)}"'
            inks = [swatch(self.styles[name]) if i == key and name is not None else "" for i in range(len(cells))]
            parts = zip(kinds, inks, map(html.escape, cells), strict=True)
            rows.append(f"<tr{marked}>{''.join(f'<td{kind}>{ink}{cell}</td>' for kind, ink, cell in parts)}</tr>")
        head = "".join(f"<th{kind}>{html.escape(c)}</th>" for kind, c in zip(kinds, content.header, strict=True))
        body = "\n".join(rows)
        grid = f'<div class="scroll"><table><thead><tr>{head}</tr></thead><tbody>\n{body}\n</tbody></table></div>'
        self.add(content.title, grid, note(content.note))

    def to_html(self, warnings: Sequence[str] = ()) -> str:
        """The document, with warnings on top."""
        asset = lambda name: resources.files("jaxba.bench").joinpath("assets", name).read_text(encoding="utf-8")
        plotly = resources.files("plotly").joinpath("package_data", "plotly.min.js").read_text(encoding="utf-8")
        facts = "".join(
            f"<div><dt>{html.escape(name)}</dt><dd>{html.escape(value)}</dd></div>"
            for name, value in self.facts.items()
            if name != "command"
        )
        command = f"<pre>{html.escape(self.facts['command'])}</pre>" if "command" in self.facts else ""
        warned = "".join(f'<p class="warning">{html.escape(text)}</p>' for text in warnings)
        body, book = "\n".join(self._sections), _json({"axes": self.axes, "charts": self._charts})
        return (
            '<!DOCTYPE html>\n<html lang="en" data-theme="light"><head><meta charset="utf-8">'
            f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">'
            '<meta name="viewport" content="width=device-width, initial-scale=1">'
            f"<title>{html.escape(self.title)}</title><style>{asset('page.css')}</style></head>\n<body>"
            f'<h1>{html.escape(self.title)}</h1>\n{command}<dl class="facts">{facts}</dl>{warned}\n'
            '<noscript><p class="warning">The charts of this page need JavaScript.</p></noscript>\n'
            f"{self._toolbar()}\n{body}\n"
            f'<script type="application/json" id="book">{book}</script>\n'
            f"<script>{plotly}</script>\n<script>{asset('page.js')}</script>\n</body></html>\n"
        )

    def _toolbar(self) -> str:
        parts = ['<button id="theme" title="colours">dark</button>']
        parts += [
            f'<button data-axis="{name}" aria-pressed="{str(k == 0).lower()}">over {name}</button>'
            for k, name in enumerate(self.axes)
        ]
        parts += [
            f'<button class="chip" data-key="{html.escape(name)}" aria-pressed="true" title="click: hide or show; '
            f'double click: alone">{swatch(style)}{html.escape(name)}</button>'
            for name, style in self.styles.items()
        ]
        return f'<div class="bar">{"".join(parts)}</div>'


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


def swatch(style: Style) -> str:
    """A solver's marker in its colour."""
    ink = "" if style.color == "#000000" else f' style="color: {style.color}"'
    return f'<span class="swatch"{ink} data-mark="{MARKS[style.symbol]}" aria-hidden="true"></span>'


def note(text: str) -> str:
    """A paragraph in small type."""
    return f'<p class="note">{html.escape(text)}</p>' if text else ""


def groups(label: str, parts: Mapping[str, str]) -> str:
    """Parts of which one is shown, chosen by its name."""
    options = "".join(f'<option value="{k}">{html.escape(name)}</option>' for k, name in enumerate(parts))
    blocks = "\n".join(
        f'<div data-group="{k}"{" hidden" if k else ""}>{part}</div>' for k, part in enumerate(parts.values())
    )
    return f'<p><label>{html.escape(label)} <select id="group">{options}</select></label></p>\n{blocks}'
