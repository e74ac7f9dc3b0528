"""Code shared by the tables and figures, mostly by the ablation tables."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from jaxba.bench.sources import Source
from jaxba.paper import real_problems
from jaxba.paper.agents import OURS
from jaxba.paper.claims import Claim
from jaxba.paper.markdown import Line, Section, format_iterations, lines_table
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


def agent_lines(
    runner: Runner, methods: Sequence[tuple[str, Method, float | None]], sources: Sequence[Source] | None
) -> list[Line]:
    """Rows of an ablation table.

    Args:
        runner: the run.
        methods: label, method and the paper's iterations of each row.
        sources: real problems; None for the scenes of the tables.
    """
    pick = lambda method: runner.row_on_scenes(method) if sources is None else runner.row_on(sources, method)
    return [Line(label, pick(method), paper) for label, method, paper in methods]


def run_ablation(runner: Runner, methods: Sequence[tuple[str, Method, float | None]]) -> None:
    """Solves the scenes of the tables and the BAL problems with all methods."""
    for _, method, _ in methods:
        runner.play(method)
    runner.solve(real_problems.bal(runner.config.real), [method for _, method, _ in methods])


def claims_on_both_sets(
    runner: Runner,
    methods: Sequence[tuple[str, Method, float | None]],
    make_claims: Callable[[str, Callable[[str], Row | None]], list[Claim]],
) -> tuple[Claim, ...]:
    """The claims of an ablation table, on the scenes of the tables and on BAL.

    Args:
        runner: the run.
        methods: label, method and the paper's iterations of each row.
        make_claims: makes the claims on a set of problems. Its arguments are the name of the set, and a function that
            gives the row of a method by name (None if it was not run).
    """
    found = []
    for name, sources in (("synthetic", None), ("BAL", real_problems.bal(runner.config.real))):
        known = {line.row.method: line.row for line in agent_lines(runner, methods, sources) if line.row.solves}
        found += make_claims(name, known.get)
    return tuple(found)


def problems(count: int) -> str:
    """`1 problem`, `2 problems` and so on."""
    return f"{count} problem{'' if count == 1 else 's'}"


def gauss_newton_comparison(runner: Runner) -> str:
    """A sentence on the iterations of Gauss-Newton and of Ceres' rule on the scenes of the tables; empty if they were
    not run."""
    undamped, ceres = runner.row_on_scenes(method_named("gauss-newton")), runner.row_on_scenes(method_named(CERES))
    if not (undamped.solves and ceres.solves):
        return ""
    return (
        f"For scale: on these scenes Gauss-Newton (1e-10 throughout) takes {format_iterations(undamped.iterations)} "
        f"iterations and Ceres' rule {format_iterations(ceres.iterations)}, without any learning."
    )


def ablation_body(runner: Runner, methods: Sequence[tuple[str, Method, float | None]]) -> list[str]:
    """The tables of an ablation, on the scenes of the tables and on BAL."""
    body = []
    count = runner.number_of_scenes()
    lines = agent_lines(runner, methods, None)
    if any(line.row.solves for line in lines):
        body.append(
            f"**{count} synthetic scenes** of the kind that the agents train on, none of them seen in training:"
        )
        body.append(_table(lines))
        body.append(gauss_newton_comparison(runner))
    else:
        body.append(NOT_YET)
    reason = real_problems.reason_without_bal(runner.config.real)
    if reason:
        body.append(f"**BAL**: {reason}.")
        return body
    sources = real_problems.bal(runner.config.real)
    lines = agent_lines(runner, methods, sources)
    if any(line.row.solves for line in lines):
        body.append(f"**BAL**, {problems(len(sources))} ({', '.join(source.name for source in sources)}):")
        body.append(_table(lines))
    return body


def _table(lines: Sequence[Line]) -> str:
    rows = {line.row.method: line.row for line in lines}
    return lines_table(lines, rows.get(CLASSIC), rows.get(CERES))


def yardsticks() -> list[tuple[str, Method, float | None]]:
    """Rows of the paper's baseline and of Ceres' rule."""
    return [("classic", method_named(CLASSIC), 20.0), ("Ceres' rule", method_named(CERES), None)]


def ours(runner: Runner) -> tuple[str, Method, float | None]:
    """Row of the agent with which each ablation is compared."""
    return ("ours: 5 errors, -1 an iteration, bonus", runner.agent(OURS), 4.0)


AGENTS_DIFFER = "our agents train on synthetic scenes of 10 x 10, the paper's on BAL; the test set is another one."
"""Differences of the set-up of the ablations from the paper's."""
