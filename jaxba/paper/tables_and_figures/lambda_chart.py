"""Figure: lambda over the iterations."""

from __future__ import annotations

from itertools import pairwise

from jaxba.bench.plots import plot_lambda
from jaxba.bench.profile import converged
from jaxba.paper import claims
from jaxba.paper.markdown import Section
from jaxba.paper.runner import ELSEWHERE, Method, Runner, method_named
from jaxba.paper.tables_and_figures import common, figures
from jaxba.paper.tables_and_figures.common import TableOrFigure

PAPER = {"classic": 30, "schedule": 16, ELSEWHERE: 8}
"""Iterations on the paper's test case. Source: the caption of the paper's figure."""


def _methods(runner: Runner) -> list[Method]:
    return [*map(method_named, ("classic", "schedule", "ceres", "learned-driver")), runner.agent_trained_elsewhere()]


def _run(runner: Runner) -> None:
    runner.solve([figures.main_problem(runner)], _methods(runner), repeats=1)


def _section(runner: Runner) -> Section:
    problem = figures.main_problem(runner)
    records = runner.records_on([problem], _methods(runner))
    pair = [
        (runner.row_on([problem], m) if any(r.solver == m.name for r in records) else None) for m in _methods(runner)
    ]
    found = (claims.ratio_claim("Chart: ours takes 8 of classic's 30 iterations", 8 / 30, pair[4], pair[0]),)
    if not records:
        return Section("Lambda over the iterations", (common.NOT_YET,), found)
    caption = f"{problem.name}: lambda of each iteration, rejected ones hollow; right: the last ten of classic"
    counts = {r.solver: (r.iterations, converged(r)) for r in records if r.repeat == 0}
    counts_text = [
        f"{name} {count}{'' if good else ' (not converged)'}{f' (paper {PAPER[name]})' if name in PAPER else ''}"
        for name, (count, good) in counts.items()
    ]
    flat = next((r for r in records if r.solver == ELSEWHERE), None)
    body = [figures.picture(runner, plot_lambda(records, problem.name), "lambda", caption)]
    body.append(f"Iterations on {problem.name}: {', '.join(counts_text)}. The paper does not name its test case.")
    if flat is not None and len(flat.trace) > 2:
        steps = [p.damping for p in flat.trace[1:]]
        factors = {round(b / a, 3) for a, b in pairwise(steps)}
        body.append(
            f"The agent used {len(factors)} different factors between its {len(steps)} lambdas; classic has two."
        )
    return Section("Lambda over the iterations", tuple(body), found)


ENTRY = TableOrFigure("lambda", "Figure: chosen lambdas over the iterations", _run, _section)
