"""Table: constant schedules."""

from __future__ import annotations

from collections.abc import Callable

from jaxba.damping import Schedule
from jaxba.paper import agents, claims
from jaxba.paper.markdown import Section, disagreements
from jaxba.paper.pieces import base
from jaxba.paper.pieces.base import Piece
from jaxba.paper.rows import Row
from jaxba.paper.schedule import average_schedule
from jaxba.paper.workshop import Method, Workshop, named
from jaxba.solver.options import SolveOptions

AVERAGE = "schedule-of-our-agent"


def _methods(shop: Workshop) -> list[tuple[str, Method, float | None]]:
    def build(_: int) -> tuple[Schedule, SolveOptions]:
        return Schedule(values=_average(shop)), SolveOptions()

    return [
        *base.yardsticks(),
        ("schedule, the paper's values", named("schedule"), 12.0),
        ("schedule, averages of our agent", Method(AVERAGE, build), 12.0),
        ("Gauss-Newton: 1e-10 throughout", named("gauss-newton"), None),
        base.ours(shop),
    ]


def _average(shop: Workshop) -> tuple[float, ...]:
    return average_schedule(shop.first_dampings(shop.agent(agents.OURS)))


def _work(shop: Workshop) -> None:
    shop.play(shop.agent(agents.OURS))  # whose lambdas the schedule averages
    base.ablation_work(shop, _methods(shop))


def _section(shop: Workshop) -> Section:
    methods = _methods(shop)

    def judge(where: str, row: Callable[[str], Row | None]) -> list[claims.Claim]:
        ours = row(agents.OURS.name)
        own = f"The agent beats the schedule of its own averages ({where})"
        part = f"The paper's schedule takes three fifths of classic's iterations ({where})"
        return [
            claims.order_claim(
                f"The agent beats the paper's schedule ({where})", "4 against 12", ours, row("schedule")
            ),
            claims.order_claim(own, "4 against 12", ours, row(AVERAGE)),
            claims.ratio_claim(part, 0.6, row("schedule"), row(base.CLASSIC)),
        ]

    found = base.on_both(shop, methods, judge)
    known = shop.first_dampings(shop.agent(agents.OURS))
    values = ", ".join(f"{value:.3g}" for value in average_schedule(known)) if known else "not known yet"
    body = (
        "The paper repeats the first four lambdas of its agent, averaged over the test scenes: 1e-15, 1e-15, 0.194, "
        "0.551. "
        f"Ours, made the same way from the first training run on the synthetic test scenes: {values}. An arithmetic "
        "mean over "
        "decades is that of its largest members. Under diagonal damping 1e-15 is no damping at all.",
        *base.ablation_body(shop, methods),
        disagreements(found, base.AGENTS_DIFFER),
    )
    return Section("Constant schedules", body, found)


PIECE = Piece("schedule", "Table: constant schedules", _work, _section)
