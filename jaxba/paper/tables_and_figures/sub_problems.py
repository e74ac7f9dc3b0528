"""Table: BAL's families against Ceres with conjugate gradients, in seconds."""

from __future__ import annotations

import math

from jaxba.bench.tables import number
from jaxba.paper import claims, real_problems
from jaxba.paper.markdown import Section, disagreements, format_iterations, percentage, table
from jaxba.paper.rows import Row
from jaxba.paper.runner import Method, Runner, method_named
from jaxba.paper.tables_and_figures import common
from jaxba.paper.tables_and_figures.common import TableOrFigure

PAPER = {
    "Trafalgar": (65.1, 10.2, 5.6),
    "Ladybug": (46.7, 15.35, 8.1),
    "Dubrovnik": (320.0, 10.0, 4.1),
    "Venice": (1992.0, 60.0, 31.4),
    "Final": (3897.0, 65.0, 33.7),
}
"""Seconds of Ceres-CG, DeepLM, and DeepLM with the agent. Source: the paper, table "Acceleration of BAL's
sub-problems"."""

LABELS = ("Ceres-CG", "DeepLM", "DeepLM + ours", "ours, explicit")

WHY = "the paper's times are of whole families, ours of the files on this machine and of sub-problems of them."


def _methods(runner: Runner) -> list[Method]:
    return [
        *map(method_named, ("pyceres:iterative", "deeplm+ceres")),
        runner.agent_trained_elsewhere("deeplm"),
        runner.agent_trained_elsewhere(),
    ]


def _run(runner: Runner) -> None:
    for found in real_problems.families(runner.config.real):
        runner.solve(found.all, _methods(runner))


def _section(runner: Runner) -> Section:
    methods = _methods(runner)
    body, found, cells = [], [], []
    for family in real_problems.families(runner.config.real):
        rows = [runner.row_on(family.all, method) for method in methods]
        paper = PAPER.get(family.family, (math.nan,) * 3)
        if family.reason or not any(row.solves for row in rows):
            cells.append([family.family, family.reason or common.NOT_YET, *[number(x) for x in paper], *["-"] * 4])
            found += _claims(family.family, paper, None, None, None)
            continue
        counts = [
            f"{number(row.seconds)} s, {format_iterations(row.iterations)} its, {percentage(row.success)}"
            for row in rows
        ]
        sizes = common.problems(rows[0].solves)
        cells.append([family.family, sizes, *[number(x) for x in paper], *counts])
        cg, deep, driven, _ = rows
        found += _claims(family.family, paper, cg, deep, driven)
    header = ["family", "here", *(f"paper: {label}, s" for label in LABELS[:3]), *LABELS]
    body.append(
        "Seconds: set-up and iterations of a solve to convergence or 100 iterations, without compilation; means over "
        "the family's problems on this machine. Ceres-CG is the C++ library with iterative Schur complements; ours are "
        "the agents trained on other families of BAL."
    )
    body.append(table(header, cells, 2) if cells else "The configuration names no family.")
    body.append(disagreements(found, WHY))
    return Section("BAL's families against Ceres with conjugate gradients", tuple(body), tuple(found))


def _claims(
    family: str, paper: tuple[float, ...], cg: Row | None, deep: Row | None, driven: Row | None
) -> list[claims.Claim]:
    """The claims on one family; none if the paper has no numbers of it."""
    if not math.isfinite(paper[0]):
        return []
    text = lambda base: f"{family}: DeepLM + ours over {base}, seconds"
    return [
        claims.time_claim(text("Ceres-CG"), paper[2] / paper[0], driven, cg),
        claims.time_claim(text("DeepLM"), paper[2] / paper[1], driven, deep),
    ]


ENTRY = TableOrFigure("subproblems", "Table: BAL's families against Ceres-CG", _run, _section)
