"""The ablation tables: agents and rules on the scenes of the tables and on BAL."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from jaxba.damping import Schedule
from jaxba.damping.features import DURATIONS
from jaxba.paper import agents, real_problems
from jaxba.paper.claims import Statement, judge, order_claim, ratio_claim, success_claim
from jaxba.paper.config import PAPER_STATE
from jaxba.paper.markdown import Section, disagreements, format_iterations
from jaxba.paper.runner import Method, Runner, method_named
from jaxba.paper.schedule import average_schedule
from jaxba.paper.tables_and_figures import common
from jaxba.paper.tables_and_figures.common import CERES, CLASSIC, Labelled, Lines, TableOrFigure, named
from jaxba.solver.options import SolveOptions

WHY = "our agents train on synthetic scenes of 10 x 10, the paper's on BAL; the test set is another one."
"""Differences of the set-up from the paper's."""

STATE_SIZES = {1: 7.5, 5: 4.0, 10: 4.5, 20: 5.0}
"""Iterations by state size. Source: the paper, table "Acceleration with different state sizes on BAL"."""

AVERAGE = "schedule-of-our-agent"
"""Name of the schedule that `average_schedule` makes."""

OURS, CLOCK, REDUCTION, REVERSED = (one.name for one in (agents.OURS, agents.CLOCK, agents.REDUCTION, agents.REVERSED))


@dataclass(frozen=True)
class Ablation:
    """An ablation table."""

    name: str
    title: str
    heading: str
    rows: Callable[[Runner], list[Labelled]]
    """Rows after those of the paper's baseline and of Ceres' rule."""
    statements: Callable[[Runner], list[Statement]]
    """Claims on either set of problems."""
    text: Callable[[Runner], str]
    """Paragraph above the tables."""

    def every_row(self, runner: Runner) -> list[Labelled]:
        """All rows."""
        return [named("classic", CLASSIC, 20.0), named("Ceres' rule", CERES), *self.rows(runner)]

    def run(self, runner: Runner) -> None:
        """Solves the scenes of the tables and the BAL problems with all methods."""
        methods = common.methods(self.every_row(runner))
        for method in methods:
            runner.play(method)
        runner.solve(real_problems.bal(runner.config.real), methods)

    def section(self, runner: Runner) -> Section:
        """The tables and claims on both sets."""
        rows, statements = self.every_row(runner), self.statements(runner)
        sources, reason = real_problems.bal(runner.config.real), real_problems.reason_without_bal(runner.config.real)
        scenes, bal = Lines(runner, rows, None), Lines(runner, rows, sources)
        claims = (*judge(statements, scenes.known, "synthetic"), *judge(statements, bal.known, "BAL"))
        body = [self.text(runner)]
        if scenes.any:
            where = f"**{runner.number_of_scenes()} synthetic scenes** of the kind that the agents train on"
            body += [f"{where}, none of them seen in training:", scenes.table(), _gauss_newton_comparison(runner)]
        else:
            body.append(common.NOT_YET)
        if reason:
            body.append(f"**BAL**: {reason}.")
        elif bal.any:
            body += [f"**BAL**, {common.problems(len(sources))} ({common.listed(sources)}):", bal.table()]
        return Section(self.heading, (*body, disagreements(claims, WHY)), claims)


def _gauss_newton_comparison(runner: Runner) -> str:
    """A sentence on the iterations of Gauss-Newton and of Ceres' rule on the scenes of the tables; empty if they were
    not run."""
    undamped, ceres = runner.row_on_scenes(method_named("gauss-newton")), runner.row_on_scenes(method_named(CERES))
    if not (undamped.solves and ceres.solves):
        return ""
    return (
        f"For scale: on these scenes Gauss-Newton (1e-10 throughout) takes {format_iterations(undamped.iterations)} "
        f"iterations and Ceres' rule {format_iterations(ceres.iterations)}, without any learning."
    )


def _ours(runner: Runner) -> Labelled:
    """Row of the agent with which each ablation is compared."""
    return Labelled("ours: 5 errors, -1 an iteration, bonus", runner.agent(agents.OURS), 4.0)


def _zero_text(runner: Runner) -> str:
    net = runner.config.zero_net
    return (
        f"A network with {net.layers} hidden layers of {net.width} units observes the last five errors, actions and "
        "rewards. It is trained to minimise the logarithm of the next error: "
        f"{net.updates} updates of Adam ({net.learning_rate:g}), each with the gradient through one `lm_step` on "
        f"{net.batch} scenes. The error is that of the *proposed* step, since a rejected one would have no gradient. "
        "The paper does not give the optimiser, the number of updates, or whether its layers include the output."
    )


ZERO_NET = Ablation(
    "zero-net",
    "Table: comparison with the non-holistic Zero-net",
    "Zero-net: the next error instead of the whole solve",
    lambda runner: [Labelled("Zero-net", runner.zero_net(), 8.0), _ours(runner)],
    lambda _: [
        Statement(order_claim, "The agent beats the Zero-net ({})", "4 against 8", OURS, "zero-net"),
        Statement(ratio_claim, "The Zero-net takes two fifths of classic's iterations ({})", 0.4, "zero-net", CLASSIC),
    ],
    _zero_text,
)


def _sized(runner: Runner) -> list[Labelled]:
    sizes = runner.config.agents.state_sizes
    agent = lambda size: runner.agent(agents.with_state_size(size))
    return [Labelled(f"ours, last {size} errors", agent(size), STATE_SIZES.get(size)) for size in sizes]


def _size_statements(runner: Runner) -> list[Statement]:
    others = [x for x in runner.config.agents.state_sizes if x in STATE_SIZES and x != PAPER_STATE]
    numbers = lambda size: f"{STATE_SIZES[PAPER_STATE]:g} against {STATE_SIZES[size]:g}"
    text, name = "Five errors are better than {} ({{}})", lambda size: agents.with_state_size(size).name
    best = name(PAPER_STATE)
    return [Statement(order_claim, text.format(size), numbers(size), best, name(size)) for size in others]


STATE_SIZE = Ablation(
    "state-size",
    "Table: state size 1, 5, 10, 20",
    "State size",
    _sized,
    _size_statements,
    lambda _: (
        "The paper calls the number of last errors in a state its batch size; its released code feeds one number per "
        "step and samples chunks of steps. Here the observation is that many last errors, as the text says."
    ),
)

REVERSED_ROLES = Ablation(
    "reversed",
    "Table: reversed roles of state and reward",
    "Reversed roles",
    lambda runner: [
        _ours(runner),
        Labelled("reversed: 5 durations, error", runner.agent(agents.REVERSED), 10.0),
    ],
    lambda _: [
        Statement(order_claim, "Reversed roles accelerate less ({})", "4 against 10", OURS, REVERSED),
        Statement(ratio_claim, "Reversed roles still halve classic's iterations ({})", 0.5, REVERSED, CLASSIC),
        Statement(success_claim, "Reversed roles succeed less often ({})", 0.7, REVERSED),
        Statement(success_claim, "Our agent always succeeds ({})", 1.0, OURS),
    ],
    lambda _: (
        "Interpreted as: the state is minus the time of each of the last five iterations, by the clock of the section "
        "on rewards. The reward is minus the logarithm of the error over the best known one, with the same bonus."
    ),
)

REWARDS = Ablation(
    "rewards",
    "Table: rewards duration, constant, reduction",
    "Rewards",
    lambda runner: [
        Labelled("reward: minus the duration by the clock", runner.agent(agents.CLOCK), 4.0),
        Labelled("reward: -1", runner.agent(agents.OURS), 5.0),
        Labelled("reward: nothing, bonus shrinking by 1 %", runner.agent(agents.REDUCTION), 4.2),
    ],
    lambda _: [
        Statement(order_claim, f"The duration is a better reward than {other} ({{}})", numbers, CLOCK, name)
        for other, numbers, name in (
            ("a constant", "4 against 5", OURS),
            ("a shrinking bonus", "4 against 4.2", REDUCTION),
        )
    ],
    lambda _: (
        "An iteration of the compiled game has no duration of its own. The clock gives it one of "
        f"{len(DURATIONS)} quantiles of measured durations, {min(DURATIONS):g} to {max(DURATIONS):g} of their mean "
        f"(`jaxba/damping/features.py`), and the mean is the paper's on BAL, {agents.SECONDS:g} s, against a bonus "
        "of 10. "
        "The agent of the other ablations has the constant reward. The shrinking bonus loses 1 % of its first value in "
        "each iteration."
    ),
)


def _scheduled(runner: Runner) -> list[Labelled]:
    def build(_: int) -> tuple[Schedule, SolveOptions]:
        agent = runner.agent(agents.OURS)
        runner.play(agent)  # the schedule is the average of its lambdas
        return Schedule(values=average_schedule(runner.first_dampings(agent))), SolveOptions()

    return [
        named("schedule, the paper's values", "schedule", 12.0),
        Labelled("schedule, averages of our agent", Method(AVERAGE, build), 12.0),
        named("Gauss-Newton: 1e-10 throughout", "gauss-newton"),
        _ours(runner),
    ]


def _schedule_text(runner: Runner) -> str:
    known = runner.first_dampings(runner.agent(agents.OURS))
    values = ", ".join(f"{value:.3g}" for value in average_schedule(known)) if known else "not known yet"
    return (
        "The paper repeats the first four lambdas of its agent, averaged over the test scenes: 1e-15, 1e-15, 0.194, "
        "0.551. The same averages of our first training run on the synthetic test scenes are: "
        f"{values}. The largest lambdas dominate an arithmetic mean over several decades. With diagonal damping, 1e-15 "
        "is no damping at all."
    )


SCHEDULE = Ablation(
    "schedule",
    "Table: constant schedules",
    "Constant schedules",
    _scheduled,
    lambda _: [
        Statement(order_claim, "The agent beats the paper's schedule ({})", "4 against 12", OURS, "schedule"),
        Statement(order_claim, "The agent beats the schedule of its own averages ({})", "4 against 12", OURS, AVERAGE),
        Statement(
            ratio_claim,
            "The paper's schedule takes three fifths of classic's iterations ({})",
            0.6,
            "schedule",
            CLASSIC,
        ),
    ],
    _schedule_text,
)

TABLES = tuple(
    TableOrFigure(one.name, one.title, one.run, one.section)
    for one in (ZERO_NET, STATE_SIZE, REVERSED_ROLES, REWARDS, SCHEDULE)
)
