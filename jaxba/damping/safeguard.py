"""A guard that hands a solve over to a trusted rule once a policy is stuck."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxba.damping.policy import DampingPolicy, ProblemInfo, effort_of
from jaxba.damping.rules import Ceres
from jaxba.linear.step import Effort
from jaxba.lm.records import StepInfo
from jaxba.typing import register_pytree


class _State(NamedTuple):
    inner: Any
    fallback: Any
    rejections: Int[Array, ""]  # in a row
    engaged: Bool[Array, ""]


@register_pytree
@dataclass(frozen=True)
class Safeguard:
    """Runs `inner` until it has been rejected `patience` times in a row; from then on Ceres' rule decides.

    The hand-over lasts to the end of the solve, so a policy loses at most the iterations before it. The rule
    starts at its own first lambda, or at twice the rejected one if that is larger: what is smaller than a
    rejected lambda would be rejected too.
    """

    inner: DampingPolicy
    """The policy that is guarded."""

    patience: int = 3
    """Rejections in a row that end the inner policy's turn."""

    fallback: Ceres = field(default_factory=Ceres)
    """The rule that takes over."""

    @property
    def min_gain(self) -> Any:
        """That of the guarded policy."""
        return self.inner.min_gain

    def effort(self, state: _State) -> Effort | None:
        """That of the guarded policy."""
        return effort_of(self.inner, state.inner)

    def init(self, info: ProblemInfo) -> tuple[_State, Float[Array, ""]]:
        """See `DampingPolicy`."""
        inner, damping = self.inner.init(info)
        fallback, _ = self.fallback.init(info)
        return _State(inner, fallback, jnp.zeros((), jnp.int32), jnp.zeros((), bool)), damping

    def propose(self, state: _State, step: StepInfo) -> tuple[_State, Float[Array, ""]]:
        """See `DampingPolicy`."""
        inner, damping = self.inner.propose(state.inner, step)
        rejections = jnp.where(step.accepted, 0, state.rejections + 1).astype(jnp.int32)
        engaged = state.engaged | (rejections >= self.patience)
        advanced, continued = self.fallback.propose(state.fallback, step)
        opening = jnp.maximum(state.fallback.damping, 2 * step.damping).astype(continued.dtype)
        started = state.fallback._replace(damping=opening)
        # before the hand-over the fallback's state rests; on it, it opens; after it, it follows its own rule
        fallback = jax.tree.map(
            lambda rest, start, go: jnp.where(state.engaged, go, jnp.where(engaged, start, rest)),
            state.fallback,
            started,
            advanced,
        )
        damping = jnp.where(state.engaged, continued, jnp.where(engaged, opening, damping))
        return _State(inner, fallback, rejections, engaged), damping
