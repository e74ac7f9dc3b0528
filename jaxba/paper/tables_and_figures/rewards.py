"""Table: three rewards."""

from __future__ import annotations

from collections.abc import Callable

from jaxba.damping.clock import DURATIONS
from jaxba.paper import agents, claims
from jaxba.paper.markdown import Section, disagreements
from jaxba.paper.rows import Row
from jaxba.paper.runner import Method, Runner
from jaxba.paper.tables_and_figures import common
from jaxba.paper.tables_and_figures.common import TableOrFigure


def _methods(runner: Runner) -> list[tuple[str, Method, float | None]]:
    return [
        *common.yardsticks(),
        ("reward: minus the duration by the clock", runner.agent(agents.CLOCK), 4.0),
        ("reward: -1", runner.agent(agents.OURS), 5.0),
        ("reward: nothing, bonus shrinking by 1 %", runner.agent(agents.REDUCTION), 4.2),
    ]


def _run(runner: Runner) -> None:
    common.run_ablation(runner, _methods(runner))


def _section(runner: Runner) -> Section:
    methods = _methods(runner)

    def make_claims(where: str, row: Callable[[str], Row | None]) -> list[claims.Claim]:
        clock = row(agents.CLOCK.name)
        text = lambda other: f"The duration is a better reward than {other} ({where})"
        return [
            claims.order_claim(text("a constant"), "4 against 5", clock, row(agents.OURS.name)),
            claims.order_claim(text("a shrinking bonus"), "4 against 4.2", clock, row(agents.REDUCTION.name)),
        ]

    found = common.claims_on_both_sets(runner, methods, make_claims)
    body = (
        "An iteration of the compiled game has no duration of its own. The clock gives it one of "
        f"{len(DURATIONS)} quantiles of measured durations, {min(DURATIONS):g} to {max(DURATIONS):g} of their mean "
        f"(`jaxba/damping/clock.py`), and the mean is the paper's on BAL, {agents.SECONDS:g} s, against a bonus of 10. "
        "The agent of the other ablations has the constant reward. The shrinking bonus loses 1 % of its first value in "
        "each iteration.",
        *common.ablation_body(runner, methods),
        disagreements(found, common.AGENTS_DIFFER),
    )
    return Section("Rewards", body, found)


ENTRY = TableOrFigure("rewards", "Table: rewards duration, constant, reduction", _run, _section)
