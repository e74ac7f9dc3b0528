"""Table: BAL's families against Ceres with conjugate gradients, in seconds."""

from __future__ import annotations

import math

from jaxba.bench.tables import number
from jaxba.paper import claims, real_problems
from jaxba.paper.markdown import Section, disagreements, format_iterations, percentage, table
from jaxba.paper.runner import Runner, method_named
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

METHODS = ("ceres/implicit", "deeplm+ceres", "deeplm+learned-driver", "learned-driver")
LABELS = ("Ceres-CG", "DeepLM", "DeepLM + ours", "ours, explicit")

WHY = (
    "Ceres-CG is Ceres' rule with our matrix-free conjugate gradients, not the C++ program; times are those of this "
    "machine; the paper's are of whole families, ours of the files on this machine and of sub-problems of them."
)


def _run(runner: Runner) -> None:
    for found in real_problems.families(runner.config.real):
        runner.solve(found.all, [method_named(name) for name in METHODS])


def _section(runner: Runner) -> Section:
    methods = [method_named(name) for name in METHODS]
    body, found, cells = [], [], []
    for family in real_problems.families(runner.config.real):
        rows = [runner.row_on(family.all, method) for method in methods]
        paper = PAPER.get(family.family, (math.nan,) * 3)
        if family.reason or not any(row.solves for row in rows):
            cells.append([family.family, family.reason or common.NOT_YET, *[number(x) for x in paper], *["-"] * 4])
            continue
        counts = [
            f"{number(row.seconds)} s, {format_iterations(row.iterations)} its, {percentage(row.success)}"
            for row in rows
        ]
        sizes = common.problems(rows[0].solves)
        cells.append([family.family, sizes, *[number(x) for x in paper], *counts])
        cg, deep, driven, _ = rows
        if math.isfinite(paper[0]):
            found.append(
                claims.time_claim(
                    f"{family.family}: DeepLM + ours over Ceres-CG, seconds", paper[2] / paper[0], driven, cg
                )
            )
            found.append(
                claims.time_claim(
                    f"{family.family}: DeepLM + ours over DeepLM, seconds", paper[2] / paper[1], driven, deep
                )
            )
    header = ["family", "here", *(f"paper: {label}, s" for label in LABELS[:3]), *LABELS]
    body.append(
        "Seconds: set-up and iterations of a solve to convergence or 100 iterations, without compilation; means over "
        "the family's problems on this machine. Our policy chooses lambda only."
    )
    body.append(table(header, cells, 2) if cells else "The configuration names no family.")
    body.append(disagreements(found, WHY))
    return Section("BAL's families against Ceres with conjugate gradients", tuple(body), tuple(found))


ENTRY = TableOrFigure("subproblems", "Table: BAL's families against Ceres-CG", _run, _section)
