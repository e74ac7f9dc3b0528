"""Scenes of the game cut from real problems."""

from __future__ import annotations

import functools

import jax
import numpy as np
import pytest
from tiny_game import problem_of

from jaxba import BundleProblem, ProblemError, StepOptions, random_scene, scene_like, write_problem
from jaxba.game import windows
from jaxba.game.random_scenes import SceneClass
from jaxba.game.scene_bank import BankConfig, initial_costs, make_split
from jaxba.game.windows import covisible, places, read_windows, window
from jaxba.problem import geometry
from jaxba.training import config as configs

KIND = SceneClass(6, 20, "windows")


@functools.cache
def street() -> BundleProblem:
    return random_scene(scene_like("ladybug-49"), 0)


@pytest.fixture(scope="module")
def file(tmp_path_factory) -> str:
    path = tmp_path_factory.mktemp("problems") / "street.txt"
    write_problem(street(), path)
    return str(path)


def test_two_cameras_have_as_many_points_in_common_as_counted_one_by_one():
    problem = street()
    seen = [set(problem.point_index[problem.camera_index == k].tolist()) for k in range(6)]
    np.testing.assert_array_equal(
        covisible(problem)[:6, :6], [[len(one & other) for other in seen] for one in seen]
    )


def test_cameras_of_training_and_held_out_windows_are_disjoint_and_all():
    train, held_out = places(covisible(street()))
    assert len(held_out) == round(0.2 * street().num_cameras)
    assert sorted([*train, *held_out]) == list(range(street().num_cameras))


def test_a_window_holds_what_the_problem_holds(file):
    """Cameras, points and pixels are the problem's and belong together; of about half of them the
    starts, too."""
    problem = street()
    unmoved = 0
    train, held_out = read_windows([file], KIND, 20, seed=0)
    assert (len(train.mask), len(held_out.mask)) == (16, 4)
    view_of = {tuple(x): k for k, x in enumerate(problem.observations.tolist())}
    costs = np.asarray(initial_costs(KIND, train))
    for k in range(16):
        one = problem_of(KIND, train, k)
        views = np.array([view_of[tuple(x)] for x in one.observations.tolist()])
        for own, theirs in (
            (one.camera_index, problem.camera_index),
            (one.point_index, problem.point_index),
        ):
            pairs = {(int(a), int(b)) for a, b in zip(own, np.asarray(theirs)[views], strict=True)}
            assert len(pairs) == len({a for a, _ in pairs}) == len({b for _, b in pairs})
        assert np.bincount(one.camera_index).max() <= KIND.points
        np.testing.assert_allclose(costs[k], geometry.cost(one), rtol=1e-9)
        same = np.array_equal(
            one.cameras[one.camera_index], problem.cameras[problem.camera_index[views]]
        )
        assert same == np.array_equal(
            one.points[one.point_index], problem.points[problem.point_index[views]]
        )
        unmoved += same
    assert 3 <= unmoved <= 13


def test_held_out_windows_have_other_cameras(file):
    camera_of = {
        tuple(x): int(k)
        for x, k in zip(street().observations.tolist(), street().camera_index, strict=True)
    }
    used = [
        {
            camera_of[tuple(x)]
            for k in range(len(part.mask))
            for x in problem_of(KIND, part, k).observations.tolist()
        }
        for part in read_windows([file], KIND, 40, seed=1)
    ]
    assert all(used)
    assert not used[0] & used[1]


def test_the_same_seed_gives_the_same_window():
    linked = covisible(street())
    allowed = np.arange(20)
    one, same, other = (
        window(street(), KIND, linked, allowed, np.random.default_rng(seed)) for seed in (0, 0, 1)
    )
    assert all(np.array_equal(a, b) for a, b in zip(one, same, strict=True))
    assert not np.array_equal(one.pixels, other.pixels)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: random_scene(scene_like("paper"), 0), "no problem has 20 cameras"),
        (
            lambda: street().replace(
                whitening=np.tile(np.eye(2), (street().num_observations, 1, 1))
            ),
            "covariances",
        ),
    ],
    ids=["small", "whitened"],
)
def test_problems_that_have_no_windows_are_refused_in_one_line(make, message, monkeypatch):
    monkeypatch.setattr(windows, "read_problem", lambda path: make())
    with pytest.raises(ProblemError, match=message) as found:
        read_windows(["a.txt"], KIND, 10, 0)
    assert "\n" not in str(found.value)


def test_problems_without_windows_and_windows_without_problems_are_refused(file):
    for kind, problems in ((KIND, ()), (SceneClass(), (file,))):
        with pytest.raises(ValueError, match="go together"):
            BankConfig(kind=kind, scenes=10, problems=problems)


def test_a_configuration_with_problems_has_windows(file):
    found = configs.with_problems(configs.load("default", ["bank.kind.points=20"]), [file])
    assert (found.bank.kind, found.bank.problems) == (SceneClass(10, 20, "windows"), (file,))


@pytest.mark.slow
def test_a_bank_of_windows_has_best_costs_and_held_out_windows(file):
    config = BankConfig(kind=KIND, scenes=40, problems=(file,), refine_points=1)
    split = make_split(config, jax.random.key(0), StepOptions(), 40)
    for bank in split:
        assert len(bank.best_cost) > 0
        assert (bank.best_cost < bank.initial_cost).all()
    assert len(split.train.best_cost) > len(split.held_out.best_cost)
