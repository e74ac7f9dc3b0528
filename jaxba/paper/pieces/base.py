"""What tables and figures have in common."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from jaxba.bench.sources import Source
from jaxba.paper import places
from jaxba.paper.agents import OURS
from jaxba.paper.markdown import Line, Section, lines_table
from jaxba.paper.workshop import Method, Workshop, named

CLASSIC, CERES, LEARNED, PLAIN = "classic", "ceres", "learned", "learned+refine0"
"""Names of the rows that most tables have; `PLAIN` is lambda alone, the paper's own comparison."""

NOT_YET = "Not run in this folder yet."


@dataclass(frozen=True)
class Piece:
    """A table or figure of the paper."""

    name: str
    """For `--only`."""

    title: str
    """Heading in the report, and the line of `--list`."""

    work: Callable[[Workshop], None]
    """Does what is missing."""

    section: Callable[[Workshop], Section]
    """Its part of the report, from what is there."""


def agent_lines(
    shop: Workshop, methods: Sequence[tuple[str, Method, float | None]], sources: Sequence[Source] | None
) -> list[Line]:
    """Rows of an ablation.

    Args:
        shop: of the run.
        methods: label, method and the paper's iterations.
        sources: real problems; None for the tables' own scenes.
    """
    pick = lambda method: shop.row_on_scenes(method) if sources is None else shop.row_on(sources, method)
    return [Line(label, pick(method), paper) for label, method, paper in methods]


def line_of(lines: Sequence[Line], method: str) -> Line | None:
    """The row of a method, where it was run."""
    return next((line for line in lines if line.row.method == method and line.row.solves), None)


def ablation_work(shop: Workshop, methods: Sequence[tuple[str, Method, float | None]]) -> None:
    """Plays all methods on the tables' own scenes and solves the problems of BAL with them."""
    for _, method, _ in methods:
        shop.play(method)
    shop.solve(places.bal(shop.config.real), [method for _, method, _ in methods])


def ablation_body(shop: Workshop, methods: Sequence[tuple[str, Method, float | None]]) -> list[str]:
    """Both tables of an ablation."""
    body = []
    count = shop.scenes_known()
    lines = agent_lines(shop, methods, None)
    if any(line.row.solves for line in lines):
        body.append(
            f"**{count} synthetic scenes** of the kind that the agents train on, none of them seen in training:"
        )
        body.append(_table(lines))
    else:
        body.append(NOT_YET)
    reason = places.why_no_bal(shop.config.real)
    if reason:
        body.append(f"**BAL**: {reason}.")
        return body
    sources = places.bal(shop.config.real)
    lines = agent_lines(shop, methods, sources)
    if any(line.row.solves for line in lines):
        body.append(f"**BAL**, {len(sources)} problems ({', '.join(source.name for source in sources)}):")
        body.append(_table(lines))
    return body


def _table(lines: Sequence[Line]) -> str:
    rows = {line.row.method: line.row for line in lines}
    return lines_table(lines, rows.get(CLASSIC), rows.get(CERES))


def yardsticks() -> list[tuple[str, Method, float | None]]:
    """The paper's yardstick and the rule that people use."""
    return [("classic", named(CLASSIC), 20.0), ("Ceres' rule", named(CERES), None)]


def ours(shop: Workshop) -> tuple[str, Method, float | None]:
    """The agent that every ablation is compared with."""
    return ("ours: 5 errors, duration, bonus", shop.agent(OURS), 4.0)


AGENTS_DIFFER = (
    "our agents train on synthetic scenes of 10 x 10 only, the paper's on BAL; the time of an iteration is a "
    "constant in our "
    "game and a measured one in the paper; the test set is another one."
)
