"""Figure: lambda over the iterations."""

from __future__ import annotations

from itertools import pairwise

from jaxba.bench.plots import plot_lambda
from jaxba.bench.profile import converged
from jaxba.paper import agents, claims
from jaxba.paper.markdown import Section
from jaxba.paper.pieces import base, figures
from jaxba.paper.pieces.base import Piece
from jaxba.paper.workshop import Method, Workshop, named

PAPER = {"classic": 30, "schedule": 16, "learned-driver": 8}
"""Iterations on the paper's test case. Source: caption of the figure."""


def _methods(shop: Workshop) -> list[Method]:
    return [*map(named, ("classic", "schedule", "ceres", "learned-driver")), shop.agent(agents.OURS)]


def _work(shop: Workshop) -> None:
    shop.solve([figures.main_problem(shop)], _methods(shop), repeats=1)


def _section(shop: Workshop) -> Section:
    problem = figures.main_problem(shop)
    records = shop.records_on([problem], _methods(shop))
    if not records:
        return Section("Lambda over the iterations", (base.NOT_YET,))
    caption = f"{problem.name}: lambda of each iteration, rejected ones hollow; right: the last ten of classic"
    counts = {r.solver: (r.iterations, converged(r)) for r in records if r.repeat == 0}
    said = [
        f"{name} {count}{'' if good else ' (not converged)'}{f' (paper {PAPER[name]})' if name in PAPER else ''}"
        for name, (count, good) in counts.items()
    ]
    flat = next((r for r in records if r.solver == "learned-driver"), None)
    body = [figures.picture(shop, plot_lambda(records, problem.name), "lambda", caption)]
    body.append(f"Iterations on {problem.name}: {', '.join(said)}. The paper's test case is not named.")
    if flat is not None and len(flat.trace) > 2:
        steps = [p.damping for p in flat.trace[1:]]
        factors = {round(b / a, 3) for a, b in pairwise(steps)}
        body.append(
            f"The shipped policy used {len(factors)} different factors between its {len(steps)} lambdas; classic has "
            "two."
        )
    pair = [(shop.row_on([problem], m) if any(r.solver == m.name for r in records) else None) for m in _methods(shop)]
    found = (claims.ratio_claim("Chart: ours takes 8 of classic's 30 iterations", 8 / 30, pair[3], pair[0]),)
    return Section("Lambda over the iterations", tuple(body), found)


PIECE = Piece("lambda", "Figure: chosen lambdas over the iterations", _work, _section)
