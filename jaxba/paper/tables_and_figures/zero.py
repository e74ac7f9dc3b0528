"""Table: the Zero-net, which minimises the cost of the next step only."""

from __future__ import annotations

from collections.abc import Callable

from jaxba.paper import agents, claims
from jaxba.paper.markdown import Section, disagreements
from jaxba.paper.rows import Row
from jaxba.paper.runner import Method, Runner
from jaxba.paper.tables_and_figures import common
from jaxba.paper.tables_and_figures.common import TableOrFigure


def _methods(runner: Runner) -> list[tuple[str, Method, float | None]]:
    return [*common.yardsticks(), ("Zero-net", runner.zero_net(), 8.0), common.ours(runner)]


def _run(runner: Runner) -> None:
    common.run_ablation(runner, _methods(runner))


def _section(runner: Runner) -> Section:
    methods = _methods(runner)

    def make_claims(where: str, row: Callable[[str], Row | None]) -> list[claims.Claim]:
        ratio = f"The Zero-net takes two fifths of classic's iterations ({where})"
        return [
            claims.order_claim(
                f"The agent beats the Zero-net ({where})", "4 against 8", row(agents.OURS.name), row("zero-net")
            ),
            claims.ratio_claim(ratio, 0.4, row("zero-net"), row(common.CLASSIC)),
        ]

    found = common.claims_on_both_sets(runner, methods, make_claims)
    net = runner.config.zero_net
    body = (
        f"A network with {net.layers} hidden layers of {net.width} units observes the last five errors, actions and "
        "rewards. It is trained to minimise the logarithm of the next error: "
        f"{net.updates} updates of Adam ({net.learning_rate:g}), each with the gradient through one `lm_step` on "
        f"{net.batch} scenes. The error is that of the *proposed* step, since a rejected one would have no gradient. "
        "The paper does not give the optimiser, the number of updates, or whether its layers include the output.",
        *common.ablation_body(runner, methods),
        disagreements(found, common.AGENTS_DIFFER),
    )
    return Section("Zero-net: the next error instead of the whole solve", body, found)


ENTRY = TableOrFigure("zero-net", "Table: comparison with the non-holistic Zero-net", _run, _section)
