"""Table: constant schedules."""

from __future__ import annotations

from collections.abc import Callable

from jaxba.damping import Schedule
from jaxba.paper import agents, claims
from jaxba.paper.markdown import Section, disagreements
from jaxba.paper.rows import Row
from jaxba.paper.runner import Method, Runner, method_named
from jaxba.paper.schedule import average_schedule
from jaxba.paper.tables_and_figures import common
from jaxba.paper.tables_and_figures.common import TableOrFigure
from jaxba.solver.options import SolveOptions

AVERAGE = "schedule-of-our-agent"


def _methods(runner: Runner) -> list[tuple[str, Method, float | None]]:
    def build(_: int) -> tuple[Schedule, SolveOptions]:
        return Schedule(values=_average(runner)), SolveOptions()

    return [
        *common.yardsticks(),
        ("schedule, the paper's values", method_named("schedule"), 12.0),
        ("schedule, averages of our agent", Method(AVERAGE, build), 12.0),
        ("Gauss-Newton: 1e-10 throughout", method_named("gauss-newton"), None),
        common.ours(runner),
    ]


def _average(runner: Runner) -> tuple[float, ...]:
    return average_schedule(runner.first_dampings(runner.agent(agents.OURS)))


def _run(runner: Runner) -> None:
    runner.play(runner.agent(agents.OURS))  # the schedule is the average of its lambdas
    common.run_ablation(runner, _methods(runner))


def _section(runner: Runner) -> Section:
    methods = _methods(runner)

    def make_claims(where: str, row: Callable[[str], Row | None]) -> list[claims.Claim]:
        ours = row(agents.OURS.name)
        own = f"The agent beats the schedule of its own averages ({where})"
        ratio = f"The paper's schedule takes three fifths of classic's iterations ({where})"
        return [
            claims.order_claim(
                f"The agent beats the paper's schedule ({where})", "4 against 12", ours, row("schedule")
            ),
            claims.order_claim(own, "4 against 12", ours, row(AVERAGE)),
            claims.ratio_claim(ratio, 0.6, row("schedule"), row(common.CLASSIC)),
        ]

    found = common.claims_on_both_sets(runner, methods, make_claims)
    known = runner.first_dampings(runner.agent(agents.OURS))
    values = ", ".join(f"{value:.3g}" for value in average_schedule(known)) if known else "not known yet"
    body = (
        "The paper repeats the first four lambdas of its agent, averaged over the test scenes: 1e-15, 1e-15, 0.194, "
        "0.551. The same averages of our first training run on the synthetic test scenes are: "
        f"{values}. The largest lambdas dominate an arithmetic mean over several decades. With diagonal damping, 1e-15 "
        "is no damping at all.",
        *common.ablation_body(runner, methods),
        disagreements(found, common.AGENTS_DIFFER),
    )
    return Section("Constant schedules", body, found)


ENTRY = TableOrFigure("schedule", "Table: constant schedules", _run, _section)
