"""Figure: performance profiles."""

from __future__ import annotations

import math

from jaxba.bench import profile
from jaxba.bench.plots import plot_profiles
from jaxba.bench.profile import RELATIVE_TOLERANCES, Target
from jaxba.bench.records import Record
from jaxba.bench.sources import SCENE_PREFIX, Source, sources
from jaxba.paper import claims, real_problems
from jaxba.paper.markdown import Section
from jaxba.paper.runner import Runner, method_named
from jaxba.paper.tables_and_figures import common, figures
from jaxba.paper.tables_and_figures.common import TableOrFigure

METHODS = ("classic", "ceres", "learned-driver")
TAUS = (0.1, 0.001)
"""Tolerances in the paper's figure."""


def _problems(runner: Runner) -> list[Source]:
    config = runner.config
    scenes = [f"{config.figures.scene}:{config.seed + k + 1}" for k in range(config.figures.profile_scenes)]
    return [*real_problems.bal(config.real), *sources(scenes)]


def _run(runner: Runner) -> None:
    runner.solve(_problems(runner), [method_named(name) for name in METHODS])


def _section(runner: Runner) -> Section:
    problems = _problems(runner)
    records = runner.records_on(problems, [method_named(name) for name in METHODS])
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
        figures.picture(
            runner,
            plot_profiles(records, targets),
            "profiles-tau",
            "Performance profiles, f* + τ(f0 - f*), by time and iterations",
        ),
        figures.picture(
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
    pairs = [(ours[name].seconds, classic[name].seconds) for name in ours if name in classic]
    logs = [math.log(max(a, 1e-6) / max(b, 1e-6)) for a, b in pairs if math.isfinite(a) and math.isfinite(b)]
    if not logs:
        return claims.Claim(text, "figure", "-", "not run")
    found = math.exp(sum(logs) / len(logs))
    reached, base = (sum(math.isfinite(pair[k]) for pair in pairs) / len(pairs) for k in (0, 1))
    detail = f"time {found:.2f} of classic's, {len(logs)} of {len(pairs)} problems"
    lower = reached < base if faster else base < reached
    status: claims.Status
    if lower and abs(reached - base) > claims.FRACTION_TOLERANCE:
        status, detail = "not", f"{detail}, reached on {100 * reached:.0f} % against {100 * base:.0f} %"
    elif faster:
        status = "reproduced" if found <= claims.PARTLY_RATIO else "partly" if found < 1 else "not"
    else:
        status = "reproduced" if found >= claims.PARTLY_RATIO else "not"
    return claims.Claim(text, "figure", detail, status)


ENTRY = TableOrFigure("profiles", "Figure: performance profiles at tau 0.1 and 0.001, and relative", _run, _section)
