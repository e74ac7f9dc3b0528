"""A table of the paper: methods on sets of problems, the claims that it tests, and its section of
the report."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from jaxba.bench.profile import ITERATION_LIMIT
from jaxba.bench.tables import number, percentage
from jaxba.paper.agents import BEST, OURS, PRINTED
from jaxba.paper.claims import Claim, Statement, judge
from jaxba.paper.real_problems import Problems
from jaxba.paper.results import Row
from jaxba.paper.runner import TEST, Method, Runner, method_named
from jaxba.solver.record import Record

# rules with which every table compares: the paper's baseline and Ceres'
CLASSIC = "classic"
CERES = "ceres"
# stands for the synthetic scenes, which are played and not solved one by one
SCENES = Problems("synthetic", ())
_SECTIONS = (
    Path(__file__).parents[1].joinpath("texts.md").read_text(encoding="utf-8").split("\n## ")[1:]
)
# what the report says of each table or figure: its title, its heading, and the paragraph below that
TEXTS = {
    name: (title, heading.removeprefix("### "), " ".join(text.split()))
    for head, heading, text in (section.split("\n\n", 2) for section in _SECTIONS)
    for name, _, title in [head.partition(": ")]
}

NOT_YET = "Not run in this folder yet."  # text of the report if there are no results


class Line(NamedTuple):
    """A method in a table, with the paper's iterations and seconds."""

    label: str
    method: Method
    paper: float = math.nan
    paper_s: float = math.nan


def named(label: str, solver: str, paper: float = math.nan, paper_s: float = math.nan) -> Line:
    """The line of a solver with a name of `jaxba-bench`."""
    return Line(label, method_named(solver), paper, paper_s)


def ours(
    runner: Runner, paper: float = math.nan, paper_s: float = math.nan, *, elsewhere: bool = False
) -> list[Line]:
    """The lines of every table: the paper's agent as printed and as tuned, which share their twin
    without learning, and the best agent for lambda alone with its twin; trained on synthetic
    scenes, or elsewhere: on real problems other than the one to solve."""
    made = runner.elsewhere if elsewhere else runner.agent
    return [
        Line("the paper's agent, as printed", made(PRINTED)),
        Line("ours: the paper's agent, tuned", made(OURS), paper, paper_s),
        Line("their twin: best constant lambda", made(OURS, twin=True)),
        Line("ours: scale-free state and guard", made(BEST), paper, paper_s),
        Line("its twin: best constant lambda", made(BEST, twin=True)),
    ]


def with_twin(
    label: str, made: Callable[..., Method], *of: str, paper: float, paper_s: float = math.nan
) -> list[Line]:
    """The lines of another solver that the best agent drives, and of its twin without learning."""
    line = Line(f"{label} + ours, scale-free state and guard", made(BEST, *of), paper, paper_s)
    return [line, Line(f"{label} + its twin", made(BEST, *of, twin=True))]


@dataclass(frozen=True)
class Part:
    """Methods on one set of problems."""

    problems: Problems  # the problems, or `SCENES`
    lines: Sequence[Line]
    statements: Sequence[Statement] = ()  # `{}` stands for the name of the problems
    more: Callable[[Runner], Iterable[Claim]] = lambda _: ()  # claims that rows do not tell
    repeats: int = 0  # repeats of each solve; as in the configuration if 0
    limit: int = ITERATION_LIMIT  # limit of linear solves
    each: bool = False  # whether a second table has the iterations on each problem

    def run(self, runner: Runner) -> None:
        """Computes the results that are missing."""
        methods = [line.method for line in self.lines]
        if self.problems is not SCENES:
            runner.solve(self.problems.sources, methods, self.limit, self.repeats)
            return
        for method in methods:
            runner.play(method)

    def rows(self, runner: Runner) -> dict[str, Row]:
        """By the name of a method, its row from the results so far, if there are any."""
        on = (
            runner.row_on_scenes
            if self.problems is SCENES
            else lambda m: runner.row_on(self.problems.sources, m)
        )
        found = (on(line.method) for line in self.lines)
        return {row.method: row for row in found if row.solves}

    def records(self, runner: Runner) -> list[Record]:
        """The solves so far, of the first training run of each method."""
        return runner.records_on(self.problems.sources, [line.method for line in self.lines])

    def shown(self, runner: Runner, rows: Mapping[str, Row]) -> list[str]:
        """Paragraphs and tables of the report."""
        problems = self.problems
        if problems.reason or not rows:
            return [f"**{problems.name}**: {f'{problems.reason}.' if problems.reason else NOT_YET}"]
        if problems is SCENES:
            count = max(
                (len(p.iterations) for p in runner.store.plays if p.scenes == TEST), default=0
            )
            title = (
                f"**{count} synthetic scenes** of the kind that the agents train on, none of "
                "them seen in training:"
            )
        else:
            names = [source.name for source in problems.sources]
            title = (
                f"**{problems.name}**, {len(names)} problem{'s' * (len(names) != 1)}: "
                f"{', '.join(names)}."
            )
            missing = ", ".join(f"`{name}`" for name in problems.missing)
            title += (
                f" In the configuration, but not on this machine: {missing}." if missing else ""
            )
        return [
            title,
            _comparison(self.lines, rows),
            *([self._per_problem(runner)] if self.each else []),
        ]

    def _per_problem(self, runner: Runner) -> str:
        header = [
            "iterations to convergence / to f\\*(1+1e-3); ✗: not within 100",
            *(x.label for x in self.lines),
        ]

        def cell(source, line):
            return _cell(runner.row_on([source], line.method))

        return table(
            header,
            [[s.name, *(cell(s, line) for line in self.lines)] for s in self.problems.sources],
        )


@dataclass(frozen=True)
class Table:
    """A table or figure of the paper."""

    name: str  # name for `--only`
    parts: Callable[[Runner], list[Part]]  # sets of problems with their methods and claims
    # that its paragraph in `texts.md` names
    values: Callable[[Runner], dict[str, Any]] = lambda _: {}

    @property
    def title(self) -> str:
        """Description for `--list`."""
        return TEXTS[self.name][0]

    @property
    def heading(self) -> str:
        """Of its section."""
        return TEXTS[self.name][1]

    def run(self, runner: Runner) -> None:
        """Computes the results that are missing."""
        for part in self.parts(runner):
            part.run(runner)

    def section(self, runner: Runner) -> tuple[list[str], list[Claim]]:
        """Paragraphs of the report from the results so far, and the claims."""
        body = [TEXTS[self.name][2].format_map(self.values(runner))]
        claims = []
        for part in self.parts(runner):
            rows = part.rows(runner)
            claims += [*judge(part.statements, rows.get, part.problems.name), *part.more(runner)]
            body += part.shown(runner, rows)
        return [f"## {self.heading}", *filter(None, body)], claims


def table(header: Sequence[str], body: Sequence[Sequence[str]]) -> str:
    """A Markdown table; the first column is aligned left, the others right."""
    marks = [":--", *["--:"] * (len(header) - 1)]

    def plain(cell):
        return re.sub(r"([|<>*])", r"\\\1", " ".join(cell.split()))

    lines = [header, marks, *([plain(cell) for cell in row] for row in body)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def format_iterations(value: float) -> str:
    """A number of iterations with at most one decimal; a dash for NaN."""
    return "-" if math.isnan(value) else f"{value:.1f}".removesuffix(".0")


def _cell(row: Row) -> str:
    if not row.solves:
        return "-"
    fraction = f" ({100 * row.success:.0f} %)" if 0 < row.success < 1 else ""
    end = "✗" if row.success == 0 else format_iterations(row.iterations)
    return (
        f"{end}{fraction} / {'✗' if row.near >= ITERATION_LIMIT else format_iterations(row.near)}"
    )


def _comparison(lines: Sequence[Line], rows: Mapping[str, Row]) -> str:
    """Every method beside the paper's numbers, and over classic and Ceres' rule; seconds where they
    were measured."""
    timed = any(math.isfinite(row.seconds) for row in rows.values())
    header = ["method", "paper", "ours", "seeds: range", "success", "to f\\*(1+1e-3)", "good ends"]
    header += ["of classic: paper", "ours", "of Ceres' rule", *(["paper s", "s"] if timed else [])]
    papers = next((line.paper for line in lines if line.method.name == CLASSIC), math.nan)

    def over(row, base):
        return row.iterations / rows[base].iterations if base in rows else math.nan

    body = []
    for line in lines:
        row = rows.get(line.method.name) or Row(
            line.method.name, *[math.nan] * 6, seeds=0, solves=0
        )
        spread = "rule" if row.solves else "-"
        if row.seeds:
            spread = f"{row.seeds}: {format_iterations(row.low)} to {format_iterations(row.high)}"
        label = f"{line.label} (collapsed)" if row.collapsed else line.label
        cells = [label, format_iterations(line.paper), format_iterations(row.iterations), spread]
        cells += [percentage(row.success), format_iterations(row.near), percentage(row.good_ends)]
        cells += [number(x, 2) for x in (line.paper / papers, over(row, CLASSIC), over(row, CERES))]
        cells += [number(line.paper_s, 4), number(row.seconds, 3)] if timed else []
        body.append(cells)
    return table(header, body)
