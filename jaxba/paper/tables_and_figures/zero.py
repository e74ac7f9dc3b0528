"""Table: the non-holistic Zero-net."""

from __future__ import annotations

from collections.abc import Callable

from jaxba.paper import agents, claims
from jaxba.paper.markdown import Section, disagreements
from jaxba.paper.pieces import base
from jaxba.paper.pieces.base import Piece
from jaxba.paper.rows import Row
from jaxba.paper.workshop import Method, Workshop


def _methods(shop: Workshop) -> list[tuple[str, Method, float | None]]:
    return [*base.yardsticks(), ("Zero-net", shop.zero_net(), 8.0), base.ours(shop)]


def _work(shop: Workshop) -> None:
    base.ablation_work(shop, _methods(shop))


def _section(shop: Workshop) -> Section:
    methods = _methods(shop)

    def judge(where: str, row: Callable[[str], Row | None]) -> list[claims.Claim]:
        part = f"The Zero-net takes two fifths of classic's iterations ({where})"
        return [
            claims.order_claim(
                f"The agent beats the Zero-net ({where})", "4 against 8", row(agents.OURS.name), row("zero-net")
            ),
            claims.ratio_claim(part, 0.4, row("zero-net"), row(base.CLASSIC)),
        ]

    found = base.on_both(shop, methods, judge)
    net = shop.config.zero_net
    body = (
        f"{net.layers} hidden layers of {net.width} see the last five errors, actions and rewards and are trained to "
        "minimise "
        f"the logarithm of the next error: {net.updates} updates of Adam ({net.learning_rate:g}), each with the "
        "gradient through "
        f"one `lm_step` on {net.batch} scenes. The cost of the *proposed* step counts, or a refused one would teach "
        "nothing. "
        "The paper leaves open optimiser, length and whether its layers include the output.",
        *base.ablation_body(shop, methods),
        disagreements(found, base.AGENTS_DIFFER),
    )
    return Section("Zero-net: the next error instead of the whole solve", body, found)


PIECE = Piece("zero-net", "Table: comparison with the non-holistic Zero-net", _work, _section)
