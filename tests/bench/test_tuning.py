"""Races of settings: on rigged families with a known best one, and what a solve of a window counts."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
import support
from compilations import Compilations

import jaxba
from jaxba import SolveOptions, random_scene, write_problem
from jaxba.bench import tuning
from jaxba.bench.tuning import DEFAULT, LIMIT, ROUND, Candidate, Played, Window, prices, tune, windows_of
from jaxba.solver.names import parse_policy
from jaxba.solver.options import MAX_ITERATIONS

WINDOWS = tuple([Window(support.tiny(), 1.0, 0.01, float(k)) for k in range(start, start + 24)] for start in (0, 100))
"""To race on, and held out; told apart by a number."""

BEST = Candidate("guarded:1e-05", 2, "trials", 0.1)


class Family:
    """Solves that all end alike, at prices with a factor for each setting and noise of each solve."""

    def __init__(self, seed: int = 0, noise: float = 0.2, **better: float) -> None:
        self.seed, self.noise, self.better, self.calls = seed, noise, better, Counter[Candidate]()

    def __call__(self, candidate: Candidate, window: Window) -> Played:
        self.calls[candidate] += 1
        own = [*map(ord, str(candidate)), int(window.point_s), self.seed]
        noise = np.exp(self.noise * np.random.default_rng(own).normal())
        factors = [x for name, x in self.better.items() if getattr(candidate, name) == getattr(BEST, name)]
        return Played(float(10 * noise * np.prod(factors)), 1.0)


def test_the_known_best_setting_of_a_family_is_found():
    found = tune(WINDOWS, np.inf, play=Family(policy=0.6, refine_points=0.8, repairs=0.8, min_gain=0.7))
    assert (found.chosen, found.winner, found.in_time, found.windows[1]) == (BEST, BEST, True, 24)
    assert found.held_out[1] <= 0.6 * 0.8 * 0.8 * 0.7 <= found.held_out[2] < 1


def test_the_default_stays_to_the_end_of_a_race_and_what_is_far_worse_leaves_after_a_round():
    family = Family(repairs=5.0)
    found = tune(WINDOWS, np.inf, play=family)
    assert DEFAULT in [one for one, _, _ in found.rows]
    assert {count for one, count in family.calls.items() if one.repairs == BEST.repairs} == {ROUND}
    assert family.calls[DEFAULT] >= 24


def test_where_nothing_is_better_the_default_is_kept():
    """In races of equals, which somebody wins by luck, it is replaced about as seldom as its interval says."""
    assert (
        tune(WINDOWS, np.inf, play=Family(policy=1.5, refine_points=1.5, repairs=1.5, min_gain=1.5)).chosen == DEFAULT
    )
    replaced = [tune(WINDOWS, np.inf, play=Family(seed)).chosen != DEFAULT for seed in range(8)]
    assert sum(replaced) <= 1


def test_no_time_for_a_round_is_said_and_the_default_kept():
    found = tune(WINDOWS, 0.0, play=Family())
    assert (found.chosen, found.rows, found.windows, found.in_time) == (DEFAULT, [], (0, 0), False)


def test_a_solve_that_ends_too_high_or_not_at_all_costs_as_much_as_a_hundred_iterations():
    other, slow = Candidate(min_gain=0.0), 7.0
    played = {
        DEFAULT: [Played(3.0, 1.0), Played(4.0, 2.0), Played(5.0, np.inf)],
        other: [Played(2.0, 1.0009), Played(slow, 2.0 * 1.002), Played(1.0, np.inf)],
    }
    window = Window(support.tiny(), 1.0, 0.1, 0.2)
    failed = MAX_ITERATIONS * 1.3
    cost = prices(played, [window] * 3, 1e-3)
    np.testing.assert_allclose(cost[DEFAULT], [3, 4, failed])
    np.testing.assert_allclose(cost[other], [2, failed, failed])


def test_a_price_counts_what_a_solve_did_and_numbers_alone_compile_nothing():
    window = Window(support.tiny(), 1.0, 0.1, 0.01)
    options = SolveOptions(max_iterations=LIMIT, pad=True, compilation="quick")
    steps = jaxba.solve(support.tiny(), "guarded", options).history
    found = tuning.play(DEFAULT, window)
    np.testing.assert_allclose(found.price, len(steps.cost) * 1.11 + steps.repairs.sum() * 0.12)
    np.testing.assert_allclose(found.cost, steps.cost[-1], rtol=1e-12)
    with Compilations() as compiled:
        tuning.play(Candidate("guarded:1e-05", min_gain=0.1), window)
    assert compiled.names == []


@pytest.fixture(scope="module")
def file(tmp_path_factory) -> str:
    path = tmp_path_factory.mktemp("problems") / "street.txt"
    write_problem(random_scene(jaxba.SceneConfig(cameras=24, points=400), 0), path)
    return str(path)


def test_both_halves_of_the_windows_are_of_other_cameras_and_always_the_same(file):
    problem, halves = jaxba.read_problem(file), windows_of([file], 16, 3)
    camera_of = {tuple(x): int(k) for x, k in zip(problem.observations.tolist(), problem.camera_index, strict=True)}
    seen = [{camera_of[tuple(x)] for one in half for x in one.problem.observations.tolist()} for half in halves]
    assert [len(half) for half in halves] == [16, 16]
    assert not seen[0] & seen[1]
    for one, same in zip(halves[0], windows_of([file], 16, 3)[0], strict=True):
        assert np.array_equal(one.problem.cameras, same.problem.cameras)


def test_a_lambda_of_guarded_has_its_step():
    for name in ("guarded:1e-05", "guarded"):
        assert parse_policy(name).build()[1] == parse_policy("guarded").build()[1]
