"""Code shared by the tables of real problems."""

from __future__ import annotations

from collections.abc import Sequence

from jaxba.bench.sources import Source
from jaxba.paper.markdown import Line, format_iterations, lines_table, table
from jaxba.paper.runner import Method, Runner
from jaxba.paper.tables_and_figures import common

LabelledMethod = tuple[str, Method, float | None, float | None]
"""Label, method, and the paper's iterations and seconds."""


def real_lines(runner: Runner, methods: Sequence[LabelledMethod], sources: Sequence[Source]) -> list[Line]:
    """Rows of a table of real problems."""
    return [Line(label, runner.row_on(sources, method), its, seconds) for label, method, its, seconds in methods]


def real_tables(runner: Runner, methods: Sequence[LabelledMethod], sources: Sequence[Source]) -> list[str]:
    """A table of means over the problems, and a table of the iterations on each problem."""
    lines = real_lines(runner, methods, sources)
    rows = {line.row.method: line.row for line in lines}
    body = [lines_table(lines, rows.get(common.CLASSIC), rows.get(common.CERES), with_time=True)]
    header = ["iterations to convergence (✗: not within 100)", *(label for label, *_ in methods)]
    cells = []
    for source in sources:
        own = [runner.row_on([source], method) for _, method, _, _ in methods]
        cells.append([source.name, *(_cell(row.iterations, row.success, row.solves) for row in own)])
    return [*body, table(header, cells)]


def _cell(iterations: float, success: float, solves: int) -> str:
    if not solves:
        return "-"
    return (
        format_iterations(iterations)
        if success == 1
        else "✗"
        if success == 0
        else f"{format_iterations(iterations)} ({100 * success:.0f} %)"
    )
