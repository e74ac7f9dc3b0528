"""Table: BAL's families against Ceres with conjugate gradients, in seconds."""

from __future__ import annotations

import math

from jaxba.bench.tables import number
from jaxba.paper import claims, places
from jaxba.paper.markdown import Section, counted, disagreements, share, table
from jaxba.paper.pieces import base
from jaxba.paper.pieces.base import Piece
from jaxba.paper.workshop import Workshop, named

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
    "machine; "
    "the paper's are of whole families, ours of the files at hand and of parts of them."
)


def _work(shop: Workshop) -> None:
    for found in places.families(shop.config.real):
        shop.solve(found.all, [named(name) for name in METHODS])


def _section(shop: Workshop) -> Section:
    methods = [named(name) for name in METHODS]
    body, found, cells = [], [], []
    for family in places.families(shop.config.real):
        rows = [shop.row_on(family.all, method) for method in methods]
        paper = PAPER.get(family.family, (math.nan,) * 3)
        if family.reason or not any(row.solves for row in rows):
            cells.append([family.family, family.reason or base.NOT_YET, *[number(x) for x in paper], *["-"] * 4])
            continue
        counts = [f"{number(row.seconds)} s, {counted(row.iterations)} its, {share(row.success)}" for row in rows]
        sizes = base.problems(rows[0].solves)
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
        "Seconds: set-up and iterations of a whole solve to convergence or 100 iterations, without compilation; "
        "means over the "
        "family's problems here. Ours in lambda alone."
    )
    body.append(table(header, cells, 2) if cells else "The configuration names no family.")
    body.append(disagreements(found, WHY))
    return Section("BAL's families against Ceres with conjugate gradients", tuple(body), tuple(found))


PIECE = Piece("subproblems", "Table: BAL's families against Ceres-CG", _work, _section)
