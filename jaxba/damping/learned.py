"""A trained agent as a damping policy, and the file that it lives in.

A policy file is one `.safetensors`: the weights of the actor, and in its metadata how the agent is wired
(`AgentConfig`) and where it comes from. It is read without flax.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from jaxba.damping.agent import AgentConfig, Memory, begin, config_from, damping_of, observe, record, with_effort
from jaxba.damping.policy import ProblemInfo
from jaxba.linear.step import Effort
from jaxba.lm.records import StepInfo
from jaxba.problem.options import StepOptions
from jaxba.typing import AnyArray, register_pytree

FORMAT = "jaxba-policy-1"
"""Kind and version of a policy file, in its metadata."""

LARGEST_FILE = 1 << 20
"""Bytes; a policy file is never larger (issue 3)."""


class PolicyFileError(ValueError):
    """A file that is no policy. The message is one line for a person."""


class Layer(NamedTuple):
    """`x W + b`."""

    kernel: Float[AnyArray, "inputs outputs"]
    bias: Float[AnyArray, " outputs"]


@register_pytree
@dataclass(frozen=True)
class Learned:
    """The mean action of a trained actor. Its weights are traced: another policy of the same shape never recompiles."""

    layers: tuple[Layer, ...]
    """Hidden layers with ReLU, then mean and log standard deviation of the action before its tanh."""

    config: AgentConfig = field(metadata={"static": True})
    """How actions and observations are to be understood."""

    @property
    def min_gain(self) -> float:
        """Gain ratio that a step must exceed."""
        return self.config.min_gain

    def act(self, observation: Float[Array, " features"]) -> Float[Array, " actions"]:
        """The action in (-1, 1) for an observation."""
        x = observation
        for layer in self.layers[:-1]:
            x = jax.nn.relu(x @ layer.kernel + layer.bias)
        outputs = x @ self.layers[-1].kernel + self.layers[-1].bias
        return jnp.tanh(outputs[: outputs.shape[0] // 2])

    def effort(self, state: Memory) -> Effort | None:
        """What the next step may cost; None where that is not the policy's to decide."""
        return state.effort

    def step_options(self, base: StepOptions) -> StepOptions:
        """The step that the policy was trained with; what it does not decide is that of `base`."""
        return self.config.step_options(base)

    def _choose(self, memory: Memory) -> tuple[Memory, Float[Array, ""]]:
        action = self.act(observe(self.config, memory))
        return with_effort(self.config, memory, action), damping_of(self.config, memory, action[0])

    def init(self, info: ProblemInfo) -> tuple[Memory, Float[Array, ""]]:
        """See `DampingPolicy`."""
        return self._choose(begin(self.config, info))

    def propose(self, state: Memory, step: StepInfo) -> tuple[Memory, Float[Array, ""]]:
        """See `DampingPolicy`."""
        return self._choose(record(self.config, state, step))


def learned_from(config: AgentConfig, actor: Any) -> Learned:
    """The policy of a trained actor.

    Args:
        config: how the agent was wired in training.
        actor: parameters of `game.networks.Actor`.
    """
    stack = actor["params"]["MLP_0"]
    layers = [Layer(stack[f"Dense_{k}"]["kernel"], stack[f"Dense_{k}"]["bias"]) for k in range(len(stack))]
    return Learned(tuple(layers), config)


def save_policy(path: str | Path, policy: Learned, metadata: dict[str, str] | None = None) -> None:
    """Writes a policy file, whole or not at all.

    Args:
        path: where to; conventionally ends in `.safetensors`.
        policy: what to write.
        metadata: where it comes from, for people.

    Raises:
        PolicyFileError: it would be too large to be read again.
    """
    from safetensors.numpy import save

    tensors = {}
    for k, layer in enumerate(policy.layers):
        tensors[f"layer{k}.kernel"] = np.asarray(layer.kernel, np.float32)
        tensors[f"layer{k}.bias"] = np.asarray(layer.bias, np.float32)
    facts = {**(metadata or {}), "format": FORMAT, "agent": json.dumps(asdict(policy.config))}
    target, content = Path(path), _in_order(save(tensors, facts))
    if len(content) > LARGEST_FILE:
        raise PolicyFileError(
            f"{path}: a policy of {len(content)} bytes, more than the {LARGEST_FILE} of a policy file"
        )
    part = target.with_name(target.name + ".part")
    part.write_bytes(content)
    part.replace(target)


def _in_order(content: bytes) -> bytes:
    """The same file with its metadata sorted, which safetensors writes in an order of chance: equal policies are equal
    bytes then."""
    size = int.from_bytes(content[:8], "little")
    header = json.loads(content[8 : 8 + size])
    header["__metadata__"] = dict(sorted(header["__metadata__"].items()))
    text = json.dumps(header, separators=(",", ":"), ensure_ascii=False).encode()
    text += b" " * (-len(text) % 8)  # tensors begin at a multiple of eight bytes
    return len(text).to_bytes(8, "little") + text + content[8 + size :]


def load_policy(path: str | Path) -> Learned:
    """Reads a policy file.

    Raises:
        PolicyFileError: it cannot be read, is no policy, or its numbers do not fit its own description.
    """
    tensors, facts = _read(Path(path))
    if facts.get("format") != FORMAT:
        raise PolicyFileError(f"{path}: no policy of jaxba (its metadata says {facts.get('format', 'nothing')!r})")
    try:
        config = config_from(json.loads(facts["agent"]))
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise PolicyFileError(f"{path}: cannot be used by this version: {error}") from None
    count = len(tensors) // 2
    try:
        layers = tuple(Layer(tensors[f"layer{k}.kernel"], tensors[f"layer{k}.bias"]) for k in range(count))
    except KeyError as error:
        raise PolicyFileError(f"{path}: {error} is missing") from None
    size = config.observation_size
    for k, layer in enumerate(layers):
        if layer.kernel.ndim != 2 or layer.kernel.shape[0] != size or layer.bias.shape != layer.kernel.shape[1:]:
            raise PolicyFileError(
                f"{path}: layer {k} has the shape {layer.kernel.shape}, which does not take {size} numbers "
                f"(observation {config.observation!r}, history {config.history})"
            )
        if layer.kernel.dtype != np.float32 or layer.bias.dtype != np.float32:
            raise PolicyFileError(f"{path}: layer {k} is not of type float32")
        if not (np.isfinite(layer.kernel).all() and np.isfinite(layer.bias).all()):
            raise PolicyFileError(f"{path}: layer {k} holds numbers that are not finite")
        size = layer.kernel.shape[1]
    if not layers or size != 2 * config.action_size:
        raise PolicyFileError(f"{path}: the last layer must give {2 * config.action_size} numbers, not {size}")
    return Learned(tuple(layers), config)


def _read(path: Path) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    from safetensors import SafetensorError, safe_open

    try:
        if path.is_dir():
            raise PolicyFileError(f"{path}: a directory, not a policy file")
        if path.stat().st_size > LARGEST_FILE:
            raise PolicyFileError(f"{path}: no policy file, it is larger than {LARGEST_FILE} bytes")
        with safe_open(path, framework="numpy") as file:
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - not a mapping
            return tensors, dict(file.metadata() or {})
    except OSError as error:
        raise PolicyFileError(f"{path}: {error.strerror or 'no such file'}") from None
    except SafetensorError:
        raise PolicyFileError(f"{path}: not a safetensors file") from None
