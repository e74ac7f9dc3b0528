"""The figures: lambda over the iterations, performance profiles, convergence."""

from __future__ import annotations

import re
from itertools import pairwise
from pathlib import Path

from matplotlib.figure import Figure

from jaxba.bench import profile
from jaxba.bench.plots import plot_convergence, plot_lambda, plot_profiles
from jaxba.bench.profile import RELATIVE_TOLERANCES, Target, converged
from jaxba.bench.sources import SCENE_PREFIX, Source, sources
from jaxba.game.statistics import compare
from jaxba.paper import claims, real_problems
from jaxba.paper.markdown import Section
from jaxba.paper.runner import ELSEWHERE, Method, Runner, method_named
from jaxba.paper.tables_and_figures import common
from jaxba.paper.tables_and_figures.common import TableOrFigure
from jaxba.runtime.atomic import atomic_write
from jaxba.solver.record import Record

FIGURES = "figures"
"""Folder of the figures inside the folder of the run."""

RESOLUTIONS = (100, 80, 60)
"""Resolutions in dots per inch; the first that keeps the file below `LARGEST` is used, else the last."""

LARGEST = 200_000
"""Limit of the size of a figure, bytes."""


def main_problem(runner: Runner) -> Source:
    """The largest Ladybug problem on this machine; a random scene if there is none."""
    found = [
        s for family in real_problems.families(runner.config.real) if family.family == "Ladybug" for s in family.whole
    ]
    return max(found, key=_cameras) if found else sources([runner.config.figures.scene])[0]


def _cameras(source: Source) -> int:
    digits = re.findall(r"\d+", source.name)
    return int(digits[0]) if digits else 0


def picture(runner: Runner, figure: Figure, name: str, caption: str) -> str:
    """Writes a figure into the folder of the run and returns the Markdown that shows it."""
    folder = runner.folder / FIGURES
    folder.mkdir(parents=True, exist_ok=True)
    path: Path = folder / f"{name}.png"
    with atomic_write(path) as file:
        for dpi in RESOLUTIONS:
            file.seek(0)
            file.truncate()
            figure.savefig(file, dpi=dpi, format="png")
            if file.tell() < LARGEST:
                break
    return f"![{caption}]({FIGURES}/{name}.png)\n\n*{caption}*"


# Lambda over the iterations

CHART_ITERATIONS = {"classic": 30, "schedule": 16, ELSEWHERE: 8}
"""Iterations on the paper's test case. Source: the caption of the paper's figure."""


def _chart_methods(runner: Runner) -> list[Method]:
    return [*map(method_named, ("classic", "schedule", "ceres", "learned-driver")), runner.agent_trained_elsewhere()]


def _run_chart(runner: Runner) -> None:
    runner.solve([main_problem(runner)], _chart_methods(runner), repeats=1)


def _chart_section(runner: Runner) -> Section:
    problem = main_problem(runner)
    records = runner.records_on([problem], _chart_methods(runner))
    pair = [
        (runner.row_on([problem], m) if any(r.solver == m.name for r in records) else None)
        for m in _chart_methods(runner)
    ]
    found = (claims.ratio_claim("Chart: ours takes 8 of classic's 30 iterations", 8 / 30, pair[4], pair[0]),)
    if not records:
        return Section("Lambda over the iterations", (common.NOT_YET,), found)
    caption = f"{problem.name}: lambda of each iteration, rejected ones hollow; right: the last ten of classic"
    counts = {r.solver: (r.iterations, converged(r)) for r in records if r.repeat == 0}
    paper = {name: f" (paper {count})" for name, count in CHART_ITERATIONS.items()}
    counts_text = [
        f"{name} {count}{'' if good else ' (not converged)'}{paper.get(name, '')}"
        for name, (count, good) in counts.items()
    ]
    flat = next((r for r in records if r.solver == ELSEWHERE), None)
    body = [picture(runner, plot_lambda(records, problem.name), "lambda", caption)]
    body.append(f"Iterations on {problem.name}: {', '.join(counts_text)}. The paper does not name its test case.")
    if flat is not None and len(flat.trace) > 2:
        steps = [p.damping for p in flat.trace[1:]]
        factors = {round(b / a, 3) for a, b in pairwise(steps)}
        body.append(
            f"The agent used {len(factors)} different factors between its {len(steps)} lambdas; classic has two."
        )
    return Section("Lambda over the iterations", tuple(body), found)


LAMBDA = TableOrFigure("lambda", "Figure: chosen lambdas over the iterations", _run_chart, _chart_section)


# Performance profiles

PROFILED = ("classic", "ceres", "learned-driver")
TAUS = (0.1, 0.001)
"""Tolerances in the paper's figure."""


def _profile_problems(runner: Runner) -> list[Source]:
    config = runner.config
    scenes = [f"{config.figures.scene}:{config.seed + k + 1}" for k in range(config.figures.profile_scenes)]
    return [*real_problems.bal(config.real), *sources(scenes)]


def _run_profiles(runner: Runner) -> None:
    runner.solve(_profile_problems(runner), [method_named(name) for name in PROFILED])


def _profiles_section(runner: Runner) -> Section:
    problems = _profile_problems(runner)
    records = runner.records_on(problems, [method_named(name) for name in PROFILED])
    found = (
        _speed_claim(records, 0.1, "τ = 0.1: classic is as fast as ours, no acceleration is required", False),
        _speed_claim(records, 0.001, "τ = 0.001: ours is faster than classic", True),
    )
    if not records:
        return Section("Performance profiles", (common.NOT_YET,), found)
    targets = [Target("tau", tau) for tau in TAUS]
    relative = [Target("relative", epsilon) for epsilon in RELATIVE_TOLERANCES]
    names = profile.problem_names(records)
    scenes = sum(source.location.startswith(SCENE_PREFIX) for source in problems if source.name in names)
    reason = real_problems.reason_without_bal(runner.config.real)
    body = [
        f"{common.problems(len(names))}: those of BAL on this machine, their sub-problems, and "
        f"{scenes} random scenes like "
        f"{runner.config.figures.scene.removeprefix('scene:')}.{f' BAL: {reason}.' if reason else ''} Times are "
        "without compilation.",
        picture(
            runner,
            plot_profiles(records, targets),
            "profiles-tau",
            "Performance profiles, f* + τ(f0 - f*), by time and iterations",
        ),
        picture(
            runner,
            plot_profiles(records, relative),
            "profiles-relative",
            "The same relative to the best cost, f*(1 + ε)",
        ),
        "From a distant start, τ = 0.001 is reached in the first iterations; the relative tolerances show the rest.",
    ]
    return Section("Performance profiles", tuple(body), found)


def _speed_claim(records: list[Record], tau: float, text: str, faster: bool) -> claims.Claim:
    """The claim on the ratio of our time to classic's, a geometric mean over the problems on which both reach the
    tolerance.

    Args:
        records: solves of both.
        tau: tolerance.
        text: the claim in words.
        faster: whether the claim is that ours is faster; otherwise, that it is not.
    """
    table = profile.reach_table(records, Target("tau", tau))
    ours, classic = table.get("learned-driver", {}), table.get("classic", {})
    names = [name for name in ours if name in classic]
    found = compare(profile.reached(ours, names), profile.reached(classic, names))
    if not found.both:
        return claims.Claim(text, "figure", "-", "not run")
    reached, base = ((found.both + alone) / len(names) for alone in (found.only_solver, found.only_yardstick))
    detail = f"time {found.seconds:.2f} of classic's, {found.both} of {len(names)} problems"
    lower = reached < base if faster else base < reached
    status: claims.Status
    if lower and abs(reached - base) > claims.FRACTION_TOLERANCE:
        status, detail = "not", f"{detail}, reached on {100 * reached:.0f} % against {100 * base:.0f} %"
    elif faster:
        status = "reproduced" if found.seconds <= claims.PARTLY_RATIO else "partly" if found.seconds < 1 else "not"
    else:
        status = "reproduced" if found.seconds >= claims.PARTLY_RATIO else "not"
    return claims.Claim(text, "figure", detail, status)


PROFILES = TableOrFigure(
    "profiles", "Figure: performance profiles at tau 0.1 and 0.001, and relative", _run_profiles, _profiles_section
)


# Convergence with explicit and implicit solvers

CONVERGING = tuple(
    f"{policy}/{linear}" for policy in ("classic", "ceres", "learned-driver") for linear in ("explicit", "implicit")
)


def _run_convergence(runner: Runner) -> None:
    config = runner.config.figures
    runner.solve([main_problem(runner)], [method_named(name) for name in CONVERGING], repeats=1)
    large = [method_named(name) for name in config.large_solvers]
    runner.solve(sources([config.large_scene]), large, limit=config.large_iterations, repeats=1)


def _convergence_section(runner: Runner) -> Section:
    config = runner.config.figures
    body = [
        "The paper's caption says that explicit means PCG and implicit means Cholesky's method, which is the other way "
        "round in the literature. Here explicit forms the reduced camera system and factors it; implicit runs "
        "preconditioned conjugate gradients without forming it."
    ]
    groups = [
        (main_problem(runner), CONVERGING, "convergence"),
        (sources([config.large_scene])[0], config.large_solvers, "convergence-large"),
    ]
    for problem, names, file in groups:
        records = runner.records_on([problem], [method_named(name) for name in names])
        if not records:
            body.append(f"{problem.name}: {common.NOT_YET}")
            continue
        drawn = plot_convergence(records, problem.name)
        caption = f"{problem.name}: cost over time and iterations; above dashed at τ = 0.1 and 0.001"
        body.append(picture(runner, drawn, file, caption))
        if file != "convergence":
            sizes = f"{records[0].cameras} cameras, {records[0].points} points, {records[0].observations} observations"
            body.append(
                f"`{config.large_scene}` ({sizes}) is used instead of Ladybug-1197; at most {config.large_iterations} "
                "iterations."
            )
            if not any(r.solver.endswith("/explicit") for r in records):
                body.append("This configuration runs no explicit solver at that size.")
    return Section("Convergence with explicit and implicit solvers", tuple(body))


CONVERGENCE = TableOrFigure(
    "convergence", "Figure: convergence with explicit and implicit solvers", _run_convergence, _convergence_section
)
