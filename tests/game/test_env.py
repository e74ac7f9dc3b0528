"""The contract of the game as an environment. Rewards are written down once more."""

from __future__ import annotations

import dataclasses
import functools
from dataclasses import replace

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import same_bits
from tiny_game import AGENT, RULES, tiny_bank, tiny_game

from jaxba.damping.features import begin, duration, observation_size, observe
from jaxba.damping.guard import damping_of
from jaxba.game.env import Game, GameConfig
from jaxba.game.protocol import Environment
from jaxba.game.scene_bank import Bank

_jitted_reset = jax.jit(lambda game, key: game.reset(key))
_jitted_step = jax.jit(lambda game, state, action: game.step(state, action))

ENVS = 6


def actions(steps: int, seed: int = 0, envs: int = ENVS) -> jnp.ndarray:
    """Random ones."""
    return jnp.asarray(np.random.default_rng(seed).uniform(-1, 1, (steps, envs, 1)), jnp.float32)


def _host(tree):
    return jax.tree.map(np.asarray, tree)


@functools.cache
def random_game():
    """What happens in 50 steps of random actions: pairs of the state before and the step, all on
    the host."""
    game = tiny_game(RULES, ENVS)
    state, seen = _jitted_reset(game, jax.random.key(3))
    found = []
    for action in actions(50):
        before = state
        state, step = _jitted_step(game, state, action)
        found.append(
            (before._replace(episodes=_host(before.episodes)), *_host((seen, action, step)))
        )
        seen = step.observation
    return game, found


def test_the_game_keeps_the_contract_of_an_environment():
    game, found = random_game()
    assert isinstance(game, Environment)
    assert (game.num_envs, game.observation_size, game.action_size) == (
        ENVS,
        observation_size(AGENT) + 1,
        1,
    )
    assert game.privileged_size == 1
    for _, seen, _, step in found:
        assert (
            seen.shape
            == step.observation.shape
            == step.final_observation.shape
            == (ENVS, game.observation_size)
        )
        assert seen.dtype == step.observation.dtype == step.reward.dtype == np.float32
        assert set(step.metrics) == {"length", "success", "rejections", "ceres"}


def test_fifty_random_actions_leave_everything_finite():
    for before, seen, _, step in random_game()[1]:
        leaves = jax.tree.leaves((before.episodes, seen, step))
        assert all(np.isfinite(x).all() for x in leaves if np.issubdtype(x.dtype, np.inexact))


def test_an_episode_ends_at_the_goal_or_at_the_limit_and_nowhere_else():
    """The cost after the action is that of `lm_step` on the scene alone, taken once more."""
    game, found = random_game()
    bank = tiny_bank()
    goals = limits = 0
    for k, (before, _, action, step) in enumerate(found):
        episodes = before.episodes
        best = np.asarray(bank.best_cost)[episodes.scene]
        cost = (
            np.array([_alone(game, episodes, action, e) for e in range(ENVS)]) if k < 12 else None
        )
        at_limit = episodes.memory.iteration + 1 >= RULES.max_iterations
        success = step.metrics["success"] > 0
        if cost is not None:
            np.testing.assert_array_equal(success, cost <= best * (1 + RULES.tolerance))
        np.testing.assert_array_equal(step.terminated, success | at_limit)
        assert not step.truncated.any()
        np.testing.assert_array_equal(step.metrics["length"], episodes.memory.iteration + 1)
        goals = goals + success.sum()
        limits = limits + (at_limit & ~success).sum()
    assert goals >= 5
    assert limits >= 5


@functools.partial(jax.jit, static_argnames=("game_rules",))
def _iterate(game, bank, episode, action, game_rules):
    after, step = game.iterate(bank, episode, action[None])
    return after, step


def _alone(game: Game, episodes, action, e: int) -> float:
    episode = jax.tree.map(lambda x: jnp.asarray(x[e]), episodes)
    return float(_iterate(game, game.bank, episode, jnp.asarray(action[e, 0]), game.config)[1].cost)


def test_after_the_end_the_next_observation_is_of_a_new_start_and_the_final_one_is_the_true_one():
    game, found = random_game()
    starts = {}
    for scene in range(len(tiny_bank().initial_cost)):
        episode = game.start(game.bank, jnp.asarray(scene, jnp.int32))
        starts[np.asarray(game._observe(game.bank, episode)).tobytes()] = scene
    assert len(starts) > 10
    ended = 0
    for k, (before, _, action, step) in enumerate(found):
        done = step.terminated | step.truncated
        for e in range(ENVS):
            if done[e]:
                assert step.observation[e].tobytes() in starts
                assert step.final_observation[e].tobytes() not in starts
                ended += 1
            else:
                np.testing.assert_array_equal(step.observation[e], step.final_observation[e])
            if k < 6:
                episode = jax.tree.map(lambda x, e=e: jnp.asarray(x[e]), before.episodes)
                after, _ = _iterate(
                    game, game.bank, episode, jnp.asarray(action[e, 0]), game.config
                )
                np.testing.assert_allclose(
                    step.final_observation[e], game._observe(game.bank, after), atol=1e-5
                )
                np.testing.assert_allclose(
                    step.final_observation[e, :-1], observe(AGENT, after.memory), atol=1e-5
                )
                distance = after.state.cost / game.bank.best_cost[after.scene] - 1
                decades = np.log10(np.maximum(distance, 1e-6)) / 6
                np.testing.assert_allclose(step.final_observation[e, -1], decades, atol=1e-4)
        if k + 1 < len(found):
            following = found[k + 1][0].episodes
            assert (following.memory.iteration[done] == 0).all()
            np.testing.assert_array_equal(
                following.state.cost[done],
                np.asarray(tiny_bank().initial_cost)[following.scene[done]],
            )
    assert ended >= 30
    scenes = {int(s) for before, *_ in found for s in before.episodes.scene}
    assert len(scenes) > 10  # of the whole bank, not the same ones again


def _reward(
    config: GameConfig, cost: float, best: float, iteration: int, success: bool, time: float = 1.0
):
    """By hand; `iteration` counts from one, `time` is what the clock says."""
    bonus = config.bonus if success else 0.0
    value = {
        "clock": bonus - time,
        "constant": bonus - 1,
        "reduction": bonus * (1 - 0.01 * (iteration - 1)),
        "reversed": bonus - np.log10(cost / best),
    }[config.reward]
    return config.scale * value


@pytest.mark.parametrize(
    "config",
    [
        replace(RULES, reward="constant", bonus=3.0, scale=1.0),
        replace(RULES, reward="reduction"),
        replace(RULES, reward="reversed"),
        replace(RULES, reward="clock"),
    ],
    ids=lambda config: config.reward,
)
def test_rewards_are_those_of_the_contract(config):
    """By `Game._reward` alone, on made-up steps: no program of its own for each."""
    from support import step_info

    game = tiny_game(config)
    memory = begin(config.agent, tiny_info())
    for cost, before, best, iteration in (
        (5.0, 9.0, 1.0, 1),
        (1.0005, 3.0, 1.0, 2),
        (2.0, 2.0, 0.5, 4),
        (1.0, 1.2, 1.0, 3),
    ):
        success = cost <= best * (1 + config.tolerance)
        step = step_info(True, cost=cost, previous_cost=before)
        found = game._reward(
            step,
            memory._replace(iteration=jnp.asarray(iteration, jnp.int32)),
            jnp.asarray(best),
            jnp.asarray(success),
        )
        want = _reward(config, cost, best, iteration, success, float(duration(step)))
        np.testing.assert_allclose(found, want, rtol=1e-9)


def tiny_info():
    return jax.tree.map(lambda x: x[0], tiny_bank().info)


def test_the_game_pays_what_it_says():
    """The rewards of the compiled game, from the costs in its own states."""
    game, found = random_game()
    checked = 0
    for k in range(len(found) - 1):
        before, _, _, step = found[k]
        episodes = before.episodes
        following = found[k + 1][0].episodes
        for e in range(ENVS):
            success = bool(step.metrics["success"][e])
            best = float(np.asarray(tiny_bank().best_cost)[episodes.scene[e]])
            cost = (
                best if step.terminated[e] or step.truncated[e] else float(following.state.cost[e])
            )
            want = _reward(game.config, cost, best, int(step.metrics["length"][e]), success)
            np.testing.assert_allclose(step.reward[e], want, rtol=1e-5)
            checked += 1
    assert checked == 49 * ENVS


def test_the_same_key_and_actions_give_the_same_numbers_and_the_game_is_traced_once():
    game, found = random_game()
    traced = _jitted_step._cache_size()
    state, _ = _jitted_reset(game, jax.random.key(3))
    for action, (before, _, _, step) in zip(actions(50), found, strict=True):
        chex.assert_trees_all_equal(before.episodes, state.episodes, strict=True)
        state, again = _jitted_step(game, state, action)
        chex.assert_trees_all_equal(again, step, strict=True)
    other, _ = _jitted_reset(game, jax.random.key(4))
    assert not same_bits(other.episodes, found[0][0].episodes)
    _jitted_step(dataclasses.replace(game, bank=_shifted(game.bank)), other, actions(1)[0])
    assert _jitted_step._cache_size() == traced  # other scenes, same program


def _shifted(bank: Bank) -> Bank:
    return jax.tree.map(lambda x: jnp.roll(x, 1, axis=0), bank)


def test_demonstrations_are_actions_of_which_some_follow_ceres_rule():
    game = tiny_game(envs=8)
    state, _ = _jitted_reset(game, jax.random.key(0))
    found = np.asarray(game.demonstrate(state, jax.random.key(1)))
    assert found.shape == (8, 1)
    assert (np.abs(found) < 1).all()
    lambdas = [
        float(
            damping_of(
                AGENT,
                jax.tree.map(lambda x, e=e: x[e], state.episodes.memory.guard),
                jnp.asarray(found[e, 0]),
            )
        )
        for e in range(8)
    ]
    np.testing.assert_allclose([lambdas[1], lambdas[5]], 1e-4, rtol=1e-4)  # Ceres' first lambda
    np.testing.assert_allclose([lambdas[3], lambdas[7]], 1e-6, rtol=1e-4)  # and two decades bolder
    assert len(set(found[::2, 0])) == 4


@pytest.mark.parametrize(
    "change",
    [
        {"reward": "fame"},
        {"max_iterations": 0},
        {"tolerance": 0.0},
        {"scale": -1.0},
        {"tolerance": -1e-3},
        {"bonus": -0.1},
    ],
)
@pytest.mark.usefixtures("unchecked")
def test_impossible_rules_are_refused(change):
    with pytest.raises(ValueError, match=next(iter(change))):
        replace(RULES, **change)
