"""Figure: performance profiles."""

from __future__ import annotations

import math

from jaxba.bench import profile
from jaxba.bench.plots import plot_profiles
from jaxba.bench.profile import RELATIVE_TOLERANCES, Target
from jaxba.bench.records import Record
from jaxba.bench.sources import Source, sources
from jaxba.paper import claims, places
from jaxba.paper.markdown import Section
from jaxba.paper.pieces import base, figures
from jaxba.paper.pieces.base import Piece
from jaxba.paper.workshop import Workshop, named

METHODS = ("classic", "ceres", "ceres+embedded", "learned-driver", "learned")
TAUS = (0.1, 0.001)
"""Tolerances of the paper's figure."""


def _problems(shop: Workshop) -> list[Source]:
    config = shop.config
    scenes = [f"{config.figures.scene}:{config.seed + k + 1}" for k in range(config.figures.profile_scenes)]
    return [*places.bal_and_parts(config.real), *sources(scenes)]


def _work(shop: Workshop) -> None:
    shop.solve(_problems(shop), [named(name) for name in METHODS])


def _section(shop: Workshop) -> Section:
    problems = _problems(shop)
    records = shop.records_on(problems, [named(name) for name in METHODS])
    if not records:
        return Section("Performance profiles", (base.NOT_YET,))
    targets = [Target("tau", tau) for tau in TAUS]
    relative = [Target("relative", epsilon) for epsilon in RELATIVE_TOLERANCES]
    count = len(profile.problem_names(records))
    reason = places.why_no_bal(shop.config.real)
    body = [
        f"{base.problems(count)}: those of BAL at hand and their parts, and {shop.config.figures.profile_scenes} "
        "random "
        "scenes like "
        f"{shop.config.figures.scene.removeprefix('scene:')}.{f' BAL: {reason}.' if reason else ''} Times without "
        "compilation.",
        figures.picture(
            shop,
            plot_profiles(records, targets),
            "profiles-tau",
            "Performance profiles, f* + τ(f0 - f*), by time and iterations",
        ),
        figures.picture(
            shop, plot_profiles(records, relative), "profiles-relative", "The same relative to the best cost, f*(1 + ε)"
        ),
        "τ = 0.001 of a start far away is reached in the first iterations; the relative ones show the rest.",
    ]
    found = (
        _speed_claim(records, 0.1, "τ = 0.1: classic is as fast as ours, no acceleration is required", False),
        _speed_claim(records, 0.001, "τ = 0.001: ours is faster than classic", True),
    )
    return Section("Performance profiles", tuple(body), found)


def _speed_claim(records: list[Record], tau: float, text: str, faster: bool) -> claims.Claim:
    """Compares the geometric mean of the seconds of the two on the problems that both reach."""
    table = profile.reach_table(records, Target("tau", tau))
    ours, classic = table.get("learned-driver", {}), table.get("classic", {})
    pairs = [(ours[name].seconds, classic[name].seconds) for name in ours if name in classic]
    logs = [math.log(max(a, 1e-6) / max(b, 1e-6)) for a, b in pairs if math.isfinite(a) and math.isfinite(b)]
    if not logs:
        return claims.Claim(text, "figure", "-", "not run")
    found = math.exp(sum(logs) / len(logs))
    verdict: claims.Verdict
    if faster:
        verdict = "reproduced" if found <= claims.ANY_GAIN else "partly" if found < 1 else "not"
    else:
        verdict = "reproduced" if found >= claims.ANY_GAIN else "not"
    return claims.Claim(text, "figure", f"time {found:.2f} of classic's, {len(logs)} of {len(pairs)} problems", verdict)


PIECE = Piece("profiles", "Figure: performance profiles at tau 0.1 and 0.001, and relative", _work, _section)
