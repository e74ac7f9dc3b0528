"""What the tables of real problems have in common."""

from __future__ import annotations

from collections.abc import Sequence

from jaxba.bench.sources import Source
from jaxba.paper.markdown import Line, counted, lines_table, table
from jaxba.paper.pieces import base
from jaxba.paper.workshop import Method, Workshop

Named = tuple[str, Method, float | None, float | None]
"""Label, method, the paper's iterations and seconds."""


def real_lines(shop: Workshop, methods: Sequence[Named], sources: Sequence[Source]) -> list[Line]:
    """Rows of a comparison on real problems."""
    return [Line(label, shop.row_on(sources, method), its, seconds) for label, method, its, seconds in methods]


def real_tables(shop: Workshop, methods: Sequence[Named], sources: Sequence[Source]) -> list[str]:
    """Means over the problems, then each problem."""
    lines = real_lines(shop, methods, sources)
    rows = {line.row.method: line.row for line in lines}
    body = [lines_table(lines, rows.get(base.CLASSIC), rows.get(base.CERES), with_time=True)]
    header = ["iterations to convergence (✗: not within 100)", *(label for label, *_ in methods)]
    cells = []
    for source in sources:
        own = [shop.row_on([source], method) for _, method, _, _ in methods]
        cells.append([source.name, *(_cell(row.iterations, row.success, row.solves) for row in own)])
    return [*body, table(header, cells)]


def _cell(iterations: float, success: float, solves: int) -> str:
    if not solves:
        return "-"
    return (
        counted(iterations)
        if success == 1
        else "✗"
        if success == 0
        else f"{counted(iterations)} ({100 * success:.0f} %)"
    )
