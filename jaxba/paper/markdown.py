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
    """What a table or figure contributes to the report."""

    title: str
    """Heading."""

    body: tuple[str, ...]
    """Paragraphs, tables and images."""

    claims: tuple[Claim, ...] = field(default=())
    """The paper's claims that it is about."""


@dataclass(frozen=True)
class Line:
    """A row of a table with what the paper says."""

    label: str
    """For people."""

    row: Row
    """Ours."""

    paper: float | None = None
    """The paper's iterations."""

    paper_s: float | None = None
    """The paper's seconds."""


def plain(text: str) -> str:
    """A cell's text with Markdown's own signs disarmed; backticks stay."""
    return re.sub(r"([|<>*])", r"\\\1", " ".join(text.split()))


def table(header: Sequence[str], body: Sequence[Sequence[str]], text_columns: int = 1) -> str:
    """A Markdown table, the first columns to the left."""
    marks = [":--" if i < text_columns else "--:" for i in range(len(header))]
    lines = [header, marks, *([plain(cell) for cell in row] for row in body)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def counted(value: float | None) -> str:
    """Iterations for people."""
    return "-" if value is None or math.isnan(value) else f"{value:.1f}".removesuffix(".0")


def share(value: float) -> str:
    """A percentage."""
    return "-" if math.isnan(value) else f"{100 * value:.0f} %"


def spread(row: Row) -> str:
    """Number of training runs and the range of their means."""
    if not row.seeds:
        return "rule" if row.solves else "-"
    return f"{row.seeds}: {counted(row.low)} to {counted(row.high)}"


def lines_table(lines: Sequence[Line], classic: Row | None, ceres: Row | None, with_time: bool = False) -> str:
    """The table of a comparison.

    Args:
        lines: rows.
        classic: the paper's yardstick.
        ceres: the rule that people use.
        with_time: whether seconds were measured.
    """
    header = ["method", "paper", "ours", "seeds: range", "success", "to f\\*(1+1e-3)", "good ends"]
    header += ["of classic: paper", "ours", "of Ceres' rule"]
    header += ["paper s", "s"] if with_time else []
    paper_classic = next((line.paper for line in lines if classic and line.row.method == classic.method), None)
    body = []
    for line in lines:
        r = line.row
        paper_ratio = ratio(line.paper, paper_classic) if line.paper and paper_classic else math.nan
        cells = [line.label, counted(line.paper), counted(r.iterations), spread(r), share(r.success), counted(r.near)]
        cells += [share(r.good_ends), number(paper_ratio, 2)]
        cells += [number(ratio(r.iterations, base.iterations) if base else math.nan, 2) for base in (classic, ceres)]
        if with_time:
            cells += ["-" if line.paper_s is None else f"{line.paper_s:g}", number(r.seconds, 3)]
        body.append(cells)
    return table(header, body)


def claims_table(claims: Sequence[Claim]) -> str:
    """Claims one by one."""
    return table(
        ("claim", "paper", "ours", "verdict"), [(c.text, c.paper, c.ours, f"**{c.verdict}**") for c in claims], 1
    ).replace("\\*\\*", "**")


def disagreements(claims: Sequence[Claim], why: str) -> str:
    """One paragraph on the claims that are not fully reproduced, and what is known to differ; empty if there are none.

    Args:
        claims: of a section.
        why: differences of the set-up, stated as facts and not as proven causes.
    """
    off = [claim for claim in claims if claim.verdict in ("partly", "not")]
    if not off:
        return ""
    said = "; ".join(
        f"{c.text}: {'partly' if c.verdict == 'partly' else 'no'} (paper {c.paper}, ours {c.ours})" for c in off
    )
    return f"Where we disagree: {plain(said)}. What differs from the paper's set-up: {why}"
