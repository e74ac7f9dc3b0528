"""Table: reversed roles, with the time as the state and the error as the reward."""

from __future__ import annotations

import math
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
        common.ours(runner),
        ("reversed: 5 durations, error", runner.agent(agents.REVERSED), 10.0),
    ]


def _run(runner: Runner) -> None:
    common.run_ablation(runner, _methods(runner))


def _section(runner: Runner) -> Section:
    methods = _methods(runner)

    def make_claims(where: str, row: Callable[[str], Row | None]) -> list[claims.Claim]:
        ours, turned = row(agents.OURS.name), row(agents.REVERSED.name)
        success = lambda one: one.success if one else math.nan
        half = f"Reversed roles still halve classic's iterations ({where})"
        return [
            claims.order_claim(f"Reversed roles accelerate less ({where})", "4 against 10", ours, turned),
            claims.ratio_claim(half, 0.5, turned, row(common.CLASSIC)),
            claims.fraction_claim(f"Reversed roles succeed less often ({where})", 0.7, success(turned)),
            claims.fraction_claim(f"Our agent always succeeds ({where})", 1.0, success(ours)),
        ]

    found = common.claims_on_both_sets(runner, methods, make_claims)
    body = (
        "Interpreted as: the state is minus the time of each of the last five iterations, by the clock of the section "
        "on rewards. The reward is minus the logarithm of the error over the best known one, with the same bonus.",
        *common.ablation_body(runner, methods),
        disagreements(found, common.AGENTS_DIFFER),
    )
    return Section("Reversed roles", body, found)


ENTRY = TableOrFigure("reversed", "Table: reversed roles of state and reward", _run, _section)
