"""Policies that act as an agent does, through the guard: a trained network, or one and the same
action always."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from jaxba.damping.agent_config import AgentConfig
from jaxba.damping.features import Memory, begin, observation_size, observe, record
from jaxba.damping.guard import damping_of
from jaxba.damping.policy import ProblemInfo
from jaxba.lm.records import StepInfo
from jaxba.problem.options import StepOptions
from jaxba.typing import AnyArray, ArrayRecord, register_pytree


class AgentPolicy(ABC):
    """What policies of an agent share: they observe, choose an action, and get the lambda that the
    guard allows."""

    # what is observed, what an action means, and the step that the policy is made for
    config: AgentConfig

    @abstractmethod
    def act(self, observation: Float[Array, " features"]) -> Float[Array, " actions"]:
        """The action in [-1, 1] for an observation."""

    @property
    def min_gain(self) -> float:
        """Gain ratio that a step must exceed."""
        return self.config.min_gain

    def step_options(self, base: StepOptions) -> StepOptions:
        """The step that the policy was trained with; what it does not decide is that of `base`."""
        return self.config.step_options(base)

    def init(self, info: ProblemInfo) -> tuple[Memory, Float[Array, ""]]:
        """See `DampingPolicy`."""
        return self._choose(begin(self.config, info))

    def propose(self, state: Memory, step: StepInfo) -> tuple[Memory, Float[Array, ""]]:
        """See `DampingPolicy`."""
        return self._choose(record(self.config, state, step))

    def _choose(self, memory: Memory) -> tuple[Memory, Float[Array, ""]]:
        action = self.act(observe(self.config, memory))
        return memory, damping_of(self.config, memory.guard, action[0])


class Layer(NamedTuple):
    """`x W + b`."""

    kernel: Float[AnyArray, "inputs outputs"]
    bias: Float[AnyArray, " outputs"]


@register_pytree
@dataclass(frozen=True, eq=False, repr=False)
class LearnedPolicy(ArrayRecord, AgentPolicy):
    """The mean action of a trained actor, limited by the guard.

    The weights are traced: another policy of the same shape never recompiles."""

    layers: tuple[Layer, ...]
    """Hidden layers with ReLU, then mean and log standard deviation of the action before its
    tanh."""

    config: AgentConfig = field(metadata={"static": True})
    """What is observed and what an action means."""

    def act(self, observation: Float[Array, " features"]) -> Float[Array, " actions"]:
        """The action in [-1, 1] for an observation."""
        x = observation
        for layer in self.layers[:-1]:
            x = jax.nn.relu(x @ layer.kernel + layer.bias)
        outputs = x @ self.layers[-1].kernel + self.layers[-1].bias
        return jnp.tanh(outputs[: outputs.shape[0] // 2])


SATURATED = 20.0  # its hyperbolic tangent is 1 in float32


def always(action: float, config: AgentConfig) -> LearnedPolicy:
    """The same action in every state, as a network of one layer without weights: what the guard
    alone achieves. The best one of a game is the baseline that training has to beat."""
    inside = np.tanh(SATURATED / 2)
    before = np.arctanh(action) if abs(action) < inside else np.copysign(SATURATED, action)
    bias = np.array([before, 0], np.float32)
    return LearnedPolicy(
        (Layer(np.zeros((observation_size(config), 2), np.float32), bias),), config
    )


def learned_from(config: AgentConfig, actor: Any) -> LearnedPolicy:
    """The policy of a trained actor's parameters (`training.networks.Actor`) and of the agent's
    configuration."""
    stack = actor["params"]["MLP_0"]
    layers = [
        Layer(stack[f"Dense_{k}"]["kernel"], stack[f"Dense_{k}"]["bias"]) for k in range(len(stack))
    ]
    return LearnedPolicy(tuple(layers), config)
