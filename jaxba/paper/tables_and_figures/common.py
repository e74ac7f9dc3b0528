"""What the tables and figures share: their rows, tables of rows, and phrases."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from jaxba.bench.sources import Source
from jaxba.paper.markdown import Line, Section, lines_table
from jaxba.paper.rows import Row
from jaxba.paper.runner import Method, Runner, method_named

CLASSIC, CERES = "classic", "ceres"
"""Names of the rules that all tables have: the paper's baseline and Ceres' rule."""

NOT_YET = "Not run in this folder yet."
"""Text of the report if there are no results."""


@dataclass(frozen=True)
class TableOrFigure:
    """A table or figure of the paper."""

    name: str
    """Name for `--only`."""

    title: str
    """Description for `--list`."""

    run: Callable[[Runner], None]
    """Computes the results that are missing."""

    section: Callable[[Runner], Section]
    """Makes the section of the report from the results so far."""


class Labelled(NamedTuple):
    """A row before it is filled."""

    label: str
    method: Method
    paper: float | None = None
    """The paper's iterations."""
    paper_s: float | None = None
    """The paper's seconds."""


def named(label: str, solver: str, paper: float | None = None, paper_s: float | None = None) -> Labelled:
    """A row of a solver with a name of `jaxba-bench`."""
    return Labelled(label, method_named(solver), paper, paper_s)


def methods(rows: Sequence[Labelled]) -> list[Method]:
    """The methods of the rows."""
    return [row.method for row in rows]


class Lines(list[Line]):
    """Rows of a table with our numbers."""

    def __init__(self, runner: Runner, rows: Sequence[Labelled], sources: Sequence[Source] | None) -> None:
        """Fills rows from the results so far, on real problems or, if None, on the scenes of the tables."""
        pick = lambda method: runner.row_on_scenes(method) if sources is None else runner.row_on(sources, method)
        super().__init__(Line(one.label, pick(one.method), one.paper, one.paper_s) for one in rows)
        self.by_name = {line.row.method: line.row for line in self}

    def known(self, method: str) -> Row | None:
        """The row of a method, None if it was not run."""
        row = self.by_name.get(method)
        return row if row and row.solves else None

    @property
    def any(self) -> bool:
        """Whether any method was run."""
        return any(line.row.solves for line in self)

    def table(self, with_time: bool = False) -> str:
        """The table in Markdown, with ratios to classic and to Ceres' rule."""
        return lines_table(self, self.by_name.get(CLASSIC), self.by_name.get(CERES), with_time)


def problems(count: int) -> str:
    """`1 problem`, `2 problems` and so on."""
    return f"{count} problem{'' if count == 1 else 's'}"


def listed(sources: Sequence[Source]) -> str:
    """Names of problems."""
    return ", ".join(source.name for source in sources)
