"""The tables of real problems: average efficiency on KITTI and BAL, agents trained on synthetic scenes, and BAL's
families in seconds."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from jaxba.bench.profile import ITERATION_LIMIT
from jaxba.bench.sources import Source
from jaxba.bench.tables import number
from jaxba.paper import claims, real_problems
from jaxba.paper.agents import FEW, OURS, updates
from jaxba.paper.claims import Statement, judge, ratio_claim, success_claim, time_claim
from jaxba.paper.markdown import Section, disagreements, format_iterations, percentage, table
from jaxba.paper.rows import Row
from jaxba.paper.runner import ELSEWHERE, Runner, method_named
from jaxba.paper.tables_and_figures import common
from jaxba.paper.tables_and_figures.common import CERES, CLASSIC, Labelled, Lines, TableOrFigure, named

CERES_ITSELF, CERES_WITH_OURS = "pyceres:sparse", "pyceres:sparse+learned+refine0"
"""Ceres under its own rule, and with our lambda; both need the extra `ceres`."""

MSE_DIFFERENCE = 0.003
"""Largest difference of the mean squared errors of DeepLM's solver with and without ours. Source: the paper, after the
table on BAL."""


@dataclass(frozen=True)
class DataSet:
    """A set of real problems on this machine."""

    name: str
    sources: tuple[Source, ...]
    reason: str
    """Why there are no problems; empty if there are some."""
    missing: str = ""
    """A sentence on what is in the configuration, but not on this machine."""


def kitti(runner: Runner) -> DataSet:
    """The KITTI problems on this machine and their sub-problems."""
    found = real_problems.find(runner.config.real.kitti)
    names = ", ".join(f"`{name}`" for name in found.missing)
    missing = f"In the configuration, but not on this machine: {names}." if names else ""
    return DataSet("KITTI", found.all, found.reason, missing)


def bal(runner: Runner) -> DataSet:
    """The BAL problems on this machine and their sub-problems."""
    config = runner.config.real
    absent = ", ".join(found.family for found in real_problems.families(config) if found.reason)
    missing = f"No file on this machine of: {absent}." if absent else ""
    return DataSet("BAL", real_problems.bal(config), real_problems.reason_without_bal(config), missing)


def _per_problem(runner: Runner, rows: Sequence[Labelled], sources: Sequence[Source]) -> str:
    """The table of the iterations on each problem."""
    header = ["iterations to convergence / to f\\*(1+1e-3); ✗: not within 100", *(one.label for one in rows)]
    cells = [[source.name, *(_cell(runner.row_on([source], one.method)) for one in rows)] for source in sources]
    return table(header, cells)


def _cell(row: Row) -> str:
    if not row.solves:
        return "-"
    fraction = f" ({100 * row.success:.0f} %)" if 0 < row.success < 1 else ""
    end = "✗" if row.success == 0 else format_iterations(row.iterations)
    return f"{end}{fraction} / {'✗' if row.near >= ITERATION_LIMIT else format_iterations(row.near)}"


def _trained_elsewhere(runner: Runner, sources: Sequence[Source]) -> str:
    """A sentence on what the agents of a table were trained on."""
    pairs = {real_problems.training_files(runner.config.real, source) for source in sources}
    parts = [
        f"without {name} on windows of {', '.join(real_problems.label(path) for path in files)}"
        for name, files in sorted(pairs)
        if files
    ]
    if not parts:
        return "There is no other problem of this data set on this machine to train an agent on."
    return (
        "The agents of this table are trained on windows of up to 10 cameras and 40 points, poses and points unknown, "
        f"for {updates(runner.config)} updates with the reward by the clock (section on rewards), and judged on "
        f"problems that the windows are not of: {'; '.join(parts)}."
    )


# Average efficiency on KITTI


def _kitti_rows(runner: Runner) -> list[Labelled]:
    """Source: the paper, table "Average efficiency improvement - KITTI"."""
    return [
        named("STBA", "stba+stba", 80.0, 287.4),
        named("classic", CLASSIC, 75.0, 340.0),
        named("Ceres' rule", CERES),
        named("shipped policy, lambda alone", "learned-driver"),
        Labelled("STBA + ours: agent trained on KITTI", runner.agent_trained_elsewhere("stba"), 16.0, 110.0),
        Labelled("ours: agent trained on KITTI", runner.agent_trained_elsewhere(), 14.0, 100.2),
    ]


ON_KITTI = (
    Statement(ratio_claim, "KITTI: ours takes a fifth of classic's iterations", 14 / 75, ELSEWHERE, CLASSIC),
    Statement(ratio_claim, "KITTI: ours takes a fifth of STBA's iterations", 0.2, f"stba+{ELSEWHERE}", "stba+stba"),
    Statement(time_claim, "KITTI: ours takes a third of classic's time", 100.2 / 340.0, ELSEWHERE, CLASSIC),
    Statement(success_claim, "KITTI: classic succeeds everywhere", 1.0, CLASSIC),
    Statement(success_claim, "KITTI: ours succeeds everywhere", 1.0, ELSEWHERE),
)

WHY_KITTI = (
    "front end, sequences and windows differ, since the paper does not describe them; both files at hand are of "
    "sequence 00, from different front ends; our STBA is written in JAX from its paper and its authors' code."
)


def _kitti_section(runner: Runner) -> Section:
    found, rows = kitti(runner), _kitti_rows(runner)
    lines = Lines(runner, rows, found.sources)
    verdicts = judge(ON_KITTI, lines.known)
    if found.reason or not lines.any:
        return Section("KITTI", (f"KITTI: {found.reason}." if found.reason else common.NOT_YET,), verdicts)
    body = (
        f"{common.problems(len(found.sources))}: {common.listed(found.sources)}. `-firstN` is the "
        "sub-problem of N neighbouring cameras, starting with the camera that observes most points. As in the paper, "
        "poses and points are unknown and the lens is known.",
        found.missing,
        _trained_elsewhere(runner, found.sources),
        lines.table(with_time=True),
        _per_problem(runner, rows, found.sources),
        disagreements(verdicts, WHY_KITTI),
    )
    return Section("KITTI", body, verdicts)


# Average efficiency on BAL


def _bal_rows(runner: Runner) -> list[Labelled]:
    """Source: the paper, table "Average efficiency improvement - BAL"."""
    return [
        named("DeepLM's solver", "deeplm+ceres", 15.0, 40.75),
        named("Ceres, C++", CERES_ITSELF, 20.0, 46.7),
        named("Ceres, C++, + shipped policy", CERES_WITH_OURS, 4.0, 20.75),
        named("classic", CLASSIC, 20.0, 110.0),
        named("Ceres' rule", CERES),
        named("shipped policy, lambda alone", "learned-driver"),
        Labelled("DeepLM's solver + ours: agent trained on BAL", runner.agent_trained_elsewhere("deeplm"), 5.0, 20.3),
        Labelled("ours: agent trained on BAL", runner.agent_trained_elsewhere(), 4.0, 62.04),
    ]


ON_BAL = (
    Statement(ratio_claim, "BAL: ours takes a fifth of classic's iterations", 0.2, ELSEWHERE, CLASSIC),
    Statement(ratio_claim, "BAL: Ceres + ours takes a fifth of Ceres' iterations", 0.2, CERES_WITH_OURS, CERES_ITSELF),
    Statement(
        ratio_claim,
        "BAL: DeepLM + ours takes a third of DeepLM's iterations",
        1 / 3,
        f"deeplm+{ELSEWHERE}",
        "deeplm+ceres",
    ),
    Statement(time_claim, "BAL: ours takes half of classic's time", 62.04 / 110.0, ELSEWHERE, CLASSIC),
    Statement(time_claim, "BAL: Ceres + ours takes half of Ceres' time", 20.75 / 46.7, CERES_WITH_OURS, CERES_ITSELF),
    Statement(success_claim, "BAL: ours succeeds everywhere", 1.0, ELSEWHERE),
)

WHY_BAL = "the problems are those on this machine and parts of them, not all of BAL."


def _bal_section(runner: Runner) -> Section:
    found, rows = bal(runner), _bal_rows(runner)
    lines = Lines(runner, rows, found.sources)
    text, excess = "BAL: ours does not change DeepLM's mean squared error", _mse_excess(runner, found.sources)
    verdicts = (*judge(ON_BAL, lines.known), claims.error_claim(text, MSE_DIFFERENCE, excess))
    if found.reason or not lines.any:
        return Section("BAL", (f"BAL: {found.reason}." if found.reason else common.NOT_YET,), verdicts)
    body = (
        f"{common.problems(len(found.sources))}: {common.listed(found.sources)}. {found.missing}",
        _trained_elsewhere(runner, found.sources),
        lines.table(with_time=True),
        _per_problem(runner, rows, found.sources),
        _ceres_comparison(lines),
        "The mean squared error is that of an observation in pixels squared, twice the final cost over their number.",
        disagreements(verdicts, WHY_BAL),
    )
    return Section("BAL", body, verdicts)


def _mse_excess(runner: Runner, sources: Sequence[Source]) -> list[float]:
    """By how much the mean squared error of DeepLM's solver is larger with the agent, for each problem, the mean over
    the training runs."""
    method, base = runner.agent_trained_elsewhere("deeplm"), method_named("deeplm+ceres")
    found = []
    for source in sources:
        before = runner.records_on([source], [base])
        after = [r for seed in method.numbers for r in runner.records_on([source], [method], seed)]
        if before and after:
            mean = sum(r.final_cost for r in after) / len(after)
            found.append(2 * (mean - before[0].final_cost) / before[0].observations)
    return found


def _ceres_comparison(lines: Lines) -> str:
    classic, ceres = lines.known(CLASSIC), lines.known(CERES)
    if not classic or not ceres:
        return ""
    ratio = ceres.iterations / classic.iterations
    if ratio > claims.PARTLY_RATIO:
        return f"Ceres' rule takes {ratio:.2f} of classic's iterations here."
    return (
        f"Ceres' rule, without any learning, takes {ratio:.2f} of classic's iterations here. This part of the gain "
        "over classic comes from that rule's first lambda (1e-4 instead of 1/4) and factors, and not from learning."
    )


# Trained on synthetic scenes


def _synthetic_rows(runner: Runner, ours: float, classic: float) -> list[Labelled]:
    """Rows of either set, with the paper's iterations of its agent and of classic."""
    return [
        named("classic", CLASSIC, classic),
        named("Ceres' rule", CERES),
        Labelled("ours: agent of this run", runner.agent(OURS), ours),
        named("ours: shipped policy, wide synthetic scenes", "learned-driver", ours),
        Labelled(f"ours: trained on {runner.config.agents.trajectories} scenes only", runner.agent(FEW), ours),
    ]


def _synthetic_sets(runner: Runner) -> list[tuple[DataSet, list[Labelled], list[tuple[str, str, float]]]]:
    """For both data sets: problems, rows, and method, its base and the paper's ratio of their iterations. Source: the
    paper, tables "Average efficiency improvement" and "Average acceleration using synthetic data for training"."""
    of_run = lambda method: runner.agent(OURS, method)
    stba = [named("STBA", "stba+stba", 80.0), Labelled("STBA + agent of this run", of_run("stba"), 16.0)]
    deeplm = [named("DeepLM", "deeplm+ceres", 15.0), Labelled("DeepLM + agent of this run", of_run("deeplm"), 5.0)]
    return [
        (
            kitti(runner),
            [*_synthetic_rows(runner, 17.0, 75.0), *stba],
            [(OURS.name, CLASSIC, 17 / 75), (f"stba+{OURS.name}", "stba+stba", 16 / 80)],
        ),
        (
            bal(runner),
            [*_synthetic_rows(runner, 5.0, 20.0), *deeplm],
            [(OURS.name, CLASSIC, 5 / 20), (f"deeplm+{OURS.name}", "deeplm+ceres", 5 / 15)],
        ),
    ]


WHY_SYNTHETIC = (
    "our problems are other ones, some of them small; our agent follows the paper's text and not its code, which "
    "differs from the text in state, range of lambda and reward."
)


def _run_synthetic(runner: Runner) -> None:
    for found, rows, _ in _synthetic_sets(runner):
        runner.solve(found.sources, common.methods(rows))


def _synthetic_section(runner: Runner) -> Section:
    body = [
        "The paper trains on 10 trajectories of 10 cameras and 10 points. Agents of this run train on scenes of that "
        "kind, with unknown poses and points as in the paper; one kind of agent trains on "
        f"{runner.config.agents.trajectories} scenes in all. Problems of BAL are then solved with the nine unknowns of "
        "its cameras, those of KITTI with known lenses."
    ]
    verdicts: list[claims.Claim] = []
    for found, rows, ratios in _synthetic_sets(runner):
        lines = Lines(runner, rows, found.sources)
        text = f"Synthetic training, {found.name}: fraction of {{}}'s iterations"
        stated = [Statement(ratio_claim, text.format(base), wanted, one, base) for one, base, wanted in ratios]
        verdicts += judge(stated, lines.known)
        if found.reason or not lines.any:
            body.append(f"**{found.name}**: {found.reason or common.NOT_YET}")
        else:
            body += [f"**{found.name}**, {common.problems(len(found.sources))}:", lines.table(with_time=True)]
    body.append(disagreements(verdicts, WHY_SYNTHETIC))
    return Section("Synthetic training, real problems", tuple(body), tuple(verdicts))


# BAL's families against Ceres with conjugate gradients, in seconds

FAMILY_SECONDS = {
    "Trafalgar": (65.1, 10.2, 5.6),
    "Ladybug": (46.7, 15.35, 8.1),
    "Dubrovnik": (320.0, 10.0, 4.1),
    "Venice": (1992.0, 60.0, 31.4),
    "Final": (3897.0, 65.0, 33.7),
}
"""Seconds of Ceres-CG, DeepLM, and DeepLM with the agent. Source: the paper, table "Acceleration of BAL's
sub-problems"."""

WHY_FAMILIES = "the paper's times are of whole families, ours of the files on this machine and of sub-problems of them."


def _family_rows(runner: Runner) -> list[Labelled]:
    return [
        named("Ceres-CG", "pyceres:iterative"),
        named("DeepLM", "deeplm+ceres"),
        Labelled("DeepLM + ours", runner.agent_trained_elsewhere("deeplm")),
        Labelled("ours, explicit", runner.agent_trained_elsewhere()),
    ]


def _run_families(runner: Runner) -> None:
    for family in real_problems.families(runner.config.real):
        runner.solve(family.all, common.methods(_family_rows(runner)))


def _family_section(runner: Runner) -> Section:
    rows = _family_rows(runner)
    verdicts: list[claims.Claim] = []
    cells = []
    for family in real_problems.families(runner.config.real):
        lines = Lines(runner, rows, family.all)
        paper = FAMILY_SECONDS.get(family.family, (math.nan,) * 3)
        ran = not family.reason and lines.any
        counts = [
            f"{number(row.seconds)} s, {format_iterations(row.iterations)} its, {percentage(row.success)}"
            for row in lines.by_name.values()
        ]
        here = common.problems(lines[0].row.solves) if ran else family.reason or common.NOT_YET
        cells.append([family.family, here, *map(number, paper), *(counts if ran else ["-"] * len(rows))])
        if family.family in FAMILY_SECONDS:  # the paper has no numbers of other ones
            text, deeplm = f"{family.family}: DeepLM + ours over {{}}, seconds", rows[2].method.name
            stated = [
                Statement(time_claim, text.format(base.label), paper[2] / paper[k], deeplm, base.method.name)
                for k, base in enumerate(rows[:2])
            ]
            verdicts += judge(stated, lines.by_name.get if ran else lambda _: None)
    labels = [one.label for one in rows]
    header = ["family", "here", *(f"paper: {label}, s" for label in labels[:3]), *labels]
    body = (
        "Seconds: set-up and iterations of a solve to convergence or 100 iterations, without compilation; means over "
        "the family's problems on this machine. Ceres-CG is the C++ library with iterative Schur complements; ours are "
        "the agents trained on other families of BAL.",
        table(header, cells, 2) if cells else "The configuration names no family.",
        disagreements(verdicts, WHY_FAMILIES),
    )
    return Section("BAL's families against Ceres with conjugate gradients", body, tuple(verdicts))


KITTI = TableOrFigure(
    "kitti",
    "Table: average efficiency, KITTI",
    lambda runner: runner.solve(kitti(runner).sources, common.methods(_kitti_rows(runner))),
    _kitti_section,
)
BAL = TableOrFigure(
    "bal",
    "Table: average efficiency, BAL",
    lambda runner: runner.solve(bal(runner).sources, common.methods(_bal_rows(runner))),
    _bal_section,
)
SYNTHETIC = TableOrFigure(
    "synthetic", "Table: trained on synthetic scenes, tested on real problems", _run_synthetic, _synthetic_section
)
FAMILIES = TableOrFigure("subproblems", "Table: BAL's families against Ceres-CG", _run_families, _family_section)
