"""The protocol between trainer and game: a batch of environments as pure functions."""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol, runtime_checkable

from jax import Array
from jaxtyping import Bool, Float


class Step(NamedTuple):
    """Result of one action in every environment."""

    observation: Float[Array, "envs features"]
    """For the next action; of a new episode if this one ended."""

    reward: Float[Array, " envs"]
    """For the action."""

    terminated: Bool[Array, " envs"]
    """Whether the episode ended: the value of what follows is zero."""

    truncated: Bool[Array, " envs"]
    """Whether it was cut off: the value of what follows is that of `final_observation`."""

    final_observation: Float[Array, "envs features"]
    """After the action, before any reset."""

    metrics: dict[str, Float[Array, " envs"]]
    """Of an episode, valid if it ended; always the same keys."""


@runtime_checkable
class Environment(Protocol):
    """A batch of environments that reset themselves. A pytree (`jaxba.register_pytree`).

    Its arrays are traced, its sizes static. Observations must be finite."""

    @property
    def num_envs(self) -> int:
        """Environments that step together."""
        ...

    @property
    def observation_size(self) -> int:
        """Features of an observation."""
        ...

    @property
    def privileged_size(self) -> int:
        """How many of these features, the last ones, only critics see in training: a policy will
        not have them."""
        ...

    @property
    def action_size(self) -> int:
        """Numbers of an action, each in (-1, 1)."""
        ...

    def reset(self, key: Array) -> tuple[Any, Float[Array, "envs features"]]:
        """State and observations of new episodes. The state holds the key of all further random
        numbers."""
        ...

    def step(self, state: Any, action: Float[Array, "envs actions"]) -> tuple[Any, Step]:
        """Plays one action everywhere; episodes that end are followed by new ones."""
        ...

    def demonstrate(self, state: Any, key: Array) -> Float[Array, "envs actions"]:
        """Actions that fill the replay buffer before training: random, or of a damping rule."""
        ...
