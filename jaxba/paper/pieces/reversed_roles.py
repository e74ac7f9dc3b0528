"""Table: time as the state, error as the reward."""

from __future__ import annotations

import math

from jaxba.paper import agents, claims
from jaxba.paper.markdown import Section, disagreements
from jaxba.paper.pieces import base
from jaxba.paper.pieces.base import Piece
from jaxba.paper.workshop import Method, Workshop


def _methods(shop: Workshop) -> list[tuple[str, Method, float | None]]:
    return [*base.yardsticks(), base.ours(shop), ("reversed: 5 durations, error", shop.agent(agents.REVERSED), 10.0)]


def _work(shop: Workshop) -> None:
    base.ablation_work(shop, _methods(shop))


def _section(shop: Workshop) -> Section:
    methods = _methods(shop)
    lines = base.agent_lines(shop, methods, None)
    ours, turned, classic = (
        base.line_of(lines, name) for name in (agents.OURS.name, agents.REVERSED.name, base.CLASSIC)
    )
    found = (
        claims.order_claim("Reversed roles accelerate less", "4 against 10", ours and ours.row, turned and turned.row),
        claims.ratio_claim(
            "Reversed roles still halve classic's iterations", 0.5, turned and turned.row, classic and classic.row
        ),
        claims.share_claim("Reversed roles succeed less often", 0.7, turned.row.success if turned else math.nan),
        claims.share_claim("Our agent always succeeds", 1.0, ours.row.success if ours else math.nan),
    )
    body = (
        "Read as: the state is minus the time of each of the last five iterations, which our deterministic clock "
        "makes 1, "
        "so that this agent sees how many iterations have gone by and nothing else; the reward is minus the "
        "logarithm of the "
        "error over the best known one, with the same bonus.",
        *base.ablation_body(shop, methods),
        disagreements(found, base.AGENTS_DIFFER),
    )
    return Section("Reversed roles", body, found)


PIECE = Piece("reversed", "Table: reversed roles of state and reward", _work, _section)
