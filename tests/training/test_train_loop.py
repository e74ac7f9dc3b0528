"""The compiled training loop on games whose answer is known, and its promises: one trace, the same
numbers."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toys

from jaxba.game.protocol import Step
from jaxba.training import sac, train_loop
from jaxba.training.sac import SacConfig
from jaxba.training.train_loop import LoopConfig, LoopState, run_chunk, start
from jaxba.typing import register_pytree

GAMMA = 0.8
TWIN = SacConfig(
    width=16,
    batch=64,
    gamma=GAMMA,
    tau=0.05,
    learning_rate=1e-2,
    initial_temperature=1e-3,
    learn_temperature=False,
)
"""Quick to learn. The entropy bonus is at most 1e-3 log 2 / (1 - gamma) = 0.004 and lies within
every tolerance."""

VALUE = dataclasses.replace(TWIN, variant="value", layer_norm=False, tau=1.0, target_every=5)
AGENTS = {"twin": TWIN, "value": VALUE}
LONG = LoopConfig(replay_capacity=10_000, warmup_steps=201, updates_per_step=1, steps_per_chunk=250)
LEARNS = dataclasses.replace(TWIN, learn_temperature=True, initial_temperature=1.0)
SHORT = LoopConfig(replay_capacity=3000, warmup_steps=16, updates_per_step=2, steps_per_chunk=5)
CHUNKS = 4


@functools.cache
def trained(agent: str, toy: toys.Toy) -> tuple[LoopState, dict[str, float]]:
    """State and last metrics after 1000 vector steps."""
    state = start(AGENTS[agent], LONG, toy, jax.random.key(0))
    metrics = {}
    for _ in range(CHUNKS):
        state, metrics = run_chunk(AGENTS[agent], LONG, toy, state)
    return state, {name: float(value) for name, value in metrics.items()}


def opinions(
    agent: str, toy: toys.Toy, sign: float, clock: float = 0.0, action: float | None = None
) -> np.ndarray:
    """What both critics say, at the policy's own action when None."""
    config = AGENTS[agent]
    learner = trained(agent, toy)[0].learner
    observation = jnp.asarray([[sign, clock]], jnp.float32)
    chosen = (
        sac.act(config, learner.actor, observation, None)
        if action is None
        else jnp.full((1, 1), action)
    )
    return np.asarray(
        sac._critic(config).apply(learner.critic, observation, jnp.asarray(chosen, jnp.float32))
    )[:, 0]


def copied(state: LoopState) -> LoopState:
    return jax.tree.map(jnp.copy, state)


def plain(tree):
    """The tree with keys as numbers."""
    return jax.tree.map(
        lambda x: jax.random.key_data(x) if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else x,
        tree,
    )


# games with a known answer

both_agents = pytest.mark.parametrize("agent", AGENTS)


@both_agents
@pytest.mark.parametrize("sign", [-1.0, pytest.param(1.0, marks=pytest.mark.slow)])
def test_a_reward_that_is_seen(agent: str, sign: float) -> None:
    np.testing.assert_allclose(opinions(agent, toys.SEEN, sign), sign, atol=0.05)


@both_agents
@pytest.mark.parametrize(("clock", "expected"), [(0.0, GAMMA), (1.0, 1.0)])
def test_a_delayed_reward(agent: str, clock: float, expected: float) -> None:
    for sign in (-1.0, 1.0):
        np.testing.assert_allclose(opinions(agent, toys.DELAYED, sign, clock), expected, atol=0.1)


@both_agents
def test_a_reward_that_depends_on_the_action(agent: str) -> None:
    learner = trained(agent, toys.ACTION)[0].learner
    observation = jnp.asarray([[-1.0, 0.0], [1.0, 0.0]])
    np.testing.assert_allclose(
        sac.act(AGENTS[agent], learner.actor, observation, None), 0.3, atol=0.1
    )
    np.testing.assert_allclose(opinions(agent, toys.ACTION, 1.0), 0, atol=0.05)
    for action in (0.0, 0.3, 0.6):
        np.testing.assert_allclose(
            opinions(agent, toys.ACTION, 1.0, action=action), -((action - 0.3) ** 2), atol=0.1
        )


@both_agents
def test_a_reward_that_depends_on_both(agent: str) -> None:
    learner = trained(agent, toys.BOTH)[0].learner
    observation = jnp.asarray([[-1.0, 0.0], [1.0, 0.0]])
    actions = sac.act(AGENTS[agent], learner.actor, observation, None)
    np.testing.assert_allclose(actions[:, 0], [-0.5, 0.5], atol=0.1)
    for sign in (-1.0, 1.0):
        np.testing.assert_allclose(opinions(agent, toys.BOTH, sign), sign, atol=0.1)


@pytest.mark.slow
def test_critics_see_what_the_policy_does_not() -> None:
    learner = trained("twin", toys.HIDDEN)[0].learner
    seen = jnp.asarray([[0.0, -1.0], [0.0, 1.0]], jnp.float32)
    actions = sac.act(TWIN, learner.actor, seen, None)
    np.testing.assert_allclose(actions, 0, atol=0.15)
    assert actions[0] == actions[1]
    values = sac._critic(TWIN).apply(learner.critic, seen, jnp.zeros((2, 1), jnp.float32))
    np.testing.assert_allclose(values, [[-1.25, 0.75]] * 2, atol=0.15)


@pytest.mark.slow
def test_without_the_privilege_critics_see_what_the_policy_sees() -> None:
    plain_critics = dataclasses.replace(TWIN, privileged=False)
    state = start(plain_critics, SHORT, toys.HIDDEN, jax.random.key(0))
    widths = {
        x.shape[-2]
        for path, x in jax.tree_util.tree_leaves_with_path(state.learner.critic)
        if _is_first(path)
    }
    assert widths == {1 + 1}  # the clock and the action
    _, metrics = run_chunk(plain_critics, SHORT, toys.HIDDEN, state)
    assert np.isfinite(metrics["critic_loss"])


def _is_first(path) -> bool:
    return jax.tree_util.keystr(path).endswith("['Dense_0']['kernel']")


@both_agents
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_a_truncated_episode_has_the_value_of_its_true_last_observation(
    agent: str, sign: float
) -> None:
    truth = 1 / (1 - GAMMA)
    mistaken = 1 / (1 - GAMMA / 2)
    assert truth > 2 * mistaken
    np.testing.assert_allclose(opinions(agent, toys.ENDLESS, sign), sign * truth, atol=1)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_the_toy_tells_a_wrong_last_observation_and_a_wrong_terminal_apart(sign: float) -> None:
    for wrong in ({"forgets": True}, {"truncates": False}):
        toy = dataclasses.replace(toys.ENDLESS, **wrong)
        np.testing.assert_allclose(opinions("twin", toy, sign), sign / (1 - GAMMA / 2), atol=0.6)


@pytest.mark.slow
def test_the_entropy_reaches_what_is_wanted() -> None:
    state = start(LEARNS, SHORT, toys.ACTION, jax.random.key(0))
    entropy = []
    for _ in range(150):
        state, metrics = run_chunk(LEARNS, SHORT, toys.ACTION, state)
        entropy.append(metrics["entropy"])
    assert entropy[0] > 0
    np.testing.assert_allclose(np.mean(entropy[-50:]), -1, atol=0.2)
    assert 0 < jnp.exp(state.learner.log_temperature) < 0.2


# promises


def test_numbers_that_are_not_finite_are_kept_out() -> None:
    toy = dataclasses.replace(toys.SEEN, breaks=True)
    state, metrics = trained("twin", toy)
    assert all(
        np.all(np.isfinite(x)) for x in jax.tree.leaves(plain((state.learner, state.replay)))
    )
    assert metrics["dropped"] == LONG.steps_per_chunk * toy.num_envs / 2
    for sign in (-1.0, 1.0):
        np.testing.assert_allclose(opinions("twin", toy, sign), sign, atol=0.05)


def test_what_is_counted() -> None:
    state, metrics = trained("twin", toys.ENDLESS)
    warmup = 26 * 8  # 201 steps of 8 environments, rounded up
    assert int(state.env_steps) == warmup + CHUNKS * LONG.steps_per_chunk * 8
    assert int(state.updates) == int(state.learner.updates) == CHUNKS * LONG.steps_per_chunk
    assert int(state.replay.size) == warmup + CHUNKS * LONG.steps_per_chunk * 8
    assert metrics["episodes"] == LONG.steps_per_chunk * 8 / 2
    assert metrics["episode/length"] == 2
    assert metrics["dropped"] == 0
    # signs of 1000 episodes, five standard deviations
    np.testing.assert_allclose(metrics["reward"], 0, atol=0.15)


def test_a_chunk_without_an_end_has_no_means_of_episodes() -> None:
    toy = dataclasses.replace(toys.ENDLESS, length=1_000_000)
    state = start(LEARNS, SHORT, toy, jax.random.key(0))
    _, metrics = run_chunk(LEARNS, SHORT, toy, state)
    assert metrics["episodes"] == 0
    assert metrics["episode/length"] == 0


@both_agents
def test_critics_that_know_the_reward_have_no_bias(agent: str) -> None:
    np.testing.assert_allclose(trained(agent, toys.SEEN)[1]["q_bias"], 0, atol=0.05)


def test_the_bias_is_value_less_return_with_entropy_in_terminated_episodes() -> None:
    rng = np.random.default_rng(0)
    value, bonus, reward = rng.normal(size=(3, 12, 5))
    ended = rng.random((12, 5)) < 0.3
    terminated = ended & (rng.random((12, 5)) < 0.7)
    errors = []
    for env in range(5):
        for k in range(12):
            ends = np.flatnonzero(ended[k:, env])
            if len(ends) and terminated[k + ends[0], env]:
                rest = np.arange(ends[0] + 1)
                paid = reward[k + rest, env] + np.where(rest > 0, bonus[k + rest, env], 0)
                errors.append(value[k, env] - np.sum(GAMMA**rest * paid))
    assert 10 < len(errors) < 50
    found = train_loop._bias(
        train_loop._Judged(*map(jnp.asarray, (value, bonus, reward, terminated, ended))), GAMMA
    )
    np.testing.assert_allclose(found, np.mean(errors), rtol=1e-12)
    nothing = jnp.zeros((12, 5), bool)
    assert jnp.isnan(
        train_loop._bias(train_loop._Judged(value, bonus, reward, nothing, nothing), GAMMA)
    )


def test_the_spread_of_actions_is_that_of_what_is_to_be_done() -> None:
    assert trained("twin", toys.ACTION)[1]["action_spread"] < 0.05
    both = trained("twin", toys.BOTH)[1]  # half of the states want 0.5, half -0.5
    np.testing.assert_allclose(both["action_spread"], 0.5, atol=0.1)


def test_the_warm_up_holds_the_demonstrations() -> None:
    state = start(TWIN, LONG, toys.ACTION, jax.random.key(3))
    actions = state.replay.rows[:208, 2]
    rewards = state.replay.rows[:208, 5]
    assert np.ptp(actions) > 1.8
    np.testing.assert_allclose(rewards, -((actions - 0.3) ** 2), atol=1e-6)
    assert int(state.updates) == 0


def test_compiles_once() -> None:
    once = functools.partial(jax.jit, static_argnames=("sac", "loop"))
    begin, chunk = (
        once(chex.assert_max_traces(function.__wrapped__, n=1)) for function in (start, run_chunk)
    )
    # other numbers, other keys, several chunks: the same program
    for seed, slope in enumerate((1.0, 2.0, -1.0)):
        game = dataclasses.replace(toys.SEEN, slope=slope)
        state = begin(LEARNS, SHORT, game, jax.random.key(seed))
        for _ in range(3):
            state, _ = chunk(LEARNS, SHORT, game, state)
    assert int(state.updates) == 3 * 5 * 2


@register_pytree
@dataclasses.dataclass(frozen=True)
class OneRewardForAll(toys.Toy):
    """A mistake: a reward that would be broadcast over all environments."""

    def step(self, state: Any, action: jax.Array) -> tuple[Any, Step]:
        after, step = super().step(state, action)
        return after, step._replace(reward=step.reward[:1])


def test_an_environment_of_other_shapes_than_the_protocols_is_refused(unchecked) -> None:
    with pytest.raises(AssertionError, match="shape"):
        start(LEARNS, SHORT, OneRewardForAll(), jax.random.key(0))


def test_a_state_that_was_played_on_is_given_away_and_its_memory_used_again() -> None:
    state = start(LEARNS, SHORT, toys.ACTION, jax.random.key(0))
    rows = state.replay.rows
    place = rows.unsafe_buffer_pointer()
    after, _ = run_chunk(LEARNS, SHORT, toys.ACTION, state)
    assert rows.is_deleted()
    assert after.replay.rows.unsafe_buffer_pointer() == place


def test_nothing_leaves_the_device() -> None:
    toy = jax.device_put(toys.ACTION)
    state = start(LEARNS, SHORT, toy, jax.random.key(0))
    with jax.transfer_guard("disallow"):
        state, metrics = run_chunk(LEARNS, SHORT, toy, state)
    assert np.isfinite(metrics["critic_loss"])


def test_everything_learned_is_float32() -> None:
    state = trained("twin", toys.SEEN)[0]
    kept = state._replace(env_state=None)
    for leaf in jax.tree.leaves(plain(kept)):
        assert leaf.dtype in (jnp.float32, jnp.int32, jnp.uint32)


def test_the_same_key_gives_the_same_numbers_and_a_run_goes_on_from_its_state() -> None:
    one, _ = trained("twin", toys.BOTH)
    again = start(TWIN, LONG, toys.BOTH, jax.random.key(0))
    for _ in range(CHUNKS - 1):
        again, _ = run_chunk(TWIN, LONG, toys.BOTH, again)
    stored = jax.tree.map(np.asarray, plain(again))
    restored = jax.tree.map(
        lambda x, y: (
            jax.random.wrap_key_data(x)
            if jnp.issubdtype(y.dtype, jax.dtypes.prng_key)
            else jnp.asarray(x)
        ),
        stored,
        again,
    )
    again, _ = run_chunk(TWIN, LONG, toys.BOTH, restored)
    chex.assert_trees_all_equal(one, again)
    other = start(TWIN, LONG, toys.BOTH, jax.random.key(1))
    assert not np.array_equal(
        other.replay.rows, start(TWIN, LONG, toys.BOTH, jax.random.key(0)).replay.rows
    )


@pytest.mark.parametrize(
    "name", ["replay_capacity", "warmup_steps", "updates_per_step", "steps_per_chunk"]
)
def test_a_loop_needs_something_of_everything(name: str) -> None:
    with pytest.raises(ValueError, match=name):
        LoopConfig(**{name: 0})
