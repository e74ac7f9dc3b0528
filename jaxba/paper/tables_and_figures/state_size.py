"""Table: how many last errors the agent sees."""

from __future__ import annotations

from collections.abc import Callable

from jaxba.paper import agents, claims
from jaxba.paper.config import PAPER_STATE
from jaxba.paper.markdown import Section, disagreements
from jaxba.paper.pieces import base
from jaxba.paper.pieces.base import Piece
from jaxba.paper.rows import Row
from jaxba.paper.workshop import Method, Workshop

PAPER = {1: 7.5, 5: 4.0, 10: 4.5, 20: 5.0}
"""Iterations by state size. Source: the paper, table "Acceleration with different state sizes on BAL"."""


def _methods(shop: Workshop) -> list[tuple[str, Method, float | None]]:
    sized = [
        (f"ours, last {size} errors", shop.agent(agents.of_state(size)), PAPER.get(size))
        for size in shop.config.agents.state_sizes
    ]
    return [*base.yardsticks(), *sized]


def _work(shop: Workshop) -> None:
    base.ablation_work(shop, _methods(shop))


def _section(shop: Workshop) -> Section:
    methods = _methods(shop)

    def judge(where: str, row: Callable[[str], Row | None]) -> list[claims.Claim]:
        best, found = row(agents.of_state(PAPER_STATE).name), []
        for size in shop.config.agents.state_sizes:
            if size in PAPER and size != PAPER_STATE:
                numbers = f"{PAPER[PAPER_STATE]:g} against {PAPER[size]:g}"
                text = f"Five errors are better than {size} ({where})"
                found.append(claims.order_claim(text, numbers, best, row(agents.of_state(size).name)))
        return found

    found = base.on_both(shop, methods, judge)
    body = [
        "The paper calls the number of last errors in a state its batch size; its released code feeds one number per "
        "step "
        "and samples chunks of steps. We take the text's meaning: so many last errors are the observation.",
        *base.ablation_body(shop, methods),
        disagreements(found, base.AGENTS_DIFFER),
    ]
    return Section("State size", tuple(body), found)


PIECE = Piece("state-size", "Table: state size 1, 5, 10, 20", _work, _section)
