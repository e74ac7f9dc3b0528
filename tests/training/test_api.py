"""The game and its trainer from Python."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxba
from jaxba.game import scene_bank
from jaxba.game.rollout import play
from jaxba.game.windows import read_windows
from jaxba.settings import SettingsError
from jaxba.training.checkpoint import TrainError
from jaxba.typing import InputError

SMALL = (
    *("bank.kind={cameras: 5, points: 12}", "bank.scenes=80", "envs=4", "game.max_iterations=6"),
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


@pytest.mark.slow("another file has a sample of it")
def test_two_lines_train_a_policy_and_the_same_lines_the_same_one(env):
    policy, again = (jaxba.train(env, steps=40, seeds=2) for _ in range(2))
    for one, other in zip(policy.layers, again.layers, strict=True):
        np.testing.assert_array_equal(one.kernel, other.kernel)
    assert policy.config == env.config.agent
    run = play(env.kind, env.held_out, policy, env.options, 6)
    assert np.isfinite(run.costs).all()
    assert (run.costs[:, -1] <= run.costs[:, 0]).all()


@pytest.mark.slow
def test_a_reward_of_ones_own_is_the_reward(env):
    state, _ = env.reset(jax.random.key(0))
    _, step = jax.jit(lambda state, action: env.step(state, action))(state, jnp.zeros((4, 1)))
    reached = np.asarray(step.metrics["success"]) > 0
    assert not reached.all()
    # what a critic sees after the action: log10 of the distance to the best cost, over six
    distance = 10 ** (6 * np.asarray(step.final_observation)[:, -1].astype(float))
    np.testing.assert_allclose(step.reward[~reached], 1 + distance[~reached], rtol=1e-4)
    np.testing.assert_array_equal(np.asarray(step.reward)[reached], 100)


@pytest.mark.parametrize(
    ("reward", "words"),
    [
        (lambda step, best, success: 1.0 if success else 0.0, "can trace: .*bool"),
        (lambda step, best: 1.0, "can trace: .*positional arguments"),
        (lambda step, best, success: None, "can trace: "),
        (
            lambda step, best, success: jnp.stack([step.cost, best]),
            r"one number, not an array of shape \(2,\)",
        ),
        ("gain", "must be one of constant"),
    ],
)
@pytest.mark.usefixtures("unchecked")
def test_what_is_no_reward_is_refused_in_one_line_before_scenes_are_made(reward, words):
    with pytest.raises(ValueError, match=words) as caught:
        jaxba.make_env("paper", *SMALL, reward=reward)
    assert "\n" not in str(caught.value)


@pytest.mark.usefixtures("unchecked")
def test_wrong_kinds_of_arguments_are_refused_in_one_line():
    with pytest.raises(SettingsError, match=r"settings are text such as 'sac.width=128', not \{\}"):
        jaxba.make_env("paper", {})
    with pytest.raises(ValueError, match=r"env must be a game of jaxba.make_env, not 'paper'"):
        jaxba.train("paper", 10)


@pytest.mark.usefixtures("unchecked")
def test_actions_of_another_shape_are_refused(env):
    with jax.enable_x64(True):
        state, _ = env.reset(jax.random.key(0))
        for shape in ((4,), (3, 1), (4, 2), ()):
            with pytest.raises(ValueError, match=r"actions must have shape \(4, 1\), not"):
                jax.eval_shape(
                    lambda state, action: env.step(state, action), state, jnp.zeros(shape)
                )


def test_no_scene_worth_solving_is_said(monkeypatch):
    monkeypatch.setattr(scene_bank, "worth_solving", lambda kind, info: np.zeros(0, int))
    with pytest.raises(
        InputError, match="none of 80 scenes of 5 cameras x 12 points is worth solving: draw more"
    ):
        jaxba.make_env("paper", *SMALL)


@pytest.mark.slow
def test_a_reward_that_is_no_number_ends_the_training_in_a_new_folder(env, tmp_path):
    broken = replace(
        env, config=replace(env.config, reward=lambda step, best, success: jnp.nan * step.cost)
    )
    with pytest.raises(
        TrainError,
        match="chunk 1: all transitions hold numbers that are not finite; look at the rew",
    ):
        jaxba.train(broken, steps=8, folder=tmp_path / "new" / "run")
    assert (tmp_path / "new" / "run").is_dir()


def test_windows_of_problems_in_memory_are_those_of_their_files(tmp_path):
    problems = [
        jaxba.random_scene(jaxba.SceneConfig(cameras=24, points=200), seed) for seed in range(2)
    ]
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
