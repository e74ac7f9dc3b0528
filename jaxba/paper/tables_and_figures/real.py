"""Code shared by the tables of real problems."""

from __future__ import annotations

from collections.abc import Sequence

from jaxba.bench.profile import ITERATION_LIMIT
from jaxba.bench.sources import Source
from jaxba.paper.agents import updates
from jaxba.paper.markdown import Line, format_iterations, lines_table, table
from jaxba.paper.real_problems import label, training_files
from jaxba.paper.rows import Row
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
    header = ["iterations to convergence / to f\\*(1+1e-3); ✗: not within 100", *(label for label, *_ in methods)]
    cells = []
    for source in sources:
        own = [runner.row_on([source], method) for _, method, _, _ in methods]
        cells.append([source.name, *map(_cell, own)])
    return [*body, table(header, cells)]


def _cell(row: Row) -> str:
    if not row.solves:
        return "-"
    fraction = f" ({100 * row.success:.0f} %)" if 0 < row.success < 1 else ""
    end = "✗" if row.success == 0 else format_iterations(row.iterations)
    return f"{end}{fraction} / {'✗' if row.near >= ITERATION_LIMIT else format_iterations(row.near)}"


def trained_elsewhere(runner: Runner, sources: Sequence[Source]) -> str:
    """A sentence on what the agents of a table were trained on."""
    pairs = {training_files(runner.config.real, source) for source in sources}
    parts = [
        f"without {name} on windows of {', '.join(label(path) for path in files)}"
        for name, files in sorted(pairs)
        if files
    ]
    if not parts:
        return "There is no other problem of this data set on this machine to train an agent on."
    return (
        "The agents of this table are trained on windows of up to 10 cameras and 40 points, poses and points unknown, "
        f"for {updates(runner.config)} updates with the reward by the clock (section on rewards), and judged on "
        f"problems that the windows are not of: {'; '.join(parts)}."
    )
