"""Tables of a summary, for the console or HTML."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from jaxba.bench import profile
from jaxba.bench.summary import Summary

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table as RichTable


@dataclass(frozen=True)
class Table:
    """A table of text cells: the first columns are aligned left, the others right."""

    title: str
    header: tuple[str, ...]
    rows: list[tuple[str, ...]]
    note: str  # explains the numbers in one or two sentences
    text_columns: int = 1  # number of columns that are aligned left


def number(value: float, digits: int = 3) -> str:
    """A number with `digits` significant digits, infinity as ∞, NaN as a dash."""
    if math.isnan(value):
        return "-"
    if math.isinf(value):
        return "∞"
    return f"{value:.0f}" if 10**digits <= abs(value) < 1e7 else f"{value:.{digits}g}"


def percentage(fraction: float) -> str:
    """A fraction as a percentage; a dash for NaN."""
    return "-" if math.isnan(fraction) else f"{100 * fraction:.0f} %"


def compact(summary: Summary) -> Table:
    """What is worth knowing of every solver, in 100 columns."""
    header = (
        "solver",
        "iterations\nto 0.1 %",
        "seconds\nto 0.1 %",
        "reached",
        "iterations\nto the end",
    )
    rows = []
    for s in summary.solvers:
        near = s.targets["relative_0.001"]
        end = s.targets["converged"]
        counts = [f"{one.reached}/{one.total}" for one in (near, end)]
        means = [number(x) for x in (near.iterations_capped, near.seconds, end.iterations_capped)]
        ends = counts[1], number(s.final_ratio_worst, 5), f"{s.compile_s:.1f}"
        rows.append((s.solver, *means[:2], counts[0], means[2], *ends))
    note = (
        "0.1 %: above the best cost that any solver reached. Geometric means over problems; a "
        "failure counts as "
        f"{profile.ITERATION_LIMIT} iterations, and not in the seconds. A program that several "
        "solvers or problems "
        "share is compiled for the first one."
    )
    return Table(
        "Solvers", (*header, "converged", "worst end\n/ best", "seconds of\ncompiling"), rows, note
    )


def reach_tables(summary: Summary) -> list[Table]:
    """Iterations, and seconds, to every tolerance."""
    targets = [target for target in summary.targets if target.kind != "converged"]
    header = ("solver", *(target.label for target in targets))
    iterations = []
    seconds = []
    for name, by_key in ((s.solver, s.targets) for s in summary.solvers):
        cells = [by_key[target.key] for target in targets]
        reached = [f"{cell.reached}/{cell.total}" for cell in cells]
        capped = [
            f"{number(c.iterations)} [{number(c.iterations_capped)}] {k}"
            for c, k in zip(cells, reached, strict=True)
        ]
        iterations.append((name, *capped))
        seconds.append(
            (name, *(f"{number(c.seconds)} {k}" for c, k in zip(cells, reached, strict=True)))
        )
    note = (
        "Geometric mean over the problems reached, k of n (k/n). f*: lowest accepted cost of any "
        "solver; "
        "τ: f* + τ(f0 - f*)."
    )
    capped_note = f" In brackets: over all n, with {profile.ITERATION_LIMIT} for those not reached."
    return [
        Table("Iterations to tolerance", header, iterations, note + capped_note),
        Table("Time to tolerance (s, without compilation)", header, seconds, note),
    ]


def details(summary: Summary) -> Table:
    """A row for each pair of problem and solver."""
    header = (
        "problem",
        "solver",
        "its to f*(1+0.001)",
        "converged",
        "rejected",
        "final cost",
        "final / best",
    )
    rows = []
    for c in summary.cells:
        reaches = [c.reach[key] for key in ("relative_0.001", "converged")]
        counts = [number(item.iterations) for item in reaches] + [number(c.rejected)]
        ends = [number(c.final_cost, 7), number(c.final_ratio, 6)]
        times = [number(reaches[0].seconds), number(c.seconds)]
        rows.append((c.problem, c.solver, *counts, *ends, *times, c.termination))
    note = (
        "Medians over repeats; ∞: never. Times in seconds, without compilation; time s is that "
        "of the whole solve."
    )
    return Table(
        "Problems",
        (*header, "s to f*(1+0.001)", "time s", "termination"),
        rows,
        note,
        text_columns=2,
    )


def print_summary(summary: Summary, console: Console) -> None:
    """Prints the compact table to a rich console, warnings first."""
    from rich.text import Text

    for warning in summary.warnings:
        console.print(Text(f"warning: {warning}", style="yellow"))
    console.print(to_rich(compact(summary)))


def to_rich(table: Table) -> RichTable:
    """The table for a rich console."""
    from rich.box import SIMPLE_HEAD
    from rich.table import Table as RichTable
    from rich.text import Text

    drawn = RichTable(
        title=Text(table.title),
        caption=Text(table.note),
        title_justify="left",
        caption_justify="left",
        box=SIMPLE_HEAD,
        padding=(0, 1, 0, 0),
    )
    for i, name in enumerate(table.header):
        drawn.add_column(
            Text(name), justify="left" if i < table.text_columns else "right", overflow="fold"
        )
    for row in table.rows:
        drawn.add_row(*(Text(cell) for cell in row))
    return drawn
