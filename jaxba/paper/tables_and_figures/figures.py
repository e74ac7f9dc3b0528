"""Small problems, and the figures (curves in `report.FIGURES`): lambdas, performance profiles,
convergence."""

from __future__ import annotations

import functools
import re
from collections.abc import Iterable

import numpy as np

from jaxba.bench import profile
from jaxba.bench.profile import Target
from jaxba.bench.sources import Source, sources
from jaxba.game.statistics import SHORTEST_TIME, geometric_mean
from jaxba.paper import agents, claims, real_problems
from jaxba.paper.claims import Statement, longer_claim, ratio_claim
from jaxba.paper.real_problems import Problems
from jaxba.paper.runner import ELSEWHERE, Runner
from jaxba.paper.runner import SMALL as SMALL_SCENES
from jaxba.paper.tables_and_figures.common import CERES, CLASSIC, Line, Part, Table, named, ours
from jaxba.problem.bundle_problem import BundleProblem
from jaxba.scenes import SceneConfig, random_scene
from jaxba.solver.record import Record

PAPER_SIZE = 5  # cameras and points of the paper's small problem


def small_scene(size: int, seed: int) -> Source:
    """A random scene of as many points as cameras, all seen by all. Its start has the true focal
    lengths."""

    def make() -> BundleProblem:
        config = SceneConfig(
            size,
            size,
            size * size,
            trajectory="orbit",
            min_depth=4.0,
            max_depth=16.0,
            start_focal=0.0,
        )
        return random_scene(config, seed)

    return Source(f"small-{size}-{seed}", SMALL_SCENES, f"{size} x {size}", make)


def _small(runner: Runner) -> list[Part]:
    config = runner.config
    parts = []
    for size in config.small:
        seeds = range(config.seed, config.seed + config.small_scenes)

        def paper(iterations, size=size):
            return iterations if size == PAPER_SIZE else float("nan")

        lines = [
            named("classic", CLASSIC, paper(5.0)),
            named("Ceres' rule", CERES),
            *ours(runner, paper(4.0)),
        ]
        text = "{}: ours takes four fifths of classic's iterations"
        longer = "{}: ours takes longer in seconds, for the time of inference"
        stated = [
            Statement(ratio_claim, f"{text} (tuned)", 0.8, agents.OURS.name, CLASSIC),
            Statement(ratio_claim, f"{text} (guarded)", 0.8, agents.BEST.name, CLASSIC),
            Statement(longer_claim, f"{longer} (tuned)", "+0.5 s", agents.OURS.name, CLASSIC),
        ]
        problems = Problems(f"{size} x {size}", tuple(small_scene(size, seed) for seed in seeds))
        parts.append(Part(problems, lines, stated if size == PAPER_SIZE else (), repeats=1))
    return parts


SMALL = Table("small", _small)


def main_problem(runner: Runner) -> Problems:
    """The largest Ladybug problem on this machine; a random scene if there is none."""
    families = [
        real_problems.find(family) for family in runner.config.real.bal if family.name == "Ladybug"
    ]
    whole = [source for found in families for source in found.sources if source.make is None]

    def cameras(source):
        return int(next(iter(re.findall(r"\d+", source.name)), "0"))

    chosen = max(whole, key=cameras) if whole else sources([runner.config.figures.scene])[0]
    return Problems(chosen.name, (chosen,))


def _chart(runner: Runner) -> list[Part]:
    """Iterations on the paper's test case. Source: the caption of the paper's figure."""
    lines = [
        named("classic", CLASSIC, 30.0),
        named("schedule", "schedule", 16.0),
        named("Ceres' rule", CERES),
        *ours(runner, 8.0, elsewhere=True),
    ]
    text = "Chart: ours takes 8 of classic's 30 iterations"
    stated = [
        Statement(
            ratio_claim, f"{text} (tuned)", 8 / 30, f"{agents.OURS.name}{ELSEWHERE}", CLASSIC
        ),
        Statement(
            ratio_claim, f"{text} (guarded)", 8 / 30, f"{agents.BEST.name}{ELSEWHERE}", CLASSIC
        ),
    ]
    return [Part(main_problem(runner), lines, stated, repeats=1)]


def _profiles(runner: Runner) -> list[Part]:
    config = runner.config
    scenes = [
        f"{config.figures.scene}:{config.seed + k + 1}"
        for k in range(config.figures.profile_scenes)
    ]
    every = Problems("all", (*real_problems.bal(config.real).sources, *sources(scenes)))
    part = Part(every, [named(name, name) for name in (CLASSIC, CERES)] + ours(runner))

    def claimed(runner: Runner) -> Iterable[claims.Claim]:
        claim = functools.partial(speed_claim, part.records(runner))
        yield claim(0.1, "τ = 0.1: classic is as fast as ours, no acceleration is required", False)
        yield claim(0.001, "τ = 0.001: ours is faster than classic", True)

    return [Part(part.problems, part.lines, more=claimed)]


def speed_claim(records: list[Record], tau: float, text: str, faster: bool) -> claims.Claim:
    """The claim on the ratio of our time to classic's, a geometric mean over the problems on which
    both reach the tolerance. The claim is that ours is faster, or else that it is not; the records
    are solves of both."""
    table = profile.reach_table(records, Target("tau", tau))
    rows = table.get(agents.BEST.name, {}), table.get(CLASSIC, {})
    names = [name for name in rows[0] if name in rows[1]]
    ours, classic = (profile.reached(row, names) for row in rows)
    success = [np.isfinite(one.iterations) for one in (ours, classic)]
    both = success[0] & success[1]
    if not both.any():
        return claims.Claim(text, "figure", "-", "not run")
    one, other = (geometric_mean(times.seconds[both], SHORTEST_TIME) for times in (ours, classic))
    seconds = one / other
    (reached, base) = (float(done.mean()) for done in success)
    detail = f"time {seconds:.2f} of classic's, {both.sum()} of {len(names)} problems"
    lower = reached < base if faster else base < reached
    status: claims.Status
    if lower and abs(reached - base) > claims.FRACTION_TOLERANCE:
        status = "not"
        detail = f"{detail}, reached on {100 * reached:.0f} % against {100 * base:.0f} %"
    elif faster:
        status = (
            "reproduced" if seconds <= claims.PARTLY_RATIO else "partly" if seconds < 1 else "not"
        )
    else:
        alike = claims.PARTLY_RATIO <= seconds <= 1 / claims.PARTLY_RATIO
        status = "reproduced" if alike else "partly" if seconds > 1 else "not"
    return claims.Claim(text, "figure", detail, status)


def _convergence(runner: Runner) -> list[Part]:
    config = runner.config.figures
    large = sources([config.large_scene])[0]

    def lines(linear):
        return [
            *(named(f"{name}, {linear}", f"{name}/{linear}") for name in (CLASSIC, CERES)),
            Line(f"ours: scale-free state and guard, {linear}", runner.agent(agents.BEST, linear)),
            Line(f"its twin, {linear}", runner.agent(agents.BEST, linear, twin=True)),
        ]

    implicit = lines("implicit")
    return [
        Part(main_problem(runner), [*lines("explicit"), *implicit], repeats=1),
        Part(Problems(large.name, (large,)), implicit, repeats=1, limit=config.large_iterations),
    ]


def _figures(runner):
    return {"figures": runner.config.figures}


FIGURES = (
    Table("lambda", _chart),
    Table("profiles", _profiles, _figures),
    Table("convergence", _convergence, _figures),
)
