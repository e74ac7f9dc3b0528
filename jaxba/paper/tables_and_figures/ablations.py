"""The ablation tables: agents and rules on the scenes of the tables and on BAL."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from jaxba.damping import Schedule
from jaxba.damping.features import DURATIONS
from jaxba.paper import agents, real_problems
from jaxba.paper.claims import Statement, order_claim, ratio_claim, success_claim
from jaxba.paper.config import PAPER_STATE
from jaxba.paper.results import average_schedule
from jaxba.paper.runner import Built, Method, Runner
from jaxba.paper.tables_and_figures.common import (
    CERES,
    CLASSIC,
    SCENES,
    Line,
    Part,
    Table,
    named,
    ours,
)
from jaxba.solver.options import SolveOptions

# iterations by state size. Source: the paper, table on BAL
STATE_SIZES = {1: 7.5, 5: 4.0, 10: 4.5, 20: 5.0}
AVERAGE = "schedule-of-our-agent"  # name of the schedule that `average_schedule` makes

OURS, CLOCK, REDUCTION, REVERSED = (
    one.name for one in (agents.OURS, agents.CLOCK, agents.REDUCTION, agents.REVERSED)
)


def _ablation(
    name: str,
    lines: Callable[[Runner], list[Line]],
    statements: Callable[[Runner], list[Statement]],
    values: Callable[[Runner], dict[str, Any]] = lambda _: {},
) -> Table:
    """The same lines and claims on the scenes of the tables and on BAL, after the paper's baseline
    and Ceres' rule, and before our agents. The tuned one is that with which each ablation is
    compared."""

    def parts(runner: Runner) -> list[Part]:
        every = [
            named("classic", CLASSIC, 20.0),
            named("Ceres' rule", CERES),
            *lines(runner),
            *ours(runner, 4.0),
        ]
        sets = SCENES, real_problems.bal(runner.config.real)
        return [Part(problems, every, statements(runner)) for problems in sets]

    return Table(name, parts, values)


def _sized(runner: Runner) -> list[Line]:
    others = [size for size in runner.config.agents.state_sizes if size != PAPER_STATE]
    sizes = {size: agents.with_state_size(size) for size in others}
    lines = [
        Line(f"ours, last {size} errors", runner.agent(agent)) for size, agent in sizes.items()
    ]
    return [
        x._replace(paper=STATE_SIZES.get(size, x.paper))
        for size, x in zip(sizes, lines, strict=True)
    ]


def _size_statements(runner: Runner) -> list[Statement]:
    others = [x for x in runner.config.agents.state_sizes if x in STATE_SIZES and x != PAPER_STATE]

    def numbers(size):
        return f"{STATE_SIZES[PAPER_STATE]:g} against {STATE_SIZES[size]:g}"

    text = "Five errors are better than {} ({{}})"

    def name(size):
        return agents.with_state_size(size).name

    best = name(PAPER_STATE)
    return [
        Statement(order_claim, text.format(size), numbers(size), best, name(size))
        for size in others
    ]


def _scheduled(runner: Runner) -> list[Line]:
    def build(*_: object) -> Built:
        agent = runner.agent(agents.OURS)
        runner.play(agent)  # the schedule is the average of its lambdas
        return Schedule(values=average_schedule(runner.first_dampings(agent))), SolveOptions()

    return [
        named("schedule, the paper's values", "schedule", 12.0),
        Line("schedule, averages of our agent", Method(AVERAGE, build), 12.0),
        named("Gauss-Newton: 1e-10 throughout", "gauss-newton"),
    ]


def _averages(runner: Runner) -> dict[str, Any]:
    known = runner.first_dampings(runner.agent(agents.OURS))
    return {
        "averages": ", ".join(f"{value:.3g}" for value in average_schedule(known))
        or "not known yet"
    }


TABLES = (
    _ablation(
        "zero-net",
        lambda runner: [Line("Zero-net", runner.zero_net(), 8.0)],
        lambda _: [
            Statement(
                order_claim, "The agent beats the Zero-net ({})", "4 against 8", OURS, "zero-net"
            ),
            Statement(
                ratio_claim,
                "The Zero-net takes two fifths of classic's iterations ({})",
                0.4,
                "zero-net",
                CLASSIC,
            ),
        ],
        lambda runner: {"net": runner.config.zero_net},
    ),
    _ablation("state-size", _sized, _size_statements),
    _ablation(
        "reversed",
        lambda runner: [Line("reversed: 5 durations, error", runner.agent(agents.REVERSED), 10.0)],
        lambda _: [
            Statement(
                order_claim, "Reversed roles accelerate less ({})", "4 against 10", OURS, REVERSED
            ),
            Statement(
                ratio_claim,
                "Reversed roles still halve classic's iterations ({})",
                0.5,
                REVERSED,
                CLASSIC,
            ),
            Statement(success_claim, "Reversed roles succeed less often ({})", 0.7, REVERSED),
            Statement(success_claim, "Our agent always succeeds ({})", 1.0, OURS),
        ],
    ),
    _ablation(
        "rewards",
        lambda runner: [
            Line("reward: minus the duration by the clock", runner.agent(agents.CLOCK), 4.0),
            Line("reward: nothing, bonus shrinking by 1 %", runner.agent(agents.REDUCTION), 4.2),
        ],
        lambda _: [
            Statement(
                order_claim,
                f"The duration is a better reward than {other} ({{}})",
                numbers,
                CLOCK,
                name,
            )
            for other, numbers, name in (
                ("a constant", "4 against 5", OURS),
                ("a shrinking bonus", "4 against 4.2", REDUCTION),
            )
        ],
        lambda _: {
            "count": len(DURATIONS),
            "least": min(DURATIONS),
            "most": max(DURATIONS),
            "seconds": agents.SECONDS,
        },
    ),
    _ablation(
        "schedule",
        _scheduled,
        lambda _: [
            Statement(
                order_claim,
                "The agent beats the paper's schedule ({})",
                "4 against 12",
                OURS,
                "schedule",
            ),
            Statement(
                order_claim,
                "The agent beats the schedule of its own averages ({})",
                "4 against 12",
                OURS,
                AVERAGE,
            ),
            Statement(
                ratio_claim,
                "The paper's schedule takes three fifths of classic's iterations ({})",
                0.6,
                "schedule",
                CLASSIC,
            ),
        ],
        _averages,
    ),
)
