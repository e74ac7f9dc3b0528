"""Policies played on scenes, each as `jaxba.solve` solves it, and the scores of that."""

from __future__ import annotations

import functools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import solve
from tiny_game import AGENT, KIND, grid, problem_of, tiny_bank

from jaxba import StepOptions, make_method, make_policy
from jaxba.damping.features import observation_size
from jaxba.damping.learned import Layer, LearnedPolicy, always
from jaxba.game.env import GameConfig
from jaxba.game.evaluate import (
    CONSTANT_ACTIONS,
    best_constant_action,
    evaluate,
    play_all,
    score,
    scores,
)
from jaxba.game.random_scenes import (
    MOST_CAMERAS,
    MOST_POINTS,
    SceneClass,
    make_scenes,
)
from jaxba.game.rollout import Trajectories, alike, play
from jaxba.game.scene_bank import Bank, info_of, initial_costs, reach, select
from jaxba.game.scene_layout import class_layout, with_scene
from jaxba.game.statistics import paired_ratio
from jaxba.lm.records import LMState
from jaxba.lm.step import lm_step
from jaxba.problem.options import Refinement
from jaxba.runtime.groups import GROUP, step_groups

LIMIT = 25

CERES = make_policy("ceres")


@functools.cache
def played() -> Trajectories:
    """Ceres' rule on every scene of the bank."""
    return play(KIND, tiny_bank(), CERES, StepOptions(), LIMIT)


def test_the_bank_is_large_enough_to_test_with():
    assert 12 <= len(tiny_bank().initial_cost) <= 110


@pytest.mark.slow
def test_a_scene_is_played_as_it_is_solved():
    bank = tiny_bank()
    found = played()
    for k in (0, 5):
        alone = solve(problem_of(KIND, bank.scenes, k), "ceres", max_iterations=LIMIT)
        count = min(5, alone.iterations)
        expected = np.concatenate([[alone.initial_cost], alone.history.cost])[: count + 1]
        np.testing.assert_allclose(found.costs[k, : count + 1], expected, rtol=1e-6)
        np.testing.assert_allclose(
            found.dampings[k, :count], alone.history.damping[:count], rtol=1e-4
        )
        if alone.converged:
            np.testing.assert_allclose(found.costs[k, -1], alone.final_cost, rtol=1e-3)


@pytest.mark.slow
def test_a_scene_is_played_as_it_is_solved_by_a_method():
    bank = tiny_bank()
    options = make_method("deeplm").options(StepOptions())
    found = play(KIND, bank, CERES, options, 6)
    for k in (0, 5):
        alone = solve(problem_of(KIND, bank.scenes, k), "ceres", options, max_iterations=6)
        count = min(4, alone.iterations)
        np.testing.assert_allclose(
            found.costs[k, 1 : count + 1], alone.history.cost[:count], rtol=1e-5
        )


@pytest.mark.parametrize("count", [3, GROUP + 1])
def test_agents_that_play_side_by_side_step_in_groups_as_each_alone(count):
    shared = jnp.asarray([2.0, 3.0])
    scenes = jnp.arange(3.0 * count).reshape(3, count)

    def one(shared, x, y):
        return (shared @ jnp.stack([x, y]), x > 1)

    def step(x, y):
        return step_groups(one, x, y, shared=shared)

    found = jax.jit(jax.vmap(step, (0, None)))(scenes, scenes[0])
    for agent in range(3):
        chex.assert_trees_all_equal(
            jax.tree.map(lambda x, k=agent: x[k], found), step(scenes[agent], scenes[0])
        )
    np.testing.assert_array_equal(found[0], 2 * scenes + 3 * scenes[0])


@pytest.mark.slow
def test_a_scene_of_the_largest_class_is_played_as_it_is_solved():
    """As no preset has them."""
    kind = SceneClass(MOST_CAMERAS, MOST_POINTS)
    options = StepOptions(refinement=Refinement(points=3))
    scenes = make_scenes(kind, jax.random.key(5), 4)
    costs = initial_costs(kind, scenes)
    found = play(
        kind, Bank(scenes, costs, costs, info_of(kind, scenes, costs, 6), costs), CERES, options, 6
    )
    whole = [k for k in range(4) if grid(kind, scenes)[k].any()]
    assert len(whole) >= 2
    for k in whole[:2]:
        alone = solve(problem_of(kind, scenes, k), "ceres", options, max_iterations=6)
        count = min(4, alone.iterations)
        np.testing.assert_allclose(
            found.costs[k, 1 : count + 1], alone.history.cost[:count], rtol=1e-5
        )


@pytest.mark.slow
def test_scenes_of_a_class_share_random_clusters():
    bank = tiny_bank()
    options = make_method("stba:2").options(StepOptions())
    labels = class_layout(KIND, options).partitions.label
    assert labels.max() >= 1
    assert len(np.unique(labels, axis=0)) > 1
    found = play(KIND, bank, CERES, options, 12)
    assert (np.diff(found.costs, axis=1) <= 0).all()
    assert np.median(found.costs[:, -1] / found.costs[:, 0]) < 0.5
    assert (found.costs[:, 6] != played().costs[:, 6]).all()


@pytest.mark.slow
def test_scenes_whose_steps_have_trials_and_rounds_are_played_as_each_alone():
    """Candidates and camera rounds, vectorised over scenes: the same as one scene after the
    other."""
    bank = tiny_bank()
    damping = 1e-6
    options = StepOptions(
        refinement=Refinement(points=2, trials=3, camera_rounds=2, pattern_moves=2)
    )
    found = play(KIND, bank, make_policy(f"constant:{damping}"), options, 4)
    layout = class_layout(KIND, options)
    iterate = jax.jit(
        lambda own, state, turn: lm_step(own, state, jnp.asarray(damping), options, 0.0, turn)
    )
    repairs = 0
    for k in range(6):
        own = with_scene(layout, bank.scenes.pixels[k], bank.scenes.mask[k])
        state = LMState(bank.scenes.cameras[k], bank.scenes.points[k], bank.initial_cost[k])
        for turn in range(min(3, found.iterations[k])):
            state, step = iterate(own, state, jnp.asarray(turn))
            np.testing.assert_allclose(found.costs[k, turn + 1], state.cost, rtol=1e-5)
            repairs += int(step.repairs)
    assert repairs > 0


def test_costs_start_at_the_start_never_rise_and_stay_after_the_end():
    bank = tiny_bank()
    found = played()
    assert found.costs.shape == (len(bank.initial_cost), LIMIT + 1)
    np.testing.assert_array_equal(found.costs[:, 0], bank.initial_cost)
    assert (np.diff(found.costs, axis=1) <= 0).all()
    ends = 0
    for costs, dampings, count, converged in zip(*found, strict=True):
        assert 1 <= count <= LIMIT
        assert converged or count == LIMIT
        assert (costs[count:] == costs[count]).all()
        assert (dampings[:count] > 0).all()
        assert (dampings[count:] == 0).all()
        ends += count < LIMIT
    assert ends > 0
    assert len(set(found.iterations)) > 3


def test_lanes_do_not_mix_scenes(monkeypatch):
    """The scenes in another order, and in fewer lanes than scenes, so that lanes are used again."""
    from jaxba.game import rollout as module

    bank = tiny_bank()
    order = np.random.default_rng(0).permutation(len(bank.initial_cost))
    monkeypatch.setattr(module, "LANES", 8)
    assert len(order) > 8
    # another limit: a program of its own
    mixed = play(KIND, select(bank, order), CERES, StepOptions(), LIMIT - 1)
    straight = played()
    np.testing.assert_allclose(mixed.costs, straight.costs[order][:, :-1], rtol=1e-5)
    np.testing.assert_array_equal(
        np.minimum(straight.iterations[order], LIMIT - 1), mixed.iterations
    )


@pytest.mark.slow
@pytest.mark.parametrize("method", ["lm"])
def test_a_network_meets_in_a_solve_what_it_meets_in_the_game(method):
    """Each of its lambdas in a solve is the one it chose in the game, so its observations were the
    same."""
    options = make_method(method).options(StepOptions())
    rng = np.random.default_rng(2)
    size = observation_size(AGENT)

    def draw(*shape):
        return rng.normal(size=shape).astype(np.float32)

    policy = LearnedPolicy((Layer(draw(size, 8), draw(8)), Layer(draw(8, 2), draw(2))), AGENT)
    bank = tiny_bank()
    found = play(KIND, bank, policy, options, LIMIT)
    limit = int(bank.info.max_iterations[0])
    for k in (0, 1, 5):
        alone = solve(problem_of(KIND, bank.scenes, k), policy, options, max_iterations=limit)
        count = min(4, alone.iterations)
        np.testing.assert_allclose(
            found.dampings[k, :count], alone.history.damping[:count], rtol=1e-3
        )


# Scores


def test_reaching_a_cost_is_counted_from_the_start():
    costs = np.array(
        [
            [9.0, 5.0, 1.0005, 1.0],
            [1.0, 1.0, 1.0, 1.0],
            [9.0, 8.0, 7.0, 6.0],
            [9.0, 1.002, 1.002, 1.0009],
        ]
    )
    np.testing.assert_array_equal(reach(costs, np.ones(4), 1e-3), [2, 0, np.inf, 3])
    np.testing.assert_array_equal(reach(costs, np.full(4, 6.5), 0.0), [1, 0, 3, 1])


def test_a_score_is_what_numpy_makes_of_the_iterations():
    costs = np.array(
        [[8.0, 4.0, 2.0, 1.0, 1.0], [8.0, 1.0, 1.0, 1.0, 1.0], [8.0, 7.0, 6.0, 5.0, 5.0]]
    )
    run = Trajectories(costs, costs[:, 1:], np.array([4, 2, 4]), np.array([True, True, False]))
    found = score(run, np.array([4.0, 1.0, 5.0]), 1e-3, 4)
    there = np.array([1, 1, 3])
    np.testing.assert_allclose(found.mean, there.mean())
    np.testing.assert_allclose(found.geometric_mean, np.prod(there) ** (1 / 3))
    np.testing.assert_allclose(found.median, np.median(there))
    np.testing.assert_allclose(found.p90, np.percentile(there, 90))
    np.testing.assert_allclose(found.failures, 0)
    np.testing.assert_allclose(found.to_convergence, (4 + 2 + 4) / 3)
    np.testing.assert_allclose(found.end, np.median([-0.75, 0, 0]))


def test_a_paired_ratio_is_the_geometric_mean_with_the_interval_of_its_standard_error():
    rng = np.random.default_rng(0)
    theirs = rng.lognormal(size=400)
    np.testing.assert_allclose(paired_ratio(0.9 * theirs, theirs), 0.9)
    noise = rng.normal(scale=0.3, size=400)
    mean, *interval = paired_ratio(theirs * np.exp(noise), theirs)
    np.testing.assert_allclose(mean, np.exp(noise.mean()))
    half = 1.96 * noise.std() / np.sqrt(400)
    np.testing.assert_allclose(
        np.log(interval), noise.mean() + np.array([-half, half]), atol=0.2 * half
    )


@pytest.mark.slow
def test_the_best_constant_action_has_the_fewest_iterations():
    bank = tiny_bank()
    best = best_constant_action(KIND, bank, GameConfig(AGENT, max_iterations=LIMIT), StepOptions())
    means = [
        evaluate(KIND, bank, always(action, AGENT), StepOptions(), 1e-3, LIMIT).mean
        for action in CONSTANT_ACTIONS
    ]
    assert means[CONSTANT_ACTIONS.index(best)] == min(means) < max(means)


def test_policies_that_share_a_program_play_as_they_do_alone():
    bank = tiny_bank()
    names = ("ceres", "constant:1e-3", "gtsam", "constant:1e-5")
    alone = {name: play(KIND, bank, make_policy(name), StepOptions(), LIMIT) for name in names[:2]}
    steps = alike({name: (make_policy(name), StepOptions()) for name in names})
    assert len({jax.tree.structure(policy) for policy, _ in steps.values()}) == 1
    for name, one in alone.items():
        found = play(KIND, bank, *steps[name], LIMIT)
        np.testing.assert_array_equal(found.iterations, one.iterations)
        np.testing.assert_allclose(found.dampings, one.dampings, rtol=1e-6)
        np.testing.assert_allclose(found.costs, one.costs, rtol=1e-9)


def test_an_evaluation_is_the_score_of_playing():
    bank = tiny_bank()
    expected = score(played(), np.asarray(bank.best_cost), 1e-3, LIMIT)
    assert evaluate(KIND, bank, CERES, StepOptions(), 1e-3, LIMIT) == expected


def test_the_virtual_best_is_no_worse_than_any_of_its_members_on_any_scene():
    bank = tiny_bank()
    policies = {
        name: (make_policy(name), StepOptions()) for name in ("ceres", "ceres:10", "ceres:1e-9")
    }
    found = scores({}, play_all(KIND, bank, policies, LIMIT), bank, 1e-3, LIMIT)
    assert list(found) == [*policies, "virtual best"]
    best = found["virtual best"]
    for name in policies:
        for field in (
            "mean",
            "geometric_mean",
            "median",
            "p90",
            "failures",
            "to_convergence",
            "end",
        ):
            assert getattr(best, field) <= getattr(found[name], field) + 1e-12, (name, field)
    assert best.mean < min(found[name].mean for name in policies)
    # and no better than the best of each scene
    runs = [play(KIND, bank, policy, StepOptions(), LIMIT) for policy, _ in policies.values()]
    known = np.min([np.asarray(bank.best_cost), *(run.costs[:, -1] for run in runs)], axis=0)
    soonest = np.min(
        [np.minimum(np.maximum(reach(run.costs, known, 1e-3), 1), LIMIT) for run in runs], axis=0
    )
    np.testing.assert_allclose(best.mean, soonest.mean())
