"""Table: three rewards."""

from __future__ import annotations

from jaxba.paper import agents, claims
from jaxba.paper.markdown import Section, disagreements
from jaxba.paper.pieces import base
from jaxba.paper.pieces.base import Piece
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
    lines = base.agent_lines(shop, methods, None)
    row = lambda agent: (line := base.line_of(lines, agent.name)) and line.row
    found = (
        claims.Claim(
            "The duration is a better reward than a constant", "4 against 5", "the same reward in our game", "not run"
        ),
        claims.order_claim(
            "The duration is a better reward than a shrinking bonus",
            "4 against 4.2",
            row(agents.OURS),
            row(agents.REDUCTION),
        ),
    )
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
