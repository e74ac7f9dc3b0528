"""The paper's Zero-net: a network that chooses lambda to minimise the cost after the next step.

Its input is the same history as the agent's (the last states, actions and rewards), but it is
trained greedily: the gradient is that of the cost after one step, through the differentiable
`lm_step`. It is trained when a table needs it.

The next cost depends on the network through lambda only, so the gradient is a product of two
factors. The derivative of the cost by the action is in forward mode, a number per scene: a failed
factorisation spoils only one."""

from __future__ import annotations

import functools
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import Array, lax
from jaxtyping import Float

from jaxba.damping.agent_config import AgentConfig
from jaxba.damping.features import Memory, StepFeatures
from jaxba.damping.guard import damping_of
from jaxba.damping.learned import AgentPolicy, Layer
from jaxba.game.env import Episode, Game
from jaxba.game.scene_bank import Bank
from jaxba.lm.records import StepInfo
from jaxba.lm.termination import Tolerances, converged_in_cost
from jaxba.paper.config import ZeroNetConfig
from jaxba.runtime.groups import step_groups
from jaxba.runtime.jit import jit
from jaxba.training import checkpoint
from jaxba.typing import register_pytree

# of log10(cost) by the action, for each scene; that of a step of non-finite cost is its negative
MAX_SLOPE = 1.0

_DAMPING = StepFeatures._fields.index("damping")
_PRESENT = StepFeatures._fields.index("present")


@register_pytree
@dataclass(frozen=True)
class ZeroNet(AgentPolicy):
    """A damping policy: a ReLU network from the last states, actions and rewards to one action."""

    layers: tuple[Layer, ...]  # hidden layers, then the output layer, whose tanh is the action
    # length of the history and range of lambda; must have the observation `paper` and no guard
    config: AgentConfig = field(metadata={"static": True})

    def act(self, memory: Memory) -> Float[Array, ""]:
        """The action in (-1, 1)."""
        x = inputs(memory)
        for layer in self.layers[:-1]:
            x = jax.nn.relu(x @ layer.kernel + layer.bias)
        return jnp.tanh(x @ self.layers[-1].kernel + self.layers[-1].bias)[0]

    def _choose(self, memory: Memory) -> tuple[Memory, Float[Array, ""]]:
        return memory, damping_of(self.config, memory.guard, self.act(memory))


def inputs(memory: Memory) -> Float[Array, " features"]:
    """Input of the network: last errors, actions as log10(lambda), rewards (-1 an iteration, 0
    where none was yet)."""
    steps = memory.steps
    return jnp.concatenate([memory.errors, steps[:, _DAMPING], -steps[:, _PRESENT]]).astype(
        jnp.float32
    )


def initial_network(config: ZeroNetConfig, agent: AgentConfig, key: Array) -> ZeroNet:
    """An untrained network: He initialisation for hidden layers, nearly zero for the last, as for
    the agent."""
    sizes = [3 * agent.history, *[config.width] * config.layers, 1]
    layers = []
    for k, (rows, columns) in enumerate(pairwise(sizes)):
        scale = 3e-3 if k == config.layers else (2 / rows) ** 0.5
        kernel = scale * jax.random.normal(jax.random.fold_in(key, k), (rows, columns), jnp.float32)
        layers.append(Layer(kernel, jnp.zeros((columns,), jnp.float32)))
    return ZeroNet(tuple(layers), agent)


def slope_of_next_cost(
    game: Game, episode: Episode, action: Float[Array, ""]
) -> tuple[Float[Array, ""], Float[Array, ""], Episode, StepInfo]:
    """Makes one step, rejected or not. Returns log10 of the candidate's cost over the current cost,
    its derivative by the action, the episode after the step, and the step."""

    def play(action: Array) -> tuple[Array, tuple[Episode, StepInfo]]:
        after, step = game.iterate(game.bank, episode, action[None])
        return jnp.log10(step.candidate_cost / step.previous_cost), (after, step)

    action = action.astype(episode.state.cost.dtype)
    change, slope, (after, step) = jax.jvp(play, (action,), (jnp.ones_like(action),), has_aux=True)
    return change, slope, after, step


def train(
    config: ZeroNetConfig, game: Game, agent: AgentConfig, key: Array
) -> tuple[ZeroNet, np.ndarray]:
    """Trains a network on the scenes of a game, whose rewards are not used. `config` has the sizes
    of the network and of the training, `agent` the length of the history and the range of lambda.
    Returns the network, and for each update the mean of log10(next cost / current cost)."""
    start, play = jax.random.split(key)
    net = initial_network(config, agent, start)
    layers, means = _train(config, game, net, play)
    return ZeroNet(jax.tree.map(np.asarray, layers), agent), np.asarray(means)


@functools.partial(jit, static_argnames=("config",))
def _train(
    config: ZeroNetConfig, game: Game, net: ZeroNet, key: Array
) -> tuple[tuple[Layer, ...], Float[Array, " updates"]]:
    adam = optax.adam(config.learning_rate)
    bank: Bank = game.bank

    def another(key: Array) -> Episode:
        scene = jax.random.randint(key, (), 0, bank.initial_cost.shape[0], jnp.int32)
        return game.start(bank, scene)

    def update(state: tuple[Any, ...], _: None) -> tuple[tuple[Any, ...], Array]:
        layers, optimiser, episodes, key = state

        def loss(layers: tuple[Layer, ...]) -> tuple[Array, tuple[Episode, StepInfo, Array]]:
            policy = ZeroNet(layers, net.config)
            actions = jax.vmap(lambda episode: policy.act(episode.memory))(episodes)

            def step_one(episode, action):
                return slope_of_next_cost(game, episode, action)

            change, slope, after, step = step_groups(step_one, episodes, lax.stop_gradient(actions))
            known = jnp.isfinite(change) & jnp.isfinite(slope)
            slope = jnp.clip(jnp.where(known, slope, -MAX_SLOPE), -MAX_SLOPE, MAX_SLOPE).astype(
                jnp.float32
            )
            counted = jnp.sum(jnp.where(known, change, 0.0)) / jnp.maximum(jnp.sum(known), 1)
            return jnp.mean(lax.stop_gradient(slope) * actions), (after, step, counted)

        (_, (after, step, counted)), gradient = jax.value_and_grad(loss, has_aux=True)(layers)
        change, optimiser = adam.update(gradient, optimiser, layers)
        key, *keys = jax.random.split(key, 1 + config.batch)
        converged = jax.vmap(converged_in_cost, in_axes=(0, None))(step, Tolerances().ftol)
        done = converged | (after.memory.iteration >= config.max_iterations)
        new = jax.vmap(another)(jnp.stack(keys))

        def pick(new, old):
            return jnp.where(done.reshape(-1, *[1] * (old.ndim - 1)), new, old)

        episodes = jax.tree.map(pick, new, after)
        layers = optax.apply_updates(layers, change)
        return (layers, optimiser, episodes, key), counted

    key, *keys = jax.random.split(key, 1 + config.batch)
    episodes = jax.vmap(another)(jnp.stack(keys))
    first = net.layers, adam.init(net.layers), episodes, key
    (layers, *_), means = lax.scan(update, first, None, length=config.updates)
    return layers, means


def save(path: Path, net: ZeroNet) -> None:
    """Writes the weights to a .npz file atomically."""
    checkpoint.write_arrays(path, checkpoint.pack(net.layers))


def restore(path: Path, config: ZeroNetConfig, agent: AgentConfig) -> ZeroNet:
    """Reads the network that `save` wrote."""
    like = jax.eval_shape(lambda: initial_network(config, agent, jax.random.key(0)).layers)
    return ZeroNet(
        jax.tree.map(np.asarray, checkpoint.unpack(checkpoint.read_arrays(path), like)), agent
    )
