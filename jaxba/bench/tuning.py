"""A race of settings of the step on windows of one's own problems, for settings that make their solves cheaper.

The windows of every file are cut from two halves of its cameras. On the first half settings race: in rounds of a few
windows, after each of which those leave that are significantly worse than the best. The winner meets the default on the
second half, and only if the whole 95% interval of its price is below the default's it is found to be better. So what is
found is never worse by this measure than the default.

A price is predicted, not measured: linear solves and what follows them are counted, and weighted with the seconds that
each takes on the whole file (solver/choose.py). So the same race has the same end on every machine, however busy.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from jaxba.damping.registry import GUARDED
from jaxba.game.random_scenes import SceneClass
from jaxba.game.scene_bank import MIN_OBSERVATIONS
from jaxba.game.scene_layout import scene_problem
from jaxba.game.statistics import geometric_mean, paired_ratio
from jaxba.game.windows import FEWEST_CAMERAS, covisible, places, read_all, window
from jaxba.problem import geometry
from jaxba.problem.bundle_problem import BundleProblem, ProblemError, ProblemWarning
from jaxba.solver.choose import predict
from jaxba.solver.names import Repairs, adjusted, parse_policy
from jaxba.solver.options import MAX_ITERATIONS
from jaxba.solver.solve import solve
from jaxba.structure.padding import MIN_OBSERVATIONS as MIN_SLOTS
from jaxba.structure.padding import slots_for

WINDOW = SceneClass(8, 256, "windows")
"""Windows have this many cameras, if half of a file has, and as many points as fit the smallest padded size: so they
share programs. With 100 points and 12 cameras the lenses were hardly determined, and half of the solves failed."""

HALF = 0.5
"""Share of a file's cameras whose windows are held out."""

LIMIT = 50
"""Most linear solves of a race; what has not ended by then has failed."""

ROUND = 8
"""Windows of a round."""

RACE_SHARE = 0.65
"""Share of the time for the race; the rest is for the held-out windows."""

EVALUATION_S, POINT_S = 2e-8, 4e-8
"""Seconds per observation of a cost and of an embedded point iteration. Measured on Ladybug-49: 0.6 ms, and 3.9 ms for
three (`python -m benchmarks.phases`). A repair with a camera round takes about a point iteration more."""


class Candidate(NamedTuple):
    """Settings of a step by the names of the options of `jaxba-solve`; None: what follows from the policy."""

    policy: str = GUARDED
    refine_points: int | None = None
    repairs: Repairs | None = None
    min_gain: float | None = None

    @property
    def settings(self) -> dict[str, str | int | float]:
        """The options that are given, as a file for `jaxba-solve --settings` has them."""
        return {name.replace("_", "-"): value for name, value in self._asdict().items() if value is not None}

    def __str__(self) -> str:
        return " ".join(f"{name} {value}" for name, value in self.settings.items()).removeprefix("policy ")


DEFAULT = Candidate()

LAMBDAS, GAINS = (1e-10, 1e-7, 1e-6, 1e-5, 1e-4, 1e-3), (0.0, 0.05, 0.1, 0.5)
"""Lambdas of `guarded` in the first race, and smallest gain ratios in the second. They share the default's program."""

STEPS: tuple[tuple[int, Repairs], ...] = ((2, "all"), (1, "trials"), (2, "trials"), (1, "none"))
"""Point iterations and repairs of the third race, each a program of its own."""


class Window(NamedTuple):
    """A part of a problem, and predicted seconds of the work of a step on the whole."""

    problem: BundleProblem
    linear_s: float  # a linear solve
    evaluation_s: float  # a cost
    point_s: float  # a point iteration

    def price(self, iterations: int, repairs: int = 0, points: int = 1) -> float:
        """Predicted seconds of so many iterations and repairs with that many point iterations in each."""
        each = self.evaluation_s + points * self.point_s
        return iterations * (self.linear_s + each) + repairs * (each + self.point_s)


class Played(NamedTuple):
    """A solve of a window."""

    price: float
    cost: float  # at the end, pixels^2; infinite if it did not converge


Row = tuple[Candidate, int, tuple[float, float, float]]
"""A candidate in a round of a race: its failures, and its price over that of the default with its 95% interval."""


class Found(NamedTuple):
    """What a race has found."""

    chosen: Candidate  # the winner if it is better than the default, else the default
    winner: Candidate
    held_out: tuple[float, float, float]  # its price over that of the default, and its 95% interval; or NaN
    windows: tuple[int, int]  # of the last round, held out
    rows: list[Row]  # the last round, the best first
    in_time: bool  # whether the clock has cut nothing off


Play = Callable[[Candidate, Window], Played]
"""Solves a window with some settings; `play`, but for tests."""


def windows_of(paths: Sequence[str], count: int, seed: int) -> tuple[list[Window], list[Window]]:
    """Windows of the files in turn: at most so many to race on, and as many held out.

    Raises:
        ProblemError: as `read_all`, or there are too few usable windows. One line.
    """
    race: list[list[Window]] = []
    held_out: list[list[Window]] = []
    for number, problem in enumerate(read_all(paths, HALF)):
        rng, linked, views = np.random.default_rng([seed, number]), covisible(problem), problem.num_observations
        one = views * EVALUATION_S, views * POINT_S
        linear_s = max(min(predict(problem).values()) - one[0] - 3 * one[1], one[1])
        for half, cameras in zip((race, held_out), places(linked, HALF), strict=True):
            made = -(-count // len(paths)) if len(cameras) >= FEWEST_CAMERAS else 0
            scenes = [window(problem, WINDOW, linked, cameras, rng, WINDOW.cameras, 0.0) for _ in range(made)]
            seen = [scene for scene in scenes if np.sum(scene.mask) >= MIN_OBSERVATIONS]
            found = [_thinned(scene_problem(WINDOW, jax.tree.map(lambda x: x[None], scene), 0)) for scene in seen]
            half.append([Window(part, linear_s, *one) for part in found if np.isfinite(geometry.cost(part))])
    in_turn = lambda half: [part[k] for k in range(count) for part in half if k < len(part)][:count]
    least = min(len(in_turn(race)), len(in_turn(held_out)))
    if least < ROUND:
        raise ProblemError(f"only {least} windows of half of the cameras are usable, a round has {ROUND}")
    return in_turn(race), in_turn(held_out)


def _thinned(problem: BundleProblem) -> BundleProblem:
    """The first points of a problem, in random order, as many as fit the smallest padded size."""
    tracks = np.bincount(problem.point_index, minlength=problem.num_points)
    slots = np.array([slots_for(tracks[:count]) for count in range(1, len(tracks) + 1)])
    kept = int(np.searchsorted(slots, MIN_SLOTS, side="right"))
    return problem.subset(problem.point_index < kept, points=np.arange(kept))


def play(candidate: Candidate, part: Window) -> Played:
    """Solves a window with these settings. Programs are shared by all windows of a padded size."""
    name = parse_policy(candidate.policy)
    if candidate.refine_points is not None:
        name = replace(name, refine_points=candidate.refine_points)
    policy, options = adjusted(*name.build(), candidate.repairs, candidate.min_gain)
    options = replace(options, max_iterations=LIMIT, pad=True, compilation="quick")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ProblemWarning)  # of a window; the file's own were shown
        found = solve(part.problem, policy, options)
    points = 0 if options.refinement is None else options.refinement.points
    price = part.price(found.iterations, int(np.sum(found.history.repairs)), points)
    return Played(price, found.final_cost if found.converged else np.inf)


def prices(
    played: Mapping[Candidate, Sequence[Played]], windows: Sequence[Window], within: float
) -> dict[Candidate, Float[np.ndarray, " windows"]]:
    """The price of each window. A solve has failed that has not converged, or that ends more than `within` above the
    lowest cost of all candidates, relatively. It costs as much as `MAX_ITERATIONS` iterations, and none costs more."""
    lowest, found = np.full(len(windows), np.inf), {}
    for solves in played.values():
        lowest[: len(solves)] = np.minimum(lowest[: len(solves)], [solve.cost for solve in solves])
    for one, solves in played.items():
        price, cost = np.array(solves).T
        failed = ~(np.isfinite(cost) & (cost <= lowest[: len(cost)] * (1 + within)))
        found[one] = np.where(failed, np.inf, price).clip(max=failure(windows[: len(cost)]))
    return found


def failure(windows: Sequence[Window]) -> Float[np.ndarray, " windows"]:
    """The price of a failure on each window."""
    return np.array([part.price(MAX_ITERATIONS) for part in windows])


def race(
    candidates: Sequence[Candidate],
    windows: Sequence[Window],
    within: float,
    played: dict[Candidate, list[Played]],
    play: Play,
) -> Iterator[tuple[int, list[Row]]]:
    """Rounds of `ROUND` windows each, until the best one and the default are alone or the windows end. Gives the number
    of windows and the candidates of each, the best first. `played` has solves of earlier races, and is added to."""
    alive = list(dict.fromkeys(candidates))
    for end in range(ROUND, len(windows) + 1, ROUND):
        for one in alive:
            solves = played.setdefault(one, [])
            solves.extend(play(one, part) for part in windows[len(solves) : end])
        cost = prices(played, windows, within)
        seen = {one: cost[one][:end] for one in alive}
        alive.sort(key=lambda one: geometric_mean(seen[one]))
        failures = {one: int(np.sum(seen[one] >= failure(windows[:end]))) for one in alive}
        yield end, [(one, failures[one], paired_ratio(seen[one], seen[DEFAULT])) for one in alive]
        best = alive[0]
        alive = [one for one in alive if one in (DEFAULT, best) or paired_ratio(seen[one], seen[best])[1] <= 1]
        if len(alive) <= 2 and alive[-1] == DEFAULT:
            return


def tune(
    windows: tuple[Sequence[Window], Sequence[Window]],
    seconds: float,
    within: float = 1e-3,
    play: Play = play,
    report: Callable[[str], None] = lambda _: None,
) -> Found:
    """Races lambdas, then smallest gain ratios of the best, then steps, and holds the winner against the default.

    Args:
        windows: to race on, and held out; as `windows_of` gives them.
        seconds: after which no solve begins any more.
        within: a solve fails that ends further above the best known cost, relatively.
        play: solves a window.
        report: called with a line of progress after each round.
    """
    began, in_time = time.perf_counter(), True

    def until(share: float) -> Play:
        def timed(candidate: Candidate, part: Window) -> Played:
            if time.perf_counter() - began > share * seconds:
                raise TimeoutError
            return play(candidate, part)

        return timed

    winner, count, rows, played, apart = DEFAULT, 0, [], {}, {}
    lambdas = lambda best: [best._replace(policy=f"{GUARDED}:{value:g}") for value in LAMBDAS]
    gains = lambda best: [best._replace(min_gain=value) for value in GAINS]
    steps = lambda best: [best._replace(refine_points=k, repairs=kind) for k, kind in STEPS]
    try:
        for stage in (lambdas, gains, steps):
            for count, rows in race([DEFAULT, winner, *stage(winner)], windows[0], within, played, until(RACE_SHARE)):
                winner, _, (ratio, *_) = rows[0]
                report(f"{count} windows, {len(rows)} settings: best {winner}, {ratio:.2f} of the default")
    except TimeoutError:
        in_time = False
    ratio, chosen = (np.nan, np.nan, np.nan), DEFAULT
    if winner != DEFAULT:
        apart = {winner: [], DEFAULT: []}
        try:
            for part in windows[1]:
                for one, solve in [(one, until(1.0)(one, part)) for one in apart]:
                    apart[one].append(solve)
        except TimeoutError:
            in_time = False
        if len(apart[DEFAULT]) >= ROUND:
            cost = prices(apart, windows[1], within)
            ratio = paired_ratio(cost[winner], cost[DEFAULT])
            chosen = winner if ratio[2] < 1 else DEFAULT
    return Found(chosen, winner, ratio, (count, len(apart.get(DEFAULT, ()))), rows, in_time)
