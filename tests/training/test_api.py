"""The game and its trainer from Python."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxba
from jaxba.game import scene_bank
from jaxba.game.rollout import play
from jaxba.game.windows import read_windows

SMALL = (
    *("bank.classes=[{cameras: 5, points: 12}]", "bank.scenes=[80]", "envs=[4]", "game.max_iterations=6"),
    *("sac.width=16", "sac.batch=16", "loop.warmup_steps=16", "loop.replay_capacity=200"),
)


def mine(step, best, success):
    """A reward of one's own."""
    return jnp.where(success, 100.0, step.cost / best)


@pytest.fixture(scope="module")
def env():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scene_bank, "PORTFOLIO", ("ceres",))
        return jaxba.make_env("paper", *SMALL, reward=mine)


@pytest.mark.slow
def test_two_lines_train_a_policy_and_the_same_lines_the_same_one(env):
    policy, again = (jaxba.train(env, steps=40, seeds=2) for _ in range(2))
    for one, other in zip(policy.layers, again.layers, strict=True):
        np.testing.assert_array_equal(one.kernel, other.kernel)
    assert policy.config == env.config.agent
    (bank,), (kind,) = env.held_out, env.kinds
    run = play(kind, bank, policy, env.options, 6)
    assert np.isfinite(run.costs).all()
    assert (run.costs[:, -1] <= run.costs[:, 0]).all()


def test_a_reward_of_ones_own_is_the_reward(env):
    state, _ = env.reset(jax.random.key(0))
    _, step = jax.jit(lambda state, action: env.step(state, action))(state, jnp.zeros((4, 1)))
    reached = np.asarray(step.metrics["success"]) > 0
    assert not reached.all()
    # what a critic sees after the action: log10 of the distance to the best cost, over six
    distance = 10 ** (6 * np.asarray(step.final_observation)[:, -1].astype(float))
    np.testing.assert_allclose(step.reward[~reached], 1 + distance[~reached], rtol=1e-4)
    np.testing.assert_array_equal(np.asarray(step.reward)[reached], 100)


def test_windows_of_problems_in_memory_are_those_of_their_files(tmp_path):
    problems = [jaxba.random_scene(jaxba.SceneConfig(cameras=24, points=200), seed) for seed in range(2)]
    files = [tmp_path / f"{number}.txt" for number in range(2)]
    for problem, file in zip(problems, files, strict=True):
        jaxba.write_problem(problem, file)
    kind = scene_bank.SceneClass(5, 12, family="windows")
    in_memory, read = (read_windows(given, kind, 8, 0) for given in (problems, files))
    for one, other in zip(jax.tree.leaves(in_memory), jax.tree.leaves(read), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-12)


@pytest.mark.slow
def test_gymnasium_makes_the_game_by_its_name(monkeypatch):
    gymnasium = pytest.importorskip("gymnasium")
    import jaxba.game.gym

    monkeypatch.setattr(scene_bank, "PORTFOLIO", ("ceres",))
    one = gymnasium.make(jaxba.game.gym.ID, overrides=SMALL)
    observation, _ = one.reset(seed=3)
    assert one.observation_space.contains(observation)
    many = gymnasium.make_vec(jaxba.game.gym.ID, num_envs=3, overrides=SMALL)
    assert many.num_envs == 3
    np.testing.assert_equal(many.reset(seed=3)[0].shape, (3, *observation.shape))
