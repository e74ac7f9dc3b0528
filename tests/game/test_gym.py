"""The game as Gymnasium environments: their checker, their conventions, and the same numbers as the
game itself."""

from __future__ import annotations

import dataclasses
import importlib
import subprocess
import sys
import warnings
from pathlib import Path

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from tiny_game import tiny_game

from jaxba.game import gym
from jaxba.game.gym import GymGame, GymVectorGame


@pytest.fixture(scope="module")
def game():
    """A game of six environments, whose episodes are at most four iterations long."""
    return tiny_game()


@pytest.fixture(scope="module")
def single(game):
    """The same scenes, one at a time."""
    return dataclasses.replace(game, num_envs=1)


@pytest.fixture
def envs(game):
    env = GymVectorGame(game, AutoresetMode.SAME_STEP)
    yield env
    env.close()


def test_gymnasium_s_checker_has_nothing_to_say(single):
    with warnings.catch_warnings():
        # said of any environment that was not made by `gymnasium.make`; everything else is an error
        warnings.filterwarnings("ignore", message=r".*not having a spec.*|.*environment spec.*")
        check_env(GymGame(single), skip_render_check=True)


def test_a_game_of_many_is_no_single_environment(game):
    with pytest.raises(ValueError, match="one environment, this one has 6"):
        GymGame(game)


def test_the_vector_environment_says_what_it_is(envs, game):
    assert isinstance(envs, gymnasium.vector.VectorEnv)
    assert envs.num_envs == game.num_envs == 6
    assert envs.metadata["autoreset_mode"] == AutoresetMode.SAME_STEP
    assert envs.single_action_space == gymnasium.spaces.Box(-1, 1, (1,), np.float32)
    seen = game.observation_size - game.privileged_size
    assert envs.single_observation_space.shape == (seen,)
    assert envs.single_observation_space.dtype == np.float32
    assert (envs.single_observation_space.low == -2).all()
    assert (envs.single_observation_space.high == 2).all()
    assert envs.observation_space.shape == (6, seen)
    assert envs.action_space.shape == (6, 1)


def test_errors_as_observations_have_no_bounds(game):
    rules = dataclasses.replace(
        game.config, agent=dataclasses.replace(game.config.agent, observation="paper")
    )
    space = GymVectorGame(dataclasses.replace(game, config=rules)).single_observation_space
    assert space.shape == (game.config.agent.history,)
    assert np.isposinf(space.high).all()


def test_every_step_is_what_gymnasium_documents(envs):
    envs.action_space.seed(3)
    observation, info = envs.reset(seed=3)
    assert observation in envs.observation_space
    assert info == {}
    ended = 0
    for _ in range(12):
        observation, reward, terminated, truncated, infos = envs.step(envs.action_space.sample())
        assert observation in envs.observation_space
        assert reward.shape == terminated.shape == truncated.shape == (6,)
        assert reward.dtype == np.float64
        assert terminated.dtype == truncated.dtype == bool
        assert np.isfinite(reward).all()
        done = terminated | truncated
        assert not (terminated & truncated).any()
        if not done.any():
            assert infos == {}
            continue
        ended += int(done.sum())
        assert np.array_equal(infos["_final_obs"], done)
        assert np.array_equal(infos["_final_info"], done)
        for k in range(6):
            assert (infos["final_obs"][k] is not None) == done[k]
            if done[k]:
                assert infos["final_obs"][k] in envs.single_observation_space
                assert not np.array_equal(infos["final_obs"][k], observation[k])
                assert 1 <= infos["final_info"]["length"][k] <= 4
                assert terminated[k]  # by success or at the limit
                assert infos["final_info"]["success"][k] or infos["final_info"]["length"][k] == 4
            assert infos["final_info"]["_length"][k] == done[k]
    assert ended >= 6


def test_its_numbers_are_the_game_s(envs, game):
    observation, _ = envs.reset(seed=11)
    random, _ = gymnasium.utils.seeding.np_random(11)
    state, expected = jax.jit(game.reset)(jax.random.key(int(random.integers(2**31))))
    np.testing.assert_array_equal(observation, expected[:, :-1])  # without what only critics see
    step = jax.jit(lambda game, *a: game.step(*a))
    actions = np.random.default_rng(0).uniform(-1, 1, (6, 6, 1)).astype(np.float32)
    for action in actions:
        state, want = step(game, state, jnp.asarray(action))
        observation, reward, terminated, truncated, infos = envs.step(action)
        np.testing.assert_allclose(observation, want.observation[:, :-1], atol=1e-6)
        np.testing.assert_allclose(reward, want.reward, rtol=1e-6)
        np.testing.assert_array_equal(terminated, want.terminated)
        np.testing.assert_array_equal(truncated, want.truncated)
        for k in np.flatnonzero(terminated | truncated):
            np.testing.assert_allclose(
                infos["final_obs"][k], want.final_observation[k, :-1], atol=1e-6
            )


def test_a_seed_decides_everything_and_no_seed_goes_on(envs):
    def play(seed: int | None) -> np.ndarray:
        rows = [envs.reset(seed=seed)[0]]
        actions = np.random.default_rng(0).uniform(-1, 1, (6, 6, 1))
        rows += [envs.step(action)[0] for action in actions]
        return np.stack(rows)

    first = play(5)
    other = play(6)
    again = play(5)
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)
    assert not np.array_equal(play(None), again)


def test_what_was_returned_is_the_user_s_to_keep_and_to_change(envs):
    first, _ = envs.reset(seed=0)
    kept = first.copy()
    second = envs.step(np.zeros((6, 1), np.float32))[0]
    np.testing.assert_array_equal(first, kept)
    second[:] = 0
    first[:] = 7


def test_actions_beyond_the_space_are_its_bounds(envs):
    envs.reset(seed=1)
    beyond = envs.step(np.full((6, 1), 9.0))[1]
    envs.reset(seed=1)
    np.testing.assert_array_equal(beyond, envs.step(np.ones((6, 1)))[1])


@pytest.mark.parametrize(
    ("actions", "words"), [(np.zeros(6), "shape"), (np.full((6, 1), np.nan), "finite")]
)
def test_actions_that_make_no_sense_are_refused(envs, actions, words):
    envs.reset(seed=1)
    with pytest.raises(ValueError, match=words):
        envs.step(actions)


def test_stepping_before_the_first_reset_or_after_the_end_is_refused(game, single):
    env = GymVectorGame(game)
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(np.zeros((6, 1)))
    env.reset()
    env.close()
    env.close()
    with pytest.raises(gymnasium.error.ClosedEnvironmentError):
        env.step(np.zeros((6, 1)))
    one = GymGame(single)
    one.reset(seed=0)
    while True:
        _, _, terminated, truncated, info = one.step(np.ones(1, np.float32))
        if terminated or truncated:
            break
        assert info == {}
    assert info["length"] <= 4
    with pytest.raises(gymnasium.error.ResetNeeded):
        one.step(np.zeros(1, np.float32))


def test_without_gymnasium_it_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    monkeypatch.delitem(sys.modules, gym.__name__)
    with pytest.raises(ImportError, match=r"pip install jaxba\[gym\]") as caught:
        importlib.import_module(gym.__name__)
    assert "\n" not in str(caught.value)


def test_options_of_a_reset_are_refused(envs):
    with pytest.raises(ValueError, match="no options, is given reset_mask"):
        envs.reset(options={"reset_mask": np.ones(6, bool)})


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_wrappers_of_gymnasium_count_every_episode(game, mode):
    counted = gymnasium.wrappers.vector.RecordEpisodeStatistics(GymVectorGame(game, mode))
    counted.reset(seed=0)
    ends = 0
    for _ in range(9):
        *_, terminated, truncated, infos = counted.step(np.zeros((6, 1), np.float32))
        ends += int((terminated | truncated).sum())
        if (terminated | truncated).any():
            assert (infos["episode"]["l"][terminated | truncated] <= 5).all()
    assert counted.episode_count == ends > 6


def test_wrappers_that_ask_for_the_next_step_take_what_is_made_by_default(game):
    envs = GymVectorGame(game)
    assert envs.metadata["autoreset_mode"] == AutoresetMode.NEXT_STEP
    wrappers = gymnasium.wrappers.vector
    wrapped = wrappers.NormalizeObservation(wrappers.NormalizeReward(envs))
    wrapped.reset(seed=0)
    for _ in range(6):
        assert np.isfinite(wrapped.step(np.zeros((6, 1), np.float32))[0]).all()


def play(game, mode, steps):
    """Rows of observations, rewards and ends, and the metrics of episodes by step, with the same
    action everywhere."""
    envs = GymVectorGame(game, mode)
    rows = [envs.reset(seed=4)[0]]
    rewards = []
    ends = []
    infos = []
    for _ in range(steps):
        observation, reward, terminated, truncated, info = envs.step(
            np.full((6, 1), 0.3, np.float32)
        )
        rows.append(observation)
        rewards.append(reward)
        ends.append(terminated | truncated)
        infos.append(info)
    return np.stack(rows), np.stack(rewards), np.stack(ends), infos


def test_episodes_are_the_same_whether_they_begin_in_the_same_step_or_in_the_next(game):
    rows, rewards, ends, infos = play(game, "NextStep", 10)
    same_rows, same_rewards, same_ends, same_infos = play(game, AutoresetMode.SAME_STEP, 9)
    for k in range(6):
        first, second = np.flatnonzero(same_ends[:, k])[:2]
        np.testing.assert_array_equal(np.flatnonzero(ends[:, k])[:2], [first, second + 1])
        np.testing.assert_array_equal(rows[: first + 1, k], same_rows[: first + 1, k])
        np.testing.assert_array_equal(rows[first + 1, k], same_infos[first]["final_obs"][k])
        # the next episode begins
        np.testing.assert_array_equal(rows[first + 2, k], same_rows[first + 1, k])
        np.testing.assert_array_equal(
            rows[first + 2 : second + 2, k], same_rows[first + 1 : second + 1, k]
        )
        assert rewards[first + 1, k] == 0
        np.testing.assert_array_equal(
            np.delete(rewards[: second + 2, k], first + 1), same_rewards[: second + 1, k]
        )
        for name, values in same_infos[first]["final_info"].items():
            assert infos[first][name][k] == values[k]
        assert infos[first]["_length"][k]
        assert not infos[first + 1].get("_length", np.zeros(6))[k]


def test_another_mode_is_refused(game):
    for mode in ("Disabled", AutoresetMode.DISABLED, "same"):
        with pytest.raises(ValueError, match="autoreset_mode must be NextStep or SameStep, is "):
            GymVectorGame(game, mode)


@pytest.mark.parametrize("module", ["jaxba", "jaxba.game.gym"])
def test_gymnasium_knows_the_game_once_a_module_is_imported(module):
    script = f"import gymnasium, {module}; print(gymnasium.spec({gym.ID!r}).vector_entry_point)"
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, timeout=300
    )
    assert done.stdout == "jaxba.training.api:gym_vector_env\n", done.stderr


# Other processes

WORKERS = """
import sys
sys.path[:0] = {path!r}
import warnings
warnings.filterwarnings("ignore")  # JAX warns of forks
import jax
jax.config.update("jax_enable_x64", True)
import gymnasium, numpy as np
from tiny_game import tiny_game
from jaxba.game.gym import GymGame

def make():
    return GymGame(tiny_game(envs=1))

if __name__ == "__main__":
    game = tiny_game(envs=1)
    envs = gymnasium.vector.AsyncVectorEnv([lambda: GymGame(game)] * 2, context=sys.argv[1])
    try:
        observation, _ = envs.reset(seed=0)
        print("began", observation.shape)
    except RuntimeError as error:
        print(error)
    finally:
        envs.close(terminate=True)
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="other systems do not fork")
@pytest.mark.parametrize(("context", "words"), [("fork", 'AsyncVectorEnv(..., context="spawn")')])
def test_a_forked_worker_says_at_once_how_to_begin_it(tmp_path, context, words):
    script = tmp_path / "workers.py"
    script.write_text(
        WORKERS.format(path=[str(Path(__file__).parent.parent), str(Path(__file__).parents[2])])
    )
    command = [sys.executable, str(script), context]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert words in done.stdout, done.stdout + done.stderr
