"""Table: time as the state, error as the reward."""

from __future__ import annotations

import math
from collections.abc import Callable

from jaxba.paper import agents, claims
from jaxba.paper.markdown import Section, disagreements
from jaxba.paper.pieces import base
from jaxba.paper.pieces.base import Piece
from jaxba.paper.rows import Row
from jaxba.paper.workshop import Method, Workshop


def _methods(shop: Workshop) -> list[tuple[str, Method, float | None]]:
    return [*base.yardsticks(), base.ours(shop), ("reversed: 5 durations, error", shop.agent(agents.REVERSED), 10.0)]


def _work(shop: Workshop) -> None:
    base.ablation_work(shop, _methods(shop))


def _section(shop: Workshop) -> Section:
    methods = _methods(shop)

    def judge(where: str, row: Callable[[str], Row | None]) -> list[claims.Claim]:
        ours, turned = row(agents.OURS.name), row(agents.REVERSED.name)
        success = lambda one: one.success if one else math.nan
        half = f"Reversed roles still halve classic's iterations ({where})"
        return [
            claims.order_claim(f"Reversed roles accelerate less ({where})", "4 against 10", ours, turned),
            claims.ratio_claim(half, 0.5, turned, row(base.CLASSIC)),
            claims.share_claim(f"Reversed roles succeed less often ({where})", 0.7, success(turned)),
            claims.share_claim(f"Our agent always succeeds ({where})", 1.0, success(ours)),
        ]

    found = base.on_both(shop, methods, judge)
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
