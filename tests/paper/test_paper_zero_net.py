"""The Zero-net: its gradient against finite differences, its input, its file, its training."""

from __future__ import annotations

import functools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tiny_game import tiny_bank, tiny_game

from jaxba.damping.agent_config import AgentConfig
from jaxba.damping.guard import damping_of
from jaxba.damping.learned import Layer
from jaxba.game.env import GameConfig
from jaxba.paper import zero_net
from jaxba.paper.config import ZeroNetConfig
from jaxba.paper.zero_net import ZeroNet

AGENT = AgentConfig(
    observation="paper",
    history=3,
    low=-6.0,
    high=2.0,
    guard="off",
    escalate=0.0,
)
SMALL = ZeroNetConfig(width=8, layers=2, batch=8, updates=30, max_iterations=10, learning_rate=0.03)


@functools.cache
def game():
    return tiny_game(GameConfig(agent=AGENT, max_iterations=10))


def start(scene: int):
    return game().start(tiny_bank(), jnp.asarray(scene, jnp.int32))


_iterate = jax.jit(lambda episode, action: game().iterate(game().bank, episode, action[None]))
_slope = jax.jit(lambda episode, action: zero_net.slope_of_next_cost(game(), episode, action))


def next_cost(episode, action: float) -> float:
    step = _iterate(episode, jnp.asarray(action))[1]
    return float(jnp.log10(step.candidate_cost / step.previous_cost))


@pytest.mark.slow
@pytest.mark.parametrize("scene", [0, 3, 7])
@pytest.mark.parametrize("action", [-0.4, 0.1, 0.7])
def test_the_derivative_of_the_next_cost_is_that_by_finite_differences(scene, action):
    episode = _iterate(start(scene), jnp.asarray(0.5))[0]
    change, slope, after, step = _slope(episode, jnp.asarray(action))
    h = 1e-4
    expected = (next_cost(episode, action + h) - next_cost(episode, action - h)) / (2 * h)
    assert float(change) == pytest.approx(next_cost(episode, action), abs=1e-9)
    assert float(slope) == pytest.approx(expected, rel=1e-4, abs=1e-6)
    assert int(after.memory.iteration) == 2
    assert float(step.damping) == pytest.approx(10 ** (-2 + 4 * action))


@pytest.mark.slow
def test_the_gradient_of_a_weight_follows_the_chain_rule():
    net = zero_net.initial_network(SMALL, AGENT, jax.random.key(0))
    episode = start(2)

    def moved(by: float) -> ZeroNet:
        *hidden, last = net.layers
        return ZeroNet(
            (*hidden, Layer(last.kernel, last.bias + jnp.asarray(by, jnp.float32))), AGENT
        )

    def action(bias):
        return moved(bias).act(episode.memory)

    h = 0.02
    expected = (next_cost(episode, float(action(h))) - next_cost(episode, float(action(-h)))) / (
        2 * h
    )
    slope = float(_slope(episode, action(0.0))[1])
    assert slope * float(jax.grad(action)(0.0)) == pytest.approx(expected, rel=2e-2)


@pytest.mark.slow
def test_the_input_is_errors_actions_and_rewards_of_the_last_steps():
    episode = start(1)
    first = episode.memory
    one = _iterate(episode, jnp.asarray(0.25))[0]
    two, step = _iterate(one, jnp.asarray(-0.5))
    seen = np.asarray(zero_net.inputs(two.memory)).reshape(3, 3)

    def rms(cost):
        return np.sqrt(2 * float(cost) / float(first.info.observations))

    errors = [min(rms(cost), 1000.0) for cost in (step.cost, one.state.cost, first.cost)]
    assert seen[0] == pytest.approx(errors, rel=1e-6)
    decades = [
        np.log10(float(damping_of(AGENT, first.guard, jnp.asarray(a)))) for a in (-0.5, 0.25)
    ]
    assert seen[1] == pytest.approx([*((d + 4) / 6 for d in decades), 0.0], abs=1e-6)
    assert seen[2].tolist() == [-1.0, -1.0, 0.0]


def test_three_layers_of_1280_have_the_papers_count_of_parameters():
    net = zero_net.initial_network(ZeroNetConfig(), AgentConfig(history=5), jax.random.key(0))
    assert (
        sum(part.size for layer in net.layers for part in layer)
        == 15 * 1280 + 1280 + 2 * (1280 * 1280 + 1280) + 1280 + 1
    )


def test_a_network_is_read_as_it_was_written(tmp_path):
    net = zero_net.initial_network(SMALL, AGENT, jax.random.key(3))
    zero_net.save(tmp_path / "net.npz", net)
    again = zero_net.restore(tmp_path / "net.npz", SMALL, AGENT)
    assert [p.name for p in tmp_path.iterdir()] == ["net.npz"]
    assert len(jax.tree.leaves(net)) == 6
    chex.assert_trees_all_equal(net, again, strict=True)


@pytest.mark.slow
def test_training_decreases_a_lambda_that_is_far_too_large():
    net = zero_net.initial_network(SMALL, AGENT, jax.random.key(1))
    *hidden, last = net.layers
    timid = ZeroNet((*hidden, Layer(last.kernel, last.bias + 1.5)), AGENT)
    layers, means = zero_net._train(SMALL, game(), timid, jax.random.key(2))
    memories = [start(scene).memory for scene in range(6)]
    before = np.mean([float(timid.act(memory)) for memory in memories])
    after = np.mean([float(ZeroNet(layers, AGENT).act(memory)) for memory in memories])
    assert before > 0.85
    assert after < 0.5
    assert np.isfinite(np.asarray(means)).all()
