"""Table: the number of last errors that the agent observes."""

from __future__ import annotations

from collections.abc import Callable

from jaxba.paper import agents, claims
from jaxba.paper.config import PAPER_STATE
from jaxba.paper.markdown import Section, disagreements
from jaxba.paper.rows import Row
from jaxba.paper.runner import Method, Runner
from jaxba.paper.tables_and_figures import common
from jaxba.paper.tables_and_figures.common import TableOrFigure

PAPER = {1: 7.5, 5: 4.0, 10: 4.5, 20: 5.0}
"""Iterations by state size. Source: the paper, table "Acceleration with different state sizes on BAL"."""


def _methods(runner: Runner) -> list[tuple[str, Method, float | None]]:
    sized = [
        (f"ours, last {size} errors", runner.agent(agents.with_state_size(size)), PAPER.get(size))
        for size in runner.config.agents.state_sizes
    ]
    return [*common.yardsticks(), *sized]


def _run(runner: Runner) -> None:
    common.run_ablation(runner, _methods(runner))


def _section(runner: Runner) -> Section:
    methods = _methods(runner)

    def make_claims(where: str, row: Callable[[str], Row | None]) -> list[claims.Claim]:
        best, found = row(agents.with_state_size(PAPER_STATE).name), []
        for size in runner.config.agents.state_sizes:
            if size in PAPER and size != PAPER_STATE:
                numbers = f"{PAPER[PAPER_STATE]:g} against {PAPER[size]:g}"
                text = f"Five errors are better than {size} ({where})"
                found.append(claims.order_claim(text, numbers, best, row(agents.with_state_size(size).name)))
        return found

    found = common.claims_on_both_sets(runner, methods, make_claims)
    body = [
        "The paper calls the number of last errors in a state its batch size; its released code feeds one number per "
        "step and samples chunks of steps. Here the observation is that many last errors, as the text says.",
        *common.ablation_body(runner, methods),
        disagreements(found, common.AGENTS_DIFFER),
    ]
    return Section("State size", tuple(body), found)


ENTRY = TableOrFigure("state-size", "Table: state size 1, 5, 10, 20", _run, _section)
