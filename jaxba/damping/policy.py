"""The protocol of damping policies: a pair of pure functions, like an optax transform."""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol, runtime_checkable

from jax import Array
from jaxtyping import Float, Int

from jaxba.lm.effort import Effort
from jaxba.lm.step import StepInfo


class ProblemInfo(NamedTuple):
    """What a policy may know before the first iteration."""

    cost: Float[Array, ""]  # at the start, pixels^2
    observations: Int[Array, ""]
    cameras: Int[Array, ""]
    points: Int[Array, ""]
    unit: Float[Array, ""]  # largest Hessian diagonal under identity scaling, 1 under diagonal scaling
    focal: Float[Array, ""]  # median focal length, pixels
    max_iterations: Int[Array, ""]


@runtime_checkable
class DampingPolicy(Protocol):
    """Chooses lambda for every iteration.

    A policy is a frozen dataclass and a pytree: its numbers are traced, so that changing one never
    recompiles, and its class selects the code. Both functions are pure and jittable. A policy may have a third one,
    `effort(state)`, see `effort_of`.
    """

    @property
    def min_gain(self) -> Any:
        """A step whose gain ratio does not exceed this is rejected."""
        ...

    def init(self, info: ProblemInfo) -> tuple[Any, Float[Array, ""]]:
        """State and lambda of the first iteration."""
        ...

    def propose(self, state: Any, step: StepInfo) -> tuple[Any, Float[Array, ""]]:
        """State and lambda of the next iteration, after the step that used the last lambda."""
        ...


def decides_effort(policy: DampingPolicy) -> bool:
    """Whether the policy says what an iteration may cost; otherwise `StepOptions` do."""
    return getattr(policy, "effort", None) is not None


def effort_of(policy: DampingPolicy, state: Any) -> Effort | None:
    """What the iteration that follows may cost, if the policy decides that; None where `StepOptions` do."""
    return policy.effort(state) if decides_effort(policy) else None  # pyright: ignore[reportAttributeAccessIssue]
