"""Table: three rewards."""

from __future__ import annotations

from collections.abc import Callable

from jaxba.paper import agents, claims
from jaxba.paper.markdown import Section, disagreements
from jaxba.paper.pieces import base
from jaxba.paper.pieces.base import Piece
from jaxba.paper.rows import Row
from jaxba.paper.workshop import Method, Workshop


def _methods(shop: Workshop) -> list[tuple[str, Method, float | None]]:
    return [
        *base.yardsticks(),
        ("reward: minus the duration; here a constant, -1", shop.agent(agents.OURS), 4.0),
        ("reward: nothing, bonus shrinking by 1 %", shop.agent(agents.REDUCTION), 4.2),
    ]


def _work(shop: Workshop) -> None:
    base.ablation_work(shop, _methods(shop))


def _section(shop: Workshop) -> Section:
    methods = _methods(shop)

    def judge(where: str, row: Callable[[str], Row | None]) -> list[claims.Claim]:
        text = f"The duration is a better reward than a shrinking bonus ({where})"
        return [claims.order_claim(text, "4 against 4.2", row(agents.OURS.name), row(agents.REDUCTION.name))]

    same = claims.Claim(
        "The duration is a better reward than a constant", "4 against 5", "the same reward in our game", "not run"
    )
    found = (same, *base.on_both(shop, methods, judge))
    body = (
        "In a compiled game the time of an iteration is a deterministic cost, 1 for a plain step. **Duration and "
        "constant "
        "are then one reward**, so that they share a row (the paper: 4 and 5 iterations); the paper explains its "
        "difference by the measured durations, which cannot show here. Bonus 10 in all cases; the shrinking bonus "
        "loses "
        "1 % of its first value an iteration.",
        *base.ablation_body(shop, methods),
        disagreements(found, base.AGENTS_DIFFER),
    )
    return Section("Rewards", body, found)


PIECE = Piece("rewards", "Table: rewards duration, constant, reduction", _work, _section)
