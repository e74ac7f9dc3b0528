"""Tables of real problems: efficiency on KITTI and BAL, agents of synthetic scenes, BAL's families
in seconds."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

from jaxba.bench.sources import Source
from jaxba.paper import claims, real_problems
from jaxba.paper.agents import BEST, FEW, OURS
from jaxba.paper.claims import Statement, ratio_claim, success_claim, time_claim
from jaxba.paper.runner import ELSEWHERE, Runner, method_named
from jaxba.paper.tables_and_figures.common import (
    CERES,
    CLASSIC,
    Line,
    Part,
    Table,
    named,
    ours,
    with_twin,
)

# names of our agents, trained elsewhere
TUNED = f"{OURS.name}{ELSEWHERE}"
GUARDED = f"{BEST.name}{ELSEWHERE}"
# between DeepLM's mean squared errors with and without ours, at most. Source: the paper
MSE_DIFFERENCE = 0.003


def _trained_elsewhere(runner: Runner, sources: Sequence[Source]) -> dict[str, str]:
    """A sentence on what the agents of a table were trained on."""
    pairs = {real_problems.training_files(runner.config.real, source) for source in sources}
    parts = [
        f"without {name} on windows of {', '.join(real_problems.label(path) for path in files)}"
        for name, files in sorted(pairs)
        if files
    ]
    if not parts:
        return {
            "trained": "There is no other problem of this data set on this machine to train an "
            "agent on."
        }
    trained = (
        "The agents of this table are trained on windows of up to 10 cameras and 40 points, with "
        "the steps that they "
        f"drive, and judged on problems that the windows are not of: {'; '.join(parts)}."
    )
    return {"trained": trained}


def _kitti(runner: Runner) -> list[Part]:
    """Source: the paper, table "Average efficiency improvement - KITTI"."""
    lines = [
        named("STBA", "stba+stba", 80.0, 287.4),
        named("classic", CLASSIC, 75.0, 340.0),
        named("Ceres' rule", CERES),
        *with_twin("STBA", runner.elsewhere, "stba", paper=16.0, paper_s=110.0),
        *ours(runner, 14.0, 100.2, elsewhere=True),
    ]
    with_stba = "KITTI: ours takes a fifth of STBA's iterations"
    statements = [
        Statement(ratio_claim, with_stba, 0.2, f"stba+{GUARDED}", "stba+stba"),
        Statement(success_claim, "KITTI: classic succeeds everywhere", 1.0, CLASSIC),
    ]
    for agent, what in ((TUNED, "tuned"), (GUARDED, "guarded")):
        text = f"KITTI: ours ({what}) takes a"
        statements += [
            Statement(
                ratio_claim, f"{text} fifth of classic's iterations", 14 / 75, agent, CLASSIC
            ),
            Statement(time_claim, f"{text} third of classic's time", 100.2 / 340.0, agent, CLASSIC),
            Statement(success_claim, f"KITTI: ours ({what}) succeeds everywhere", 1.0, agent),
        ]
    return [Part(real_problems.find(runner.config.real.kitti), lines, statements, each=True)]


def _bal(runner: Runner) -> list[Part]:
    """Source: the paper, table "Average efficiency improvement - BAL"."""
    lines = [
        named("DeepLM's solver", "deeplm+ceres", 15.0, 40.75),
        named("Ceres, C++", "pyceres:sparse", 20.0, 46.7),
        named("classic", CLASSIC, 20.0, 110.0),
        named("Ceres' rule", CERES),
        *with_twin("DeepLM's solver", runner.elsewhere, "deeplm", paper=5.0, paper_s=20.3),
        *ours(runner, 4.0, 62.04, elsewhere=True),
    ]

    def over(test, text, paper, ours, base):
        return Statement(test, f"BAL: {text}", paper, ours, base)

    third = "DeepLM + ours takes a third of DeepLM's iterations"
    with_deeplm = f"deeplm+{GUARDED}"
    statements = [over(ratio_claim, third, 1 / 3, with_deeplm, "deeplm+ceres")]
    for agent, what in ((TUNED, "tuned"), (GUARDED, "guarded")):
        statements += [
            over(
                ratio_claim,
                f"ours ({what}) takes a fifth of classic's iterations",
                0.2,
                agent,
                CLASSIC,
            ),
            over(
                time_claim,
                f"ours ({what}) takes half of classic's time",
                62.04 / 110.0,
                agent,
                CLASSIC,
            ),
            over(success_claim, f"ours ({what}) succeeds everywhere", 1.0, agent, ""),
        ]
    return [Part(real_problems.bal(runner.config.real), lines, statements, _same_error, each=True)]


def _same_error(runner: Runner) -> Iterable[claims.Claim]:
    """The claim on the mean squared error of an observation, pixels squared, twice the final cost
    over their number: by how much it is larger with the agent, on each problem, the mean over the
    training runs."""
    method = runner.elsewhere(BEST, "deeplm")
    base = method_named("deeplm+ceres")
    excess = []
    for source in real_problems.bal(runner.config.real).sources:
        before = runner.records_on([source], [base])
        after = [r for seed in method.numbers for r in runner.records_on([source], [method], seed)]
        if before and after:
            mean = sum(r.final_cost for r in after) / len(after)
            excess.append(2 * (mean - before[0].final_cost) / before[0].observations)
    yield claims.error_claim(
        "BAL: ours does not change DeepLM's mean squared error", MSE_DIFFERENCE, excess
    )


def _synthetic(runner: Runner) -> list[Part]:
    """Source: the paper, tables "Average efficiency improvement" and "Average acceleration using
    synthetic data for training"."""
    few = f"ours: trained on {runner.config.agents.trajectories} scenes only"

    def part(
        problems: real_problems.Problems,
        paper: float,
        classic: float,
        other: str,
        own: float,
        alone: float,
    ):
        name, method = {"stba": ("STBA", "stba+stba"), "deeplm": ("DeepLM", "deeplm+ceres")}[other]
        driven = with_twin(name, runner.agent, "auto", other, paper=own)
        lines = [
            named("classic", CLASSIC, classic),
            named("Ceres' rule", CERES),
            Line(few, runner.agent(FEW), paper),
            named(name, method, alone),
            *driven,
            *ours(runner, paper),
        ]
        text = "Synthetic training, {}: fraction of %s's iterations (%s)"
        stated = [
            Statement(ratio_claim, text % (CLASSIC, "tuned"), paper / classic, OURS.name, CLASSIC),
            Statement(
                ratio_claim, text % (CLASSIC, "guarded"), paper / classic, BEST.name, CLASSIC
            ),
            Statement(
                ratio_claim, text % (name, "guarded"), own / alone, driven[0].method.name, method
            ),
        ]
        return Part(problems, lines, stated)

    real = runner.config.real
    return [
        part(real_problems.find(real.kitti), 17.0, 75.0, "stba", 16.0, 80.0),
        part(real_problems.bal(real), 5.0, 20.0, "deeplm", 5.0, 15.0),
    ]


# of Ceres-CG, DeepLM, DeepLM with the agent. Source: the paper, on BAL's sub-problems
FAMILY_SECONDS = {
    "Trafalgar": (65.1, 10.2, 5.6),
    "Ladybug": (46.7, 15.35, 8.1),
    "Dubrovnik": (320.0, 10.0, 4.1),
    "Venice": (1992.0, 60.0, 31.4),
    "Final": (3897.0, 65.0, 33.7),
}


def _families(runner: Runner) -> list[Part]:
    parts = []
    for family in runner.config.real.bal:
        lines = [
            named("Ceres-CG", "pyceres:iterative"),
            named("DeepLM", "deeplm+ceres"),
            *with_twin("DeepLM", runner.elsewhere, "deeplm", paper=math.nan),
            *ours(runner, elsewhere=True),
        ]
        paper = FAMILY_SECONDS.get(family.name)  # the paper has no numbers of other families
        if paper:
            lines = [
                *(line._replace(paper_s=x) for line, x in zip(lines[:3], paper, strict=True)),
                *lines[3:],
            ]
        stated = [
            Statement(
                time_claim,
                f"{{}}: DeepLM + ours over {base.label}, seconds",
                paper[2] / base.paper_s,
                lines[2].method.name,
                base.method.name,
            )
            for base in lines[:2]
            if paper
        ]
        parts.append(Part(real_problems.find(family), lines, stated))
    return parts


TABLES = (
    Table(
        "kitti",
        _kitti,
        lambda runner: _trained_elsewhere(
            runner, real_problems.find(runner.config.real.kitti).sources
        ),
    ),
    Table(
        "bal",
        _bal,
        lambda runner: _trained_elsewhere(runner, real_problems.bal(runner.config.real).sources),
    ),
    Table(
        "synthetic", _synthetic, lambda runner: {"trajectories": runner.config.agents.trajectories}
    ),
    Table("subproblems", _families),
)
