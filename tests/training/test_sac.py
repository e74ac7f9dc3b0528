"""The agent: its distribution over actions, its networks, and single updates that can be worked out
by hand."""

from __future__ import annotations

import dataclasses
import functools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate, stats

from jaxba.training import networks, sac
from jaxba.training.config import load
from jaxba.training.replay import Transition
from jaxba.training.sac import Learner, SacConfig

FEATURES = 3
ACTIONS = 2
SMALL = SacConfig(width=8, layers=1, batch=32, gamma=0.5, learning_rate=1e-5)
"""So small a rate that what is updated first does not disturb what is computed next."""

VALUE = dataclasses.replace(
    SMALL, variant="value", learn_temperature=False, tau=1.0, target_every=3, layer_norm=False
)

_update = jax.jit(sac.update, static_argnames=("config",))
_init = jax.jit(sac.init, static_argnames=("config", "observation_size", "action_size"))


@functools.cache
def fresh(config: SacConfig) -> Learner:
    return _init(config, jax.random.key(1, impl="rbg"), FEATURES, ACTIONS)


def batch(count: int = 32, reward: float = 2.0, discount: float = 1.0) -> Transition:
    keys = jax.random.split(jax.random.key(2), 3)

    def wide(key, size):
        return jax.random.uniform(key, (count, size), jnp.float64, -1, 1)

    def full(x):
        return jnp.full(count, x, jnp.float64)

    return Transition(
        wide(keys[0], FEATURES),
        wide(keys[1], ACTIONS),
        full(reward),
        wide(keys[2], FEATURES),
        full(discount),
    )


def zeroed(params, biases):
    """A network that says the same everywhere: its last biases."""
    zeros = jax.tree.map(jnp.zeros_like, params)
    paths, tree = jax.tree_util.tree_flatten_with_path(zeros)
    last = f"['Dense_{SMALL.layers}']['bias']"
    filled = [
        jnp.asarray(biases, x.dtype).reshape(x.shape)
        if jax.tree_util.keystr(path).endswith(last)
        else x
        for path, x in paths
    ]
    assert sum(jax.tree_util.keystr(path).endswith(last) for path, _ in paths) == 1
    return jax.tree_util.tree_unflatten(tree, filled)


def equal(one, other) -> bool:
    return all(jax.tree.leaves(jax.tree.map(lambda a, b: bool(jnp.array_equal(a, b)), one, other)))


# the distribution


@pytest.mark.parametrize(("mean", "log_std"), [(0.0, 0.0), (0.7, -1.5), (-2.0, 0.5), (0.0, 2.0)])
def test_density_is_that_of_the_squashed_variable(mean: float, log_std: float) -> None:
    x = np.linspace(mean - 10 * np.exp(log_std), mean + 10 * np.exp(log_std), 40_001)
    x = x[np.abs(x) < 9]  # beyond, float64 cannot tell u from one
    log_density = networks.log_probability(
        jnp.asarray((x - mean) / np.exp(log_std))[:, None],
        jnp.full((x.size, 1), log_std),
        jnp.asarray(x)[:, None],
    )
    u = np.tanh(x)
    expected = stats.norm.logpdf(np.arctanh(u), mean, np.exp(log_std)) - np.log((1 - u) * (1 + u))
    np.testing.assert_allclose(log_density, expected, rtol=1e-6, atol=1e-6)
    inside = stats.norm.cdf(x[-1], mean, np.exp(log_std)) - stats.norm.cdf(
        x[0], mean, np.exp(log_std)
    )
    np.testing.assert_allclose(integrate.trapezoid(np.exp(log_density), u), inside, rtol=1e-4)


def test_samples_follow_the_density() -> None:
    mean = 0.4
    log_std = -0.3

    def full(value):
        return jnp.full((20_000, 1), value, jnp.float32)

    action, log_prob = networks.sample_action(full(mean), full(log_std), jax.random.key(0))
    assert action.dtype == log_prob.dtype == jnp.float32

    def cdf(u):
        return stats.norm.cdf(np.arctanh(u), mean, np.exp(log_std))

    assert stats.kstest(np.asarray(action[:, 0], np.float64), cdf).pvalue > 1e-3

    def density(u):
        return np.exp(stats.norm.logpdf(np.arctanh(u), mean, np.exp(log_std))) / (1 - u**2)

    entropy = integrate.quad(lambda u: -density(u) * np.log(density(u)), -1 + 1e-9, 1 - 1e-9)[0]
    np.testing.assert_allclose(-jnp.mean(log_prob), entropy, atol=0.02)


def test_far_tails_stay_finite_and_inside() -> None:
    def total(mean, log_std):
        action, log_prob = networks.sample_action(mean, log_std, jax.random.key(0))
        return jnp.sum(log_prob) + jnp.sum(action), (action, log_prob)

    mean = jnp.asarray([[-80.0], [-9.0], [9.0], [80.0]], jnp.float32)
    for log_std in (-20.0, 2.0):
        spread = jnp.full_like(mean, log_std)
        gradients, (action, log_prob) = jax.grad(total, argnums=(0, 1), has_aux=True)(mean, spread)
        assert np.all(np.abs(action) < 1)
        assert np.all(np.isfinite(log_prob))
        assert all(np.all(np.isfinite(g)) for g in gradients)


# the networks


def test_everything_is_float32_and_the_members_differ() -> None:
    learner = fresh(SMALL)
    for leaf in jax.tree.leaves(
        (learner.actor, learner.critic, learner.target, learner.log_temperature)
    ):
        assert leaf.dtype == jnp.float32
    stepped, metrics = _update(SMALL, learner, batch())
    chex.assert_trees_all_equal_shapes_and_dtypes(learner, stepped)
    assert all(value.dtype == jnp.float32 for value in metrics.values())
    first, second = (jax.tree.map(lambda x, i=i: x[i], learner.critic) for i in (0, 1))
    assert not equal(first, second)


@pytest.mark.parametrize("config", [SMALL, VALUE], ids=["twin", "value"])
def test_a_fresh_agent_knows_nothing(config: SacConfig) -> None:
    learner = fresh(config)
    data = batch()
    opinions = sac._critic(config).apply(
        learner.critic, *(jnp.asarray(x, jnp.float32) for x in data[:2])
    )
    assert opinions.shape == (2, 32)
    np.testing.assert_allclose(opinions, 0, atol=0.1)
    np.testing.assert_allclose(sac.act(config, learner.actor, data.observation, None), 0, atol=0.1)
    mean, log_std = sac._actor(config, ACTIONS).apply(
        learner.actor, jnp.asarray(data.observation, jnp.float32)
    )
    np.testing.assert_allclose(log_std, 0, atol=0.2)
    assert mean.shape == log_std.shape == (32, ACTIONS)


def test_log_std_stays_within_its_bounds() -> None:
    actor = networks.Actor(8, 1, 1, -5.0)
    x = jnp.asarray([[1.0], [-1.0]], jnp.float32)
    params = jax.tree.map(lambda leaf: 1e3 * leaf, actor.init(jax.random.key(0), x))
    log_std = actor.apply(params, 1e3 * x)[1]
    assert np.all((log_std >= -5) & (log_std <= 2))
    assert np.ptp(log_std) > 1


def test_acting() -> None:
    learner = fresh(SMALL)
    observation = batch().observation
    certain = sac.act(SMALL, learner.actor, observation, None)
    drawn = [sac.act(SMALL, learner.actor, observation, jax.random.key(i)) for i in (0, 0, 1)]
    assert certain.shape == (32, ACTIONS)
    assert certain.dtype == jnp.float32
    chex.assert_trees_all_equal(drawn[0], drawn[1])
    assert not equal(drawn[0], drawn[2])
    one = sac.act(SMALL, learner.actor, observation[3], None)
    np.testing.assert_allclose(one, certain[3], rtol=1e-5, atol=1e-7)


# single updates


@pytest.mark.parametrize("discount", [0.0, 1.0])
def test_targets_of_twin_critics_are_the_smaller_one(discount: float) -> None:
    learner = fresh(SMALL)
    learner = learner._replace(
        critic=zeroed(learner.critic, [1.0, 0.0]),
        target=zeroed(learner.target, [5.0, -3.0]),
        log_temperature=jnp.asarray(-30.0, jnp.float32),
    )
    _, metrics = _update(SMALL, learner, batch(discount=discount))
    goal = 2 + 0.5 * discount * -3
    np.testing.assert_allclose(metrics["critic_loss"], (1 - goal) ** 2 + goal**2, rtol=1e-5)
    np.testing.assert_allclose(metrics["q_mean"], 0.5, rtol=1e-6)
    np.testing.assert_allclose(metrics["temperature"], np.exp(-30), rtol=1e-5)


@pytest.mark.parametrize("discount", [0.0, 1.0])
def test_targets_with_a_value_network(discount: float) -> None:
    learner = fresh(VALUE)
    learner = learner._replace(
        critic=zeroed(learner.critic, [1.0, 0.0]),
        value=zeroed(learner.value, 4.0),
        target=zeroed(learner.target, 7.0),
        log_temperature=jnp.asarray(-30.0, jnp.float32),
    )
    _, metrics = _update(VALUE, learner, batch(discount=discount))
    goal = 2 + 0.5 * discount * 7
    np.testing.assert_allclose(metrics["critic_loss"], (1 - goal) ** 2 + goal**2, rtol=1e-5)
    np.testing.assert_allclose(metrics["value_loss"], (4 - 0) ** 2, rtol=1e-4)


def test_the_entropy_bonus_has_the_temperature_as_its_weight() -> None:
    learner = fresh(SMALL)
    learner = learner._replace(
        critic=zeroed(learner.critic, [1.0, 1.0]), target=zeroed(learner.target, [0.0, 0.0])
    )
    _, metrics = _update(SMALL, learner, batch(reward=0.0))
    np.testing.assert_allclose(metrics["actor_loss"], -1 - 0.1 * metrics["entropy"], rtol=1e-4)

    # the fresh policy is the same everywhere: tanh of a standard normal number, twice
    def density(x):
        return stats.norm.pdf(x) * (2 * np.log(np.cosh(x)) + stats.norm.logpdf(x))

    entropy = -2 * integrate.quad(density, -8, 8)[0]
    np.testing.assert_allclose(metrics["entropy"], entropy, atol=0.3)
    np.testing.assert_allclose(
        metrics["critic_loss"], 2 * (1 - 0.5 * 0.1 * entropy) ** 2, rtol=0.04
    )


def test_the_target_follows_softly_or_now_and_then() -> None:
    learner = fresh(SMALL)
    after, _ = _update(SMALL, learner, batch())
    expected = jax.tree.map(
        lambda old, new: 0.995 * old + 0.005 * new, learner.target, after.critic
    )
    chex.assert_trees_all_close(after.target, expected, rtol=1e-5, atol=1e-7)

    learner = fresh(VALUE)
    start = learner.target
    for count in range(1, 7):
        before = learner
        (learner, _) = _update(VALUE, learner, batch())
        assert int(learner.updates) == count
        chex.assert_trees_all_equal(
            learner.target, learner.value if count % 3 == 0 else before.target
        )
        assert not equal(learner.value, before.value)
    assert not equal(learner.target, start)


@pytest.mark.parametrize(("log_std", "direction"), [(0.0, -1), (-20.0, 1)])
def test_the_temperature_moves_towards_the_wanted_entropy(log_std: float, direction: int) -> None:
    learner = fresh(SMALL)
    learner = learner._replace(actor=zeroed(learner.actor, [0.0, 0.0, log_std, log_std]))
    for _ in range(3):
        before = learner.log_temperature
        (learner, metrics) = _update(SMALL, learner, batch())
        assert np.sign(metrics["entropy"] - -ACTIONS) == -direction
        assert np.sign(learner.log_temperature - before) == direction


def test_a_fixed_temperature_stays() -> None:
    learner, metrics = _update(VALUE, fresh(VALUE), batch())
    np.testing.assert_allclose(metrics["temperature"], VALUE.initial_temperature, rtol=1e-6)
    chex.assert_trees_all_equal(learner.log_temperature, fresh(VALUE).log_temperature)


def test_the_papers_networks_have_as_many_layers_as_it_says() -> None:
    paper = load("paper").sac
    layers = jax.eval_shape(lambda key: sac.init(paper, key, 5, 1), jax.random.key(0))

    def count(params):
        return sum(
            "kernel" in jax.tree_util.keystr(path) for path, _ in jax.tree.leaves_with_path(params)
        )

    # two critics, stacked
    assert (count(layers.actor), count(layers.critic), count(layers.value)) == (4, 3, 3)
