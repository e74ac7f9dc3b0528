"""The game: its scenes, playing policies on them, its contract as an environment, and the scores.

Costs come from NumPy (`jaxba.geometry`), solves from `jaxba.solve`, rewards are written down once more.
"""

from __future__ import annotations

import dataclasses
import functools
from dataclasses import replace

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support import same_bits, solve
from tiny_game import AGENT, KIND, RULES, grid, problem_of, tiny_bank, tiny_game

from jaxba import StepOptions, make_method, make_policy
from jaxba.damping.clock import duration
from jaxba.damping.features import begin, observation_size, observe
from jaxba.damping.guard import damping_of
from jaxba.damping.learned import ConstantAction, Layer, LearnedPolicy
from jaxba.game.env import POINT_ITERATION_COST, Game, GameConfig
from jaxba.game.evaluate import CONSTANT_ACTIONS, best_constant_action, evaluate, play_all, score, scores
from jaxba.game.groups import GROUP, step_groups
from jaxba.game.protocol import Environment
from jaxba.game.random_scenes import (
    MIN_VIEWS,
    MOST_CAMERAS,
    MOST_POINTS,
    PAPER_START,
    SceneClass,
    make_scenes,
)
from jaxba.game.rollout import Trajectories, play
from jaxba.game.scene_bank import Bank, info_of, initial_costs, reach, select
from jaxba.game.scene_layout import class_layout, with_scene
from jaxba.game.statistics import paired_ratio
from jaxba.lm.records import LMState
from jaxba.lm.step import lm_step
from jaxba.problem import geometry
from jaxba.problem.options import Refinement
from jaxba.rotations import angle_axis
from jaxba.structure.layout import partition_of

LIMIT = 25


# Scenes

LARGE = pytest.param(SceneClass(MOST_CAMERAS, MOST_POINTS), marks=pytest.mark.slow, id="large")
"""The largest class of scenes; forty of them are 1.1 million slots."""


@pytest.mark.parametrize("kind", [KIND, pytest.param(SceneClass(6, 10, "paper"), id="paper"), LARGE])
def test_scenes_have_the_shape_of_their_class_and_enough_views(kind):
    scenes = make_scenes(kind, jax.random.key(1), 40)
    slots = kind.cameras * (kind.points + 1)
    shapes = [x.shape for x in scenes]
    assert shapes == [(40, 9, kind.cameras), (40, 3, kind.points + 1), (40, 2, slots), (40, slots)]
    assert all(np.isfinite(x).all() for x in scenes[:3])
    mask = np.asarray(scenes.mask)
    assert (np.asarray(scenes.pixels)[np.broadcast_to(~mask[:, None], scenes.pixels.shape)] == 0).all()
    assert not mask.reshape(40, kind.cameras, -1)[:, :, -1].any()  # the empty point
    seen = grid(kind, scenes)
    views, observed = seen.sum(axis=1), seen.sum(axis=2)
    assert (views[views > 0] >= 2).all()
    assert (observed[observed > 0] >= MIN_VIEWS).all()
    if kind.family == "paper":
        assert seen.all()
    else:
        assert len({s.sum() for s in seen}) > 5  # sizes differ


@pytest.mark.parametrize("sizes", [(MOST_CAMERAS + 1, 40), (10, MOST_POINTS + 1), (3, 40), (10, 9)])
def test_a_class_that_is_too_large_or_too_small_is_refused(sizes):
    with pytest.raises(ValueError, match="a class of scenes has 4 to 56 cameras and 10 to 510 points, not"):
        SceneClass(*sizes)


@pytest.mark.parametrize("kind", [KIND, pytest.param(SceneClass(6, 10, "paper"), id="paper")])
def test_the_cost_of_a_start_is_what_numpy_says(kind):
    scenes = make_scenes(kind, jax.random.key(2), 12)
    found = np.asarray(initial_costs(kind, scenes))
    tried = 0
    for k in range(12):
        if not grid(kind, scenes)[k].any():
            assert found[k] == 0
            continue
        np.testing.assert_allclose(found[k], geometry.cost(problem_of(kind, scenes, k)), rtol=1e-9)
        tried += 1
    assert tried >= 6


def test_the_paper_s_cameras_stand_at_random_around_its_points():
    """In all directions, before all points, with focal length 500."""
    scenes = make_scenes(SceneClass(6, 10, "paper"), jax.random.key(3), 40)
    cameras, points = np.asarray(scenes.cameras), np.asarray(scenes.points)[:, :, :-1]
    centers = np.stack([geometry.camera_centers(c.T) for c in cameras]).reshape(-1, 3)
    distance = np.linalg.norm(centers, axis=1)
    assert 8.5 < distance.mean() < 11  # 9 and its error
    assert (np.abs((centers / distance[:, None]).mean(axis=0)) < 0.15).all()  # 240 directions; sigma of a mean 0.04
    assert (cameras[:, 6:] == np.array([500, 0, 0])[:, None]).all()
    assert 0.95 < np.std(points) / np.hypot(4 / np.sqrt(12), PAPER_START[2]) < 1.05


def test_the_same_key_makes_the_same_scenes_and_another_one_others():
    first, again, other = (make_scenes(KIND, jax.random.key(k), 40) for k in (7, 7, 8))
    chex.assert_trees_all_equal(first, again, strict=True)
    assert not np.allclose(first.cameras, other.cameras)
    assert len({c.tobytes() for c in np.asarray(first.cameras)}) == 40


def test_what_a_policy_is_told_of_a_scene_is_true():
    scenes = make_scenes(KIND, jax.random.key(1), 40)
    cost = initial_costs(KIND, scenes)
    info = info_of(KIND, scenes, cost, 33)
    for k, seen in enumerate(grid(KIND, scenes)):
        if not seen.any():
            continue
        assert int(info.observations[k]) == seen.sum()
        assert int(info.cameras[k]) == seen.any(axis=1).sum()
        assert int(info.points[k]) == seen.any(axis=0).sum()
        np.testing.assert_allclose(info.focal[k], np.median(np.asarray(scenes.cameras)[k, 6, seen.any(axis=1)]))
        assert int(info.max_iterations[k]) == 33
        assert info.cost[k] == cost[k]


@pytest.mark.parametrize("angle", [0.0, 1e-14, 1e-8, 1e-3, 1.0, 3.0, np.pi - 1e-3, np.pi - 1e-8, np.pi - 1e-12, np.pi])
def test_angle_axis_vectors_are_those_of_scipy(angle):
    axes = np.random.default_rng(0).normal(size=(30, 3))
    axes = np.vstack([axes, np.eye(3), -np.eye(3)])
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    rotation = Rotation.from_rotvec(angle * axes)
    found = np.array(angle_axis(jnp.asarray(rotation.as_matrix())))
    assert (np.linalg.norm(found, axis=1) <= np.pi + 1e-12).all()
    assert (Rotation.from_rotvec(found) * rotation.inv()).magnitude().max() < 1e-7 * angle + 1e-13
    if angle < np.pi - 1e-6:  # beyond, either sign of the axis is right within rounding
        np.testing.assert_allclose(found, angle * axes, rtol=1e-7, atol=1e-12)


# Playing

CERES = make_policy("ceres")


@functools.cache
def played() -> Trajectories:
    """Ceres' rule on every scene of the bank."""
    return play(KIND, tiny_bank(), CERES, StepOptions(), LIMIT)


def test_the_bank_is_large_enough_to_test_with():
    assert 12 <= len(tiny_bank().initial_cost) <= 110


def test_a_scene_is_played_as_it_is_solved():
    bank, found = tiny_bank(), played()
    for k in (0, 5):
        alone = solve(problem_of(KIND, bank.scenes, k), "ceres", max_iterations=LIMIT)
        count = min(5, alone.iterations)
        expected = np.concatenate([[alone.initial_cost], alone.history.cost])[: count + 1]
        np.testing.assert_allclose(found.costs[k, : count + 1], expected, rtol=1e-6)
        np.testing.assert_allclose(found.dampings[k, :count], alone.history.damping[:count], rtol=1e-4)
        if alone.converged:
            np.testing.assert_allclose(found.costs[k, -1], alone.final_cost, rtol=1e-3)


@pytest.mark.slow
def test_a_scene_is_played_as_it_is_solved_by_a_method():
    bank, options = tiny_bank(), make_method("deeplm").options(StepOptions())
    found = play(KIND, bank, CERES, options, 6)
    for k in (0, 5):
        alone = solve(problem_of(KIND, bank.scenes, k), "ceres", options, max_iterations=6)
        count = min(4, alone.iterations)
        np.testing.assert_allclose(found.costs[k, 1 : count + 1], alone.history.cost[:count], rtol=1e-5)


@pytest.mark.parametrize("count", [3, GROUP + 1])
def test_agents_that_play_side_by_side_step_in_groups_as_each_alone(count):
    shared, scenes = jnp.asarray([2.0, 3.0]), jnp.arange(3.0 * count).reshape(3, count)
    one = lambda shared, x, y: (shared @ jnp.stack([x, y]), x > 1)
    step = lambda x, y: step_groups(one, x, y, shared=shared)
    found = jax.jit(jax.vmap(step, (0, None)))(scenes, scenes[0])
    for agent in range(3):
        chex.assert_trees_all_equal(jax.tree.map(lambda x, k=agent: x[k], found), step(scenes[agent], scenes[0]))
    np.testing.assert_array_equal(found[0], 2 * scenes + 3 * scenes[0])


@pytest.mark.slow
def test_a_scene_of_the_largest_class_is_played_as_it_is_solved():
    """As no preset has them."""
    kind, options = SceneClass(MOST_CAMERAS, MOST_POINTS), StepOptions(refinement=Refinement(points=3))
    scenes = make_scenes(kind, jax.random.key(5), 4)
    costs = initial_costs(kind, scenes)
    found = play(kind, Bank(scenes, costs, costs, info_of(kind, scenes, costs, 6), costs), CERES, options, 6)
    whole = [k for k in range(4) if grid(kind, scenes)[k].any()]
    assert len(whole) >= 2
    for k in whole[:2]:
        alone = solve(problem_of(kind, scenes, k), "ceres", options, max_iterations=6)
        count = min(4, alone.iterations)
        np.testing.assert_allclose(found.costs[k, 1 : count + 1], alone.history.cost[:count], rtol=1e-5)


def test_scenes_of_a_class_share_random_clusters():
    bank, options = tiny_bank(), make_method("stba:2").options(StepOptions())
    labels = partition_of(class_layout(KIND, options)).label
    assert labels.max() >= 1
    assert len(np.unique(labels, axis=0)) > 1
    found = play(KIND, bank, CERES, options, 12)
    assert (np.diff(found.costs, axis=1) <= 0).all()
    assert np.median(found.costs[:, -1] / found.costs[:, 0]) < 0.5
    assert (found.costs[:, 6] != played().costs[:, 6]).all()


@pytest.mark.slow
def test_scenes_whose_steps_have_trials_and_rounds_are_played_as_each_alone():
    """Candidates and camera rounds, vectorised over scenes: the same as one scene after the other."""
    bank, damping = tiny_bank(), 1e-6
    options = StepOptions(refinement=Refinement(points=2, trials=3, camera_rounds=2, pattern_moves=2))
    found = play(KIND, bank, make_policy(f"constant:{damping}"), options, 4)
    layout = class_layout(KIND, options)
    iterate = jax.jit(lambda own, state, turn: lm_step(own, state, jnp.asarray(damping), options, 0.0, turn))
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
    bank, found = tiny_bank(), played()
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
    mixed = play(KIND, select(bank, order), CERES, StepOptions(), LIMIT - 1)  # another limit: a program of its own
    straight = played()
    np.testing.assert_allclose(mixed.costs, straight.costs[order][:, :-1], rtol=1e-5)
    np.testing.assert_array_equal(np.minimum(straight.iterations[order], LIMIT - 1), mixed.iterations)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["lm"])
def test_a_network_meets_in_a_solve_what_it_meets_in_the_game(method):
    """Each of its lambdas in a solve is the one it chose in the game, so its observations were the same."""
    options = make_method(method).options(StepOptions())
    rng = np.random.default_rng(2)
    size = observation_size(AGENT)
    draw = lambda *shape: rng.normal(size=shape).astype(np.float32)
    policy = LearnedPolicy((Layer(draw(size, 8), draw(8)), Layer(draw(8, 2), draw(2))), AGENT)
    bank = tiny_bank()
    found = play(KIND, bank, policy, options, LIMIT)
    limit = int(bank.info.max_iterations[0])
    for k in (0, 1, 5):
        alone = solve(problem_of(KIND, bank.scenes, k), policy, options, max_iterations=limit)
        count = min(4, alone.iterations)
        np.testing.assert_allclose(found.dampings[k, :count], alone.history.damping[:count], rtol=1e-3)


# The environment

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
    """What happens in 50 steps of random actions: pairs of the state before and the step, all on the host."""
    game = tiny_game(RULES, ENVS)
    state, seen = _jitted_reset(game, jax.random.key(3))
    found = []
    for action in actions(50):
        before = state
        state, step = _jitted_step(game, state, action)
        found.append((before._replace(episodes=_host(before.episodes)), *_host((seen, action, step))))
        seen = step.observation
    return game, found


def test_the_game_keeps_the_contract_of_an_environment():
    game, found = random_game()
    assert isinstance(game, Environment)
    assert (game.num_envs, game.observation_size, game.action_size) == (ENVS, observation_size(AGENT) + 1, 1)
    assert game.privileged_size == 1
    for _, seen, _, step in found:
        assert seen.shape == step.observation.shape == step.final_observation.shape == (ENVS, game.observation_size)
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
        (episodes,) = before.episodes
        best = np.asarray(bank.best_cost)[episodes.scene]
        cost = np.array([_alone(game, episodes, action, e) for e in range(ENVS)]) if k < 12 else None
        at_limit = episodes.memory.iteration + 1 >= RULES.max_iterations
        success = step.metrics["success"] > 0
        if cost is not None:
            np.testing.assert_array_equal(success, cost <= best * (1 + RULES.tolerance))
        np.testing.assert_array_equal(step.terminated, success | at_limit)
        assert not step.truncated.any()
        np.testing.assert_array_equal(step.metrics["length"], episodes.memory.iteration + 1)
        goals, limits = goals + success.sum(), limits + (at_limit & ~success).sum()
    assert goals >= 5
    assert limits >= 5


@functools.partial(jax.jit, static_argnames=("game_rules", "kind"))
def _iterate(game, kind, bank, episode, action, game_rules):
    after, step = game.iterate(kind, bank, episode, action[None])
    return after, step


def _alone(game: Game, episodes, action, e: int) -> float:
    episode = jax.tree.map(lambda x: jnp.asarray(x[e]), episodes)
    return float(_iterate(game, KIND, game.banks[0], episode, jnp.asarray(action[e, 0]), game.config)[1].cost)


def test_after_the_end_the_next_observation_is_of_a_new_start_and_the_final_one_is_the_true_one():
    game, found = random_game()
    starts = {}
    for scene in range(len(tiny_bank().initial_cost)):
        episode = game.start(game.banks[0], jnp.asarray(scene, jnp.int32))
        starts[np.asarray(game._observe(game.banks[0], episode)).tobytes()] = scene
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
                episode = jax.tree.map(lambda x, e=e: jnp.asarray(x[e]), before.episodes[0])
                after, _ = _iterate(game, KIND, game.banks[0], episode, jnp.asarray(action[e, 0]), game.config)
                np.testing.assert_allclose(step.final_observation[e], game._observe(game.banks[0], after), atol=1e-5)
                np.testing.assert_allclose(step.final_observation[e, :-1], observe(AGENT, after.memory), atol=1e-5)
                distance = after.state.cost / game.banks[0].best_cost[after.scene] - 1
                decades = np.log10(np.maximum(distance, 1e-6)) / 6
                np.testing.assert_allclose(step.final_observation[e, -1], decades, atol=1e-4)
        if k + 1 < len(found):
            (following,) = found[k + 1][0].episodes
            assert (following.memory.iteration[done] == 0).all()
            np.testing.assert_array_equal(
                following.state.cost[done], np.asarray(tiny_bank().initial_cost)[following.scene[done]]
            )
    assert ended >= 30
    scenes = {int(s) for before, *_ in found for s in before.episodes[0].scene}
    assert len(scenes) > 10  # of the whole bank, not the same ones again


def _reward(config: GameConfig, cost: float, best: float, iteration: int, success: bool, time: float = 1.0):
    """By hand; `iteration` counts from one, `time` is what the clock says."""
    bonus = config.bonus if success else 0.0
    value = {
        "duration": bonus - 1,  # no point iterations in this game
        "clock": bonus - time,
        "constant": bonus - 1,
        "reduction": bonus * (1 - 0.01 * (iteration - 1)),
        "reversed": bonus - np.log10(cost / best),
    }[config.reward]
    return config.scale * value


@pytest.mark.parametrize(
    "config",
    [
        replace(RULES, reward="duration"),
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


def test_a_point_iteration_costs_a_tenth_of_a_linear_solve():
    from support import step_info

    game = dataclasses.replace(tiny_game(), options=StepOptions(refinement=Refinement(points=3)))
    memory = begin(AGENT, tiny_info())
    no = jnp.asarray(False)
    found = game._reward(step_info(True, cost=5.0, previous_cost=9.0), memory, jnp.asarray(1.0), no)
    np.testing.assert_allclose(found, -RULES.scale * (1 + 3 * POINT_ITERATION_COST))
    assert POINT_ITERATION_COST == 0.1


def test_the_game_pays_what_it_says():
    """The rewards of the compiled game, from the costs in its own states."""
    game, found = random_game()
    checked = 0
    for k in range(len(found) - 1):
        before, _, _, step = found[k]
        (episodes,), (following,) = before.episodes, found[k + 1][0].episodes
        for e in range(ENVS):
            success = bool(step.metrics["success"][e])
            best = float(np.asarray(tiny_bank().best_cost)[episodes.scene[e]])
            cost = best if step.terminated[e] or step.truncated[e] else float(following.state.cost[e])
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
    _jitted_step(dataclasses.replace(game, banks=(_shifted(game.banks[0]),)), other, actions(1)[0])
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
                AGENT, jax.tree.map(lambda x, e=e: x[e], state.episodes[0].memory.guard), jnp.asarray(found[e, 0])
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


# Scores


def test_reaching_a_cost_is_counted_from_the_start():
    costs = np.array([[9.0, 5.0, 1.0005, 1.0], [1.0, 1.0, 1.0, 1.0], [9.0, 8.0, 7.0, 6.0], [9.0, 1.002, 1.002, 1.0009]])
    np.testing.assert_array_equal(reach(costs, np.ones(4), 1e-3), [2, 0, np.inf, 3])
    np.testing.assert_array_equal(reach(costs, np.full(4, 6.5), 0.0), [1, 0, 3, 1])


def test_a_score_is_what_numpy_makes_of_the_iterations():
    costs = np.array([[8.0, 4.0, 2.0, 1.0, 1.0], [8.0, 1.0, 1.0, 1.0, 1.0], [8.0, 7.0, 6.0, 5.0, 5.0]])
    run = Trajectories(costs, costs[:, 1:], np.array([4, 2, 4]), np.array([True, True, False]))
    found = score([run, run], [np.ones(3), np.array([4.0, 1.0, 5.0])], 1e-3, 4)
    there = np.array([3, 1, 4, 1, 1, 3])  # the third never gets there: the limit
    np.testing.assert_allclose(found.mean, there.mean())
    np.testing.assert_allclose(found.geometric_mean, np.prod(there) ** (1 / 6))
    np.testing.assert_allclose(found.median, np.median(there))
    np.testing.assert_allclose(found.p90, np.percentile(there, 90))
    np.testing.assert_allclose(found.failures, 1 / 6)
    np.testing.assert_allclose(found.to_convergence, 2 * (4 + 2 + 4) / 6)
    np.testing.assert_allclose(found.end, np.median([0, 0, 4, -0.75, 0, 0]))


def test_a_paired_ratio_is_the_geometric_mean_with_the_interval_of_its_standard_error():
    rng = np.random.default_rng(0)
    theirs = rng.lognormal(size=400)
    np.testing.assert_allclose(paired_ratio(0.9 * theirs, theirs), 0.9)
    noise = rng.normal(scale=0.3, size=400)
    found = paired_ratio(theirs * np.exp(noise), theirs)
    np.testing.assert_allclose(found.mean, np.exp(noise.mean()))
    half = 1.96 * noise.std() / np.sqrt(400)
    np.testing.assert_allclose(np.log([found.low, found.high]), noise.mean() + np.array([-half, half]), atol=0.2 * half)


def test_the_best_constant_action_has_the_fewest_iterations():
    bank = tiny_bank()
    best = best_constant_action([KIND], [bank], AGENT, StepOptions(), 1e-3, LIMIT)
    means = [
        evaluate([KIND], [bank], ConstantAction((action,), AGENT), StepOptions(), 1e-3, LIMIT).mean
        for action in CONSTANT_ACTIONS
    ]
    assert means[CONSTANT_ACTIONS.index(best.action[0])] == min(means) < max(means)


def test_an_evaluation_is_the_score_of_playing():
    bank = tiny_bank()
    expected = score([played()], [np.asarray(bank.best_cost)], 1e-3, LIMIT)
    assert evaluate([KIND], [bank], CERES, StepOptions(), 1e-3, LIMIT) == expected


def test_the_virtual_best_is_no_worse_than_any_of_its_members_on_any_scene():
    bank = tiny_bank()
    policies = {name: (make_policy(name), StepOptions()) for name in ("ceres", "ceres:10", "ceres:1e-9")}
    found = scores({}, play_all([KIND], [bank], policies, LIMIT), [bank], 1e-3, LIMIT)
    assert list(found) == [*policies, "virtual best"]
    best = found["virtual best"]
    for name in policies:
        for field in ("mean", "geometric_mean", "median", "p90", "failures", "to_convergence", "end"):
            assert getattr(best, field) <= getattr(found[name], field) + 1e-12, (name, field)
    assert best.mean < min(found[name].mean for name in policies)
    # and no better than the best of each scene
    runs = [play(KIND, bank, policy, StepOptions(), LIMIT) for policy, _ in policies.values()]
    known = np.min([np.asarray(bank.best_cost), *(run.costs[:, -1] for run in runs)], axis=0)
    soonest = np.min([np.minimum(np.maximum(reach(run.costs, known, 1e-3), 1), LIMIT) for run in runs], axis=0)
    np.testing.assert_allclose(best.mean, soonest.mean())
