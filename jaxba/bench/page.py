"""One HTML page with interactive charts and sortable tables that opens without a server and fetches
nothing.

It holds plotly.js: 4.8 MB. By its Content-Security-Policy it loads nothing but its own text and
pictures it makes."""

from __future__ import annotations

import html
import json
import math
import string
from collections.abc import Mapping, Sequence
from importlib import resources
from typing import Any

from jaxba.bench.charts import SYMBOLS, Chart, Style
from jaxba.bench.tables import Table

# characters that look like plotly's markers
MARKS: dict[str, str] = dict(zip(SYMBOLS, "●■◆▲▼✚★✖", strict=True))
DIGITS = 7  # significant digits of the numbers in a page


class Page:
    """A page, put together from top to bottom. Names, titles and notes are escaped, also in
    charts."""

    def __init__(
        self, title: str, facts: Mapping[str, str], styles: Mapping[str, Style], axes: Sequence[str]
    ) -> None:
        """`facts` are machine, versions and the like, on top; the value of `command` is set as
        code. `styles` are of what a reader can hide, `axes` the positions of the switch of the x
        axis."""
        self.title = title
        self.facts = facts
        self.styles = styles
        self.axes = axes
        self._charts: list[Chart] = []
        self._sections: list[str] = []

    def add(self, title: str, *parts: str) -> None:
        """Adds a section under a heading. The parts are HTML."""
        self._sections.append(
            f"<section><h2>{html.escape(title)}</h2>\n" + "\n".join(parts) + "</section>"
        )

    def charts(self, charts: Sequence[Chart]) -> str:
        """Charts side by side, as many as there is room for."""
        figures = []
        for one in charts:
            name = f"chart{len(self._charts)}"
            note = html.escape(one["note"])
            title = f'<h3>{html.escape(one["title"])}</h3><div id="{name}"></div>'
            figures.append(f"<figure>{title}<figcaption>{note}</figcaption></figure>")
            self._charts.append({**one, "id": name, "note": ""})
        return f'<div class="grid">{"".join(figures)}</div>'

    def add_table(self, content: Table) -> None:
        """Adds a table; a click on a column's head sorts. Rows of a solver or policy are marked by
        its style."""
        key = next(
            (i for i, name in enumerate(content.header) if name in ("solver", "policy")), None
        )
        kinds = [
            ' class="name"' if i < content.text_columns else "" for i in range(len(content.header))
        ]
        rows = []
        for cells in content.rows:
            name = None if key is None or cells[key] not in self.styles else cells[key]
            marked = "" if name is None else f' data-key="{html.escape(name)}"'
            inks = [
                swatch(self.styles[name]) if i == key and name is not None else ""
                for i in range(len(cells))
            ]
            parts = zip(kinds, inks, map(html.escape, cells), strict=True)
            row = "".join(f"<td{kind}>{ink}{cell}</td>" for kind, ink, cell in parts)
            rows.append(f"<tr{marked}>{row}</tr>")
        head = "".join(
            f"<th{kind}>{html.escape(c)}</th>"
            for kind, c in zip(kinds, content.header, strict=True)
        )
        body = "\n".join(rows)
        table = f"<table><thead><tr>{head}</tr></thead><tbody>\n{body}\n</tbody></table>"
        grid = f'<div class="scroll">{table}</div>'
        self.add(content.title, grid, note(content.note))

    def to_html(self, warnings: Sequence[str] = ()) -> str:
        """The document, with warnings on top."""

        def read(package, *path):
            return resources.files(package).joinpath(*path).read_text(encoding="utf-8")

        page, style, script = (
            read("jaxba.bench", "assets", f"page.{kind}") for kind in ("html", "css", "js")
        )
        facts = (
            f"<dt>{html.escape(x)}</dt><dd>{html.escape(y)}</dd>"
            for x, y in self.facts.items()
            if x != "command"
        )
        content = _plain({"axes": self.axes, "charts": self._charts})
        book = json.dumps(content, allow_nan=False, separators=(",", ":"), ensure_ascii=False)
        for character in "&<>":  # so that it may stand inside of a script element
            book = book.replace(character, f"\\u{ord(character):04x}")
        axes = (
            f'<button data-axis="{name}" aria-pressed="{str(k == 0).lower()}">over {name}</button>'
            for k, name in enumerate(self.axes)
        )
        chips = (
            f'<button class="chip" data-key="{html.escape(name)}" aria-pressed="true" '
            f'title="click: hide or show; double click: alone">'
            f"{swatch(style)}{html.escape(name)}</button>"
            for name, style in self.styles.items()
        )
        return string.Template(page).substitute(
            title=html.escape(self.title),
            style=style,
            script=script,
            plotly=read("plotly", "package_data", "plotly.min.js"),
            command=f"<pre>{html.escape(self.facts['command'])}</pre>"
            if "command" in self.facts
            else "",
            facts="".join(f"<div>{fact}</div>" for fact in facts),
            warnings="".join(f'<p class="warning">{html.escape(text)}</p>' for text in warnings),
            buttons="".join([*axes, *chips]),
            body="\n".join(self._sections),
            book=book,
        )


def _plain(value: Any) -> Any:
    """JSON of few digits; numbers that are not finite become null."""
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
    options = "".join(
        f'<option value="{k}">{html.escape(name)}</option>' for k, name in enumerate(parts)
    )
    blocks = "\n".join(
        f'<div data-group="{k}"{" hidden" if k else ""}>{part}</div>'
        for k, part in enumerate(parts.values())
    )
    choice = f'<label>{html.escape(label)} <select id="group">{options}</select></label>'
    return f"<p>{choice}</p>\n{blocks}"
