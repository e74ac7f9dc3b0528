"""Games small enough to solve by hand: one `Environment` whose rules are numbers, compiled once for
all of them."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxba.game.protocol import Step
from jaxba.typing import register_pytree


class ToyState(NamedTuple):
    """The sign that each episode was dealt, and the steps that it has taken."""

    sign: Array
    clock: Array
    key: Array


@register_pytree
@dataclass(frozen=True)
class Toy:
    """An episode is dealt +1 or -1 and sees it, perhaps with a clock."""

    constant: float = 0.0
    """Paid at every paying step."""

    slope: float = 0.0
    """Times the sign, the same."""

    curvature: float = 0.0
    """Times the squared distance of the action from the best one: a cost."""

    best: float = 0.0
    """The best action for a sign of zero."""

    follow: float = 0.0
    """How far the best action moves with the sign."""

    length: int = 1
    """Steps of an episode."""

    only_last: bool = False
    """Whether only the last step pays."""

    truncates: bool = False
    """Whether the end is a truncation."""

    shows_clock: bool = False
    """Whether the second feature is the clock; otherwise it is zero."""

    forgets: bool = False
    """A mistake: the observation after the reset stands in for the last one."""

    breaks: bool = False
    """Every second environment pays infinity and leads to nothing that is a number."""

    num_envs: int = dataclasses.field(default=8, metadata={"static": True})

    hides: bool = dataclasses.field(default=False, metadata={"static": True})
    """Whether only critics see the sign, which then comes last."""

    observation_size = 2
    action_size = 1

    def _deal(self, key: Array) -> Array:
        return jax.random.rademacher(key, (self.num_envs,), jnp.float64)

    @property
    def privileged_size(self) -> int:
        return int(self.hides)

    def _see(self, sign: Array, clock: Array) -> Array:
        features = [sign, jnp.where(self.shows_clock, clock, 0.0)]
        return jnp.stack(features[::-1] if self.hides else features, axis=1)

    def reset(self, key: Array) -> tuple[ToyState, Array]:
        key, deal = jax.random.split(key)
        state = ToyState(self._deal(deal), jnp.zeros(self.num_envs, jnp.int32), key)
        return state, self._see(state.sign, state.clock)

    def step(self, state: ToyState, action: Array) -> tuple[ToyState, Step]:
        key, deal = jax.random.split(state.key)
        clock = state.clock + 1
        ended = clock >= self.length
        best = self.best + self.follow * state.sign
        reward = (
            self.constant + self.slope * state.sign - self.curvature * (action[:, 0] - best) ** 2
        )
        reward = jnp.where(self.only_last & ~ended, 0.0, reward)
        final = self._see(state.sign, clock)
        after = ToyState(
            jnp.where(ended, self._deal(deal), state.sign), jnp.where(ended, 0, clock), key
        )
        observation = self._see(after.sign, after.clock)
        final = jnp.where(self.forgets, observation, final)
        broken = self.breaks & (jnp.arange(self.num_envs) % 2 == 1)
        step = Step(
            observation=observation,
            reward=jnp.where(broken, jnp.inf, reward),
            terminated=ended & jnp.logical_not(self.truncates),
            truncated=ended & self.truncates,
            final_observation=jnp.where(broken[:, None], jnp.nan, final),
            metrics={"length": clock.astype(jnp.float64)},
        )
        return after, step

    def demonstrate(self, state: Any, key: Array) -> Array:
        return jax.random.uniform(key, (self.num_envs, 1), jnp.float64, -1, 1)


SEEN = Toy(slope=1.0)
"""Q(s) = s."""

DELAYED = Toy(constant=1.0, length=2, only_last=True, shows_clock=True)
"""Q(clock 0) = gamma, Q(clock 1) = 1."""

ACTION = Toy(curvature=1.0, best=0.3)
"""Q(a) = -(a - 0.3)^2."""

BOTH = Toy(slope=1.0, curvature=1.0, follow=0.5)
"""Q(s, a) = s - (a - s / 2)^2."""

HIDDEN = Toy(slope=1.0, curvature=1.0, follow=0.5, hides=True)
"""As `BOTH` for a policy that does not see the sign: its best action is zero, and Q(s, 0) = s - 1 /
4."""

ENDLESS = Toy(slope=1.0, length=2, truncates=True)
"""Every second step cuts off what would go on for ever: Q(s) = s / (1 - gamma).

Where those steps led to a random sign instead (the observation after the reset) or to nothing
(taken for terminal), it would be s / (1 - gamma / 2). """
