"""Figure: cost over time, with explicit and implicit solvers."""

from __future__ import annotations

from jaxba.bench.plots import plot_convergence
from jaxba.bench.sources import sources
from jaxba.paper.markdown import Section
from jaxba.paper.runner import Runner, method_named
from jaxba.paper.tables_and_figures import common, figures
from jaxba.paper.tables_and_figures.common import TableOrFigure

METHODS = tuple(
    f"{policy}/{linear}" for policy in ("classic", "ceres", "learned-driver") for linear in ("explicit", "implicit")
)


def _run(runner: Runner) -> None:
    config = runner.config.figures
    runner.solve([figures.main_problem(runner)], [method_named(name) for name in METHODS], repeats=1)
    large = [method_named(name) for name in config.large_solvers]
    runner.solve(sources([config.large_scene]), large, limit=config.large_iterations, repeats=1)


def _section(runner: Runner) -> Section:
    config = runner.config.figures
    body = [
        "The paper's caption says that explicit means PCG and implicit means Cholesky's method, which is the other way "
        "round in the literature. Here explicit forms the reduced camera system and factors it; implicit runs "
        "preconditioned conjugate gradients without forming it."
    ]
    groups = [
        (figures.main_problem(runner), METHODS, "convergence"),
        (sources([config.large_scene])[0], config.large_solvers, "convergence-large"),
    ]
    for problem, names, file in groups:
        records = runner.records_on([problem], [method_named(name) for name in names])
        if not records:
            body.append(f"{problem.name}: {common.NOT_YET}")
            continue
        drawn = plot_convergence(records, problem.name)
        caption = f"{problem.name}: cost over time and iterations; above dashed at τ = 0.1 and 0.001"
        body.append(figures.picture(runner, drawn, file, caption))
        if file != "convergence":
            sizes = f"{records[0].cameras} cameras, {records[0].points} points, {records[0].observations} observations"
            body.append(
                f"`{config.large_scene}` ({sizes}) is used instead of Ladybug-1197; at most {config.large_iterations} "
                "iterations."
            )
            if not any(r.solver.endswith("/explicit") for r in records):
                body.append("This configuration runs no explicit solver at that size.")
    return Section("Convergence with explicit and implicit solvers", tuple(body))


ENTRY = TableOrFigure("convergence", "Figure: convergence with explicit and implicit solvers", _run, _section)
