"""What tables and figures have in common."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from jaxba.bench.sources import Source
from jaxba.paper import places
from jaxba.paper.agents import OURS
from jaxba.paper.claims import Claim
from jaxba.paper.markdown import Line, Section, counted, lines_table
from jaxba.paper.rows import Row
from jaxba.paper.workshop import Method, Workshop, named

CLASSIC, CERES, LEARNED, PLAIN = "classic", "ceres", "learned", "learned-driver"
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


def ablation_work(shop: Workshop, methods: Sequence[tuple[str, Method, float | None]]) -> None:
    """Plays all methods on the tables' own scenes and solves the problems of BAL with them."""
    for _, method, _ in methods:
        shop.play(method)
    shop.solve(places.bal(shop.config.real), [method for _, method, _ in methods])


def on_both(
    shop: Workshop,
    methods: Sequence[tuple[str, Method, float | None]],
    judge: Callable[[str, Callable[[str], Row | None]], list[Claim]],
) -> tuple[Claim, ...]:
    """The claims of an ablation on the tables' own scenes, and on BAL.

    Args:
        shop: of the run.
        methods: rows of the ablation.
        judge: given the name of the set of problems and the rows by method (None where it was not run).
    """
    found = []
    for name, sources in (("synthetic", None), ("BAL", places.bal(shop.config.real))):
        known = {line.row.method: line.row for line in agent_lines(shop, methods, sources) if line.row.solves}
        found += judge(name, known.get)
    return tuple(found)


def problems(count: int) -> str:
    """A number of problems in words."""
    return f"{count} problem{'' if count == 1 else 's'}"


def headroom(shop: Workshop) -> str:
    """What next to no damping needs on the tables' own scenes, where that was run."""
    bold, ceres = shop.row_on_scenes(named("gauss-newton")), shop.row_on_scenes(named(CERES))
    if not (bold.solves and ceres.solves):
        return ""
    return (
        f"For scale: on these scenes Gauss-Newton (1e-10 throughout) takes {counted(bold.iterations)} iterations and "
        f"Ceres' rule {counted(ceres.iterations)}, without having learned anything."
    )


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
        body.append(headroom(shop))
    else:
        body.append(NOT_YET)
    reason = places.why_no_bal(shop.config.real)
    if reason:
        body.append(f"**BAL**: {reason}.")
        return body
    sources = places.bal(shop.config.real)
    lines = agent_lines(shop, methods, sources)
    if any(line.row.solves for line in lines):
        body.append(f"**BAL**, {problems(len(sources))} ({', '.join(source.name for source in sources)}):")
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
