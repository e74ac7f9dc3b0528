"""Sections of the report as Markdown."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field

from jaxba.bench.tables import number
from jaxba.paper.claims import Claim
from jaxba.paper.rows import Row, ratio


@dataclass(frozen=True)
class Section:
    """Section of the report for a table or figure."""

    title: str
    """Heading."""

    body: tuple[str, ...]
    """Paragraphs, tables and images."""

    claims: tuple[Claim, ...] = field(default=())
    """The paper's claims that it tests."""


@dataclass(frozen=True)
class Line:
    """A row of a table with the paper's numbers."""

    label: str
    """First cell of the row."""

    row: Row
    """Our numbers."""

    paper: float | None = None
    """The paper's iterations."""

    paper_s: float | None = None
    """The paper's seconds."""


def plain(text: str) -> str:
    """Text of a cell with Markdown's special characters escaped, except backticks."""
    return re.sub(r"([|<>*])", r"\\\1", " ".join(text.split()))


def table(header: Sequence[str], body: Sequence[Sequence[str]], text_columns: int = 1) -> str:
    """A Markdown table; the first `text_columns` are aligned left, the others right."""
    marks = [":--" if i < text_columns else "--:" for i in range(len(header))]
    lines = [header, marks, *([plain(cell) for cell in row] for row in body)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def format_iterations(value: float | None) -> str:
    """A number of iterations with at most one decimal; a dash for None and NaN."""
    return "-" if value is None or math.isnan(value) else f"{value:.1f}".removesuffix(".0")


def percentage(value: float) -> str:
    """A fraction as a percentage; a dash for NaN."""
    return "-" if math.isnan(value) else f"{100 * value:.0f} %"


def spread(row: Row) -> str:
    """Number of training runs and the range of their means."""
    if not row.seeds:
        return "rule" if row.solves else "-"
    return f"{row.seeds}: {format_iterations(row.low)} to {format_iterations(row.high)}"


def lines_table(lines: Sequence[Line], classic: Row | None, ceres: Row | None, with_time: bool = False) -> str:
    """The table of a comparison of methods.

    Args:
        lines: rows.
        classic: row of the paper's baseline, for the ratios.
        ceres: row of Ceres' rule, for the ratios.
        with_time: whether to add columns of the time.
    """
    header = ["method", "paper", "ours", "seeds: range", "success", "to f\\*(1+1e-3)", "good ends"]
    header += ["of classic: paper", "ours", "of Ceres' rule"]
    header += ["paper s", "s"] if with_time else []
    paper_classic = next((line.paper for line in lines if classic and line.row.method == classic.method), None)
    body = []
    for line in lines:
        r = line.row
        paper_ratio = ratio(line.paper, paper_classic) if line.paper and paper_classic else math.nan
        cells = [
            line.label,
            format_iterations(line.paper),
            format_iterations(r.iterations),
            spread(r),
            percentage(r.success),
            format_iterations(r.near),
        ]
        cells += [percentage(r.good_ends), number(paper_ratio, 2)]
        cells += [number(ratio(r.iterations, base.iterations) if base else math.nan, 2) for base in (classic, ceres)]
        if with_time:
            cells += ["-" if line.paper_s is None else f"{line.paper_s:g}", number(r.seconds, 3)]
        body.append(cells)
    return table(header, body)


def claims_table(claims: Sequence[Claim]) -> str:
    """The table of all claims."""
    return table(
        ("claim", "paper", "ours", "to f\\*(1+1e-3)", "result"),
        [(c.text, c.paper, c.ours, c.near, f"**{c.status}**") for c in claims],
    ).replace("\\*\\*", "**")


def disagreements(claims: Sequence[Claim], why: str) -> str:
    """A paragraph on the claims that are not fully reproduced, and on differences of the set-up; empty if all are.

    Args:
        claims: claims of a section.
        why: known differences from the paper's set-up, which may or may not be the reason.
    """
    off = [claim for claim in claims if claim.status in ("partly", "not")]
    if not off:
        return ""
    listed = "; ".join(
        f"{c.text}: {'partly' if c.status == 'partly' else 'no'} (paper {c.paper}, ours {c.ours})" for c in off
    )
    return f"Where we disagree: {plain(listed)}. What differs from the paper's set-up: {why}"
