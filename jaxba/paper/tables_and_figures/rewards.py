"""Table: three rewards."""

from __future__ import annotations

from collections.abc import Callable

from jaxba.paper import agents, claims
from jaxba.paper.markdown import Section, disagreements
from jaxba.paper.rows import Row
from jaxba.paper.runner import Method, Runner
from jaxba.paper.tables_and_figures import common
from jaxba.paper.tables_and_figures.common import TableOrFigure


def _methods(runner: Runner) -> list[tuple[str, Method, float | None]]:
    return [
        *common.yardsticks(),
        ("reward: minus the duration; here a constant, -1", runner.agent(agents.OURS), 4.0),
        ("reward: nothing, bonus shrinking by 1 %", runner.agent(agents.REDUCTION), 4.2),
    ]


def _run(runner: Runner) -> None:
    common.run_ablation(runner, _methods(runner))


def _section(runner: Runner) -> Section:
    methods = _methods(runner)

    def make_claims(where: str, row: Callable[[str], Row | None]) -> list[claims.Claim]:
        text = f"The duration is a better reward than a shrinking bonus ({where})"
        return [claims.order_claim(text, "4 against 4.2", row(agents.OURS.name), row(agents.REDUCTION.name))]

    same = claims.Claim(
        "The duration is a better reward than a constant", "4 against 5", "the same reward in our game", "not run"
    )
    found = (same, *common.claims_on_both_sets(runner, methods, make_claims))
    body = (
        "In our compiled game the time of an iteration is deterministic, 1 for a plain step. **Duration and "
        "constant are then the same reward** and have one row (the paper: 4 and 5 iterations); the paper explains its "
        "difference by measured durations, which do not exist here. The bonus is 10 in all cases; the shrinking bonus "
        "loses 1 % of its first value in each iteration.",
        *common.ablation_body(runner, methods),
        disagreements(found, common.AGENTS_DIFFER),
    )
    return Section("Rewards", body, found)


ENTRY = TableOrFigure("rewards", "Table: rewards duration, constant, reduction", _run, _section)
