"""The paper's Zero-net: a network that chooses lambda so that the very next error is smallest.

It sees what the agent sees and did (the last states, actions and rewards) but knows no episode: its gradient is that of
one step's cost, through the differentiable `lm_step`. Nothing of it is shipped; tables train it at run time.

Since the next cost depends on the network through lambda alone, the chain rule has two factors. The first, the slope of
the cost in the action, is taken in forward mode, one number a scene; so a factorisation that failed spoils one number
and not the network.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import Array, lax
from jaxtyping import Float

from jaxba.damping.agent_config import AgentConfig
from jaxba.damping.features import Memory, StepFeatures, begin, record
from jaxba.damping.guard import damping_of
from jaxba.damping.learned import Layer
from jaxba.damping.policy import ProblemInfo
from jaxba.game.env import Episode, Game
from jaxba.game.rollout import step_groups
from jaxba.game.scene_bank import Bank
from jaxba.lm.records import StepInfo
from jaxba.lm.termination import Tolerances, converged_in_cost
from jaxba.paper.config import ZeroNetConfig
from jaxba.runtime.atomic import atomic_write
from jaxba.typing import register_pytree

STEEPEST = 1.0
"""Largest slope of a cost's decimal logarithm in the action that a scene may contribute, so that one diverging step
does not outweigh a batch; a step whose cost is no number counts as that steep, towards a larger lambda."""

_DAMPING, _PRESENT = StepFeatures._fields.index("damping"), StepFeatures._fields.index("present")


@register_pytree
@dataclass(frozen=True)
class ZeroNet:
    """A damping policy: ReLU layers from the last states, actions and rewards to one action."""

    layers: tuple[Layer, ...]
    """Hidden layers, then the action before its tanh."""

    config: AgentConfig = field(metadata={"static": True})
    """Observation `paper`, no guard; says how far back the input goes and what an action means."""

    @property
    def min_gain(self) -> float:
        """Gain ratio that a step must exceed."""
        return self.config.min_gain

    def act(self, memory: Memory) -> Float[Array, ""]:
        """The action in (-1, 1)."""
        x = inputs(memory)
        for layer in self.layers[:-1]:
            x = jax.nn.relu(x @ layer.kernel + layer.bias)
        return jnp.tanh(x @ self.layers[-1].kernel + self.layers[-1].bias)[0]

    def init(self, info: ProblemInfo) -> tuple[Memory, Float[Array, ""]]:
        """See `DampingPolicy`."""
        memory = begin(self.config, info)
        return memory, damping_of(self.config, memory.guard, self.act(memory))

    def propose(self, state: Memory, step: StepInfo) -> tuple[Memory, Float[Array, ""]]:
        """See `DampingPolicy`."""
        memory = record(self.config, state, step)
        return memory, damping_of(self.config, memory.guard, self.act(memory))


def inputs(memory: Memory) -> Float[Array, " features"]:
    """Last errors, last actions as decades of lambda, last rewards: -1 an iteration, 0 where there was none yet."""
    steps = memory.steps
    return jnp.concatenate([memory.errors, steps[:, _DAMPING], -steps[:, _PRESENT]]).astype(jnp.float32)


def fresh(config: ZeroNetConfig, agent: AgentConfig, key: Array) -> ZeroNet:
    """An untrained network: He's normal start for hidden layers, next to zero for the last, as the agent's."""
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
    """One step with an action, and how its cost reacts to the action.

    Returns:
        log10 of the proposed cost over the present one, its derivative in the action, the episode after the step, and
        the step. Rejected steps have a slope too: that of the cost that was refused.
    """

    def play(action: Array) -> tuple[Array, tuple[Episode, StepInfo]]:
        after, step = game.iterate(game.kinds[0], game.banks[0], episode, action[None])
        return jnp.log10(step.candidate_cost / step.previous_cost), (after, step)

    action = action.astype(episode.state.cost.dtype)
    change, slope, (after, step) = jax.jvp(play, (action,), (jnp.ones_like(action),), has_aux=True)
    return change, slope, after, step


class _Training(NamedTuple):
    layers: tuple[Layer, ...]
    adam: Any
    episodes: Episode
    key: Array


def train(config: ZeroNetConfig, game: Game, agent: AgentConfig, key: Array) -> tuple[ZeroNet, np.ndarray]:
    """Trains a network on the first bank of a game.

    Args:
        config: sizes and length.
        game: its scenes; its rules do not matter, there is no reward.
        agent: what an action means.
        key: decides everything.

    Returns:
        The network, and the mean log10 of the next cost over the present one in every update.
    """
    start, play = jax.random.split(key)
    net = fresh(config, agent, start)
    layers, means = _train(config, game, net, play)
    return ZeroNet(jax.tree.map(np.asarray, layers), agent), np.asarray(means)


@functools.partial(jax.jit, static_argnames=("config",))
def _train(
    config: ZeroNetConfig, game: Game, net: ZeroNet, key: Array
) -> tuple[tuple[Layer, ...], Float[Array, " updates"]]:
    adam = optax.adam(config.learning_rate)
    bank: Bank = game.banks[0]

    def another(key: Array) -> Episode:
        scene = jax.random.randint(key, (), 0, bank.initial_cost.shape[0], jnp.int32)
        return game.start(bank, scene)

    def update(state: _Training, _: None) -> tuple[_Training, Array]:
        def loss(layers: tuple[Layer, ...]) -> tuple[Array, tuple[Episode, StepInfo, Array]]:
            policy = ZeroNet(layers, net.config)
            actions = jax.vmap(lambda episode: policy.act(episode.memory))(state.episodes)
            step_one = lambda episode, action: slope_of_next_cost(game, episode, action)
            change, slope, after, step = step_groups(step_one, state.episodes, lax.stop_gradient(actions))
            known = jnp.isfinite(change) & jnp.isfinite(slope)
            slope = jnp.clip(jnp.where(known, slope, -STEEPEST), -STEEPEST, STEEPEST).astype(jnp.float32)
            counted = jnp.sum(jnp.where(known, change, 0.0)) / jnp.maximum(jnp.sum(known), 1)
            return jnp.mean(lax.stop_gradient(slope) * actions), (after, step, counted)

        (_, (after, step, counted)), gradient = jax.value_and_grad(loss, has_aux=True)(state.layers)
        change, optimiser = adam.update(gradient, state.adam, state.layers)
        key, *keys = jax.random.split(state.key, 1 + config.batch)
        converged = jax.vmap(converged_in_cost, in_axes=(0, None))(step, Tolerances().ftol)
        done = converged | (after.memory.guard.iteration >= config.max_iterations)
        new = jax.vmap(another)(jnp.stack(keys))
        pick = lambda new, old: jnp.where(done.reshape(-1, *[1] * (old.ndim - 1)), new, old)
        episodes = jax.tree.map(pick, new, after)
        layers: Any = optax.apply_updates(state.layers, change)
        return _Training(layers, optimiser, episodes, key), counted

    key, *keys = jax.random.split(key, 1 + config.batch)
    episodes = jax.vmap(another)(jnp.stack(keys))
    first = _Training(net.layers, adam.init(net.layers), episodes, key)
    last, means = lax.scan(update, first, None, length=config.updates)
    return last.layers, means


def parameters(net: ZeroNet) -> int:
    """Numbers in a network."""
    return sum(int(np.size(part)) for layer in net.layers for part in layer)


def save(path: Any, net: ZeroNet) -> None:
    """Writes the weights, whole or not at all."""
    with atomic_write(path) as file:
        arrays: dict[str, Any] = {
            f"{name}{k}": np.asarray(getattr(layer, name))
            for k, layer in enumerate(net.layers)
            for name in Layer._fields
        }
        np.savez(file, **arrays)


def restore(path: Any, agent: AgentConfig) -> ZeroNet:
    """The inverse of `save`."""
    with np.load(path) as file:
        count = len(file.files) // 2
        layers = tuple(Layer(file[f"kernel{k}"], file[f"bias{k}"]) for k in range(count))
    return ZeroNet(layers, agent)
