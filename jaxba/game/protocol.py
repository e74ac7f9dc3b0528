"""What a trainer may rely on in a game: a batch of environments behind two pure functions."""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol, runtime_checkable

from jax import Array
from jaxtyping import Bool, Float


class Step(NamedTuple):
    """What one action of every environment led to."""

    observation: Float[Array, "envs features"]  # to act on next: of a new episode where this one ended
    reward: Float[Array, " envs"]
    terminated: Bool[Array, " envs"]  # the episode ended for good: its value is zero from here on
    truncated: Bool[Array, " envs"]  # it was cut off: its value is that of `final_observation`
    final_observation: Float[Array, "envs features"]  # true result of the action, before any reset
    metrics: dict[str, Float[Array, " envs"]]  # facts about an episode, valid where it ended; the same keys always


@runtime_checkable
class Environment(Protocol):
    """A batch of environments that reset themselves. A pytree: its arrays are traced, its sizes static.

    Observations must be finite.
    """

    @property
    def num_envs(self) -> int:
        """Environments that step together."""
        ...

    @property
    def observation_size(self) -> int:
        """Features of an observation."""
        ...

    @property
    def action_size(self) -> int:
        """Numbers of an action, each in (-1, 1)."""
        ...

    def reset(self, key: Array) -> tuple[Any, Float[Array, "envs features"]]:
        """State and observations of new episodes. The state carries all further randomness."""
        ...

    def step(self, state: Any, action: Float[Array, "envs actions"]) -> tuple[Any, Step]:
        """Plays one action everywhere; episodes that end are followed by new ones."""
        ...

    def demonstrate(self, state: Any, key: Array) -> Float[Array, "envs actions"]:
        """Actions that fill the replay buffer before the agent acts: random ones, or those of a rule."""
        ...
