"""The default policy `guarded`, and what it shares with the guard of agents: the end of a bold
choice of lambda."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxba.damping.agent_config import AgentConfig, embedded
from jaxba.damping.policy import ProblemInfo
from jaxba.damping.rules import LARGEST, Ceres
from jaxba.lm.records import StepInfo
from jaxba.problem.options import StepOptions
from jaxba.refinement.candidates import SHORTER
from jaxba.typing import register_pytree

INEXACT_FRACTION = 0.1
"""A step is inexact if damping's share of its curvature is below this fraction of the forcing term.
A smaller lambda then changes nothing but the number of iterations of conjugate gradients. On random
scenes of 600 to 1,197 cameras 0.01 instead saved fewer iterations."""


def is_inexact(step: StepInfo) -> Bool[Array, ""]:
    """Whether a step was accepted that conjugate gradients left more open than lambda did
    (`INEXACT_FRACTION`)."""
    return step.accepted & (step.damping_fraction < INEXACT_FRACTION * step.forcing)


def finite_gain(step: StepInfo) -> Float[Array, ""]:
    """The gain ratio, -1 if it is not finite."""
    return jnp.where(jnp.isfinite(step.gain_ratio), step.gain_ratio, -1.0)


def times_shortened(step: StepInfo) -> Float[Array, ""]:
    """How often the step was shortened; not positive after pattern moves."""
    return jnp.round(-jnp.log(step.step_fraction) / -math.log(SHORTER))


def smallest_decades(low: float, dtype: Any) -> float:
    """log10 of the smallest lambda: `low`, but not below the rounding unit, which is lost in a sum
    with a diagonal.

    In float64 that is below every policy's range. In float32 `bold` would go to 1e-9, at which the
    systems of real problems have no correct digit left, and steps are rejected or shortened to a
    quarter."""
    return max(low, math.log10(float(jnp.finfo(dtype).eps)))


FIRST_DAMPING = math.log10(Ceres().initial)  # log10 of the lambda at which Ceres' rule starts


class Rescue(NamedTuple):
    """Ceres' rule in reserve: it takes over from a bold choice of lambda that was rejected too
    often, to the end.

    It starts at the last accepted lambda, or at its own first one if a larger lambda was rejected
    since. It starts again in the same way when it is rejected as often in a row itself."""

    worked: Float[Array, ""]  # log10 of the last accepted lambda
    in_a_row: Int[Array, ""]  # rejections
    rejections: Int[Array, ""]  # in all
    # last factor after a rejection, 1 after an accepted step; 0 before it takes over
    growth: Float[Array, ""]

    @classmethod
    def begin(cls, dtype: Any) -> Rescue:
        """Before the first iteration."""
        zero = jnp.zeros((), jnp.int32)
        return cls(jnp.asarray(FIRST_DAMPING, dtype), zero, zero, jnp.zeros((), dtype))

    @property
    def in_charge(self) -> Bool[Array, ""]:
        """Whether it has taken over."""
        return self.growth > 0

    def after(self, step: StepInfo, patience: int, most: int) -> tuple[Rescue, Float[Array, ""]]:
        """The state after a step, and log10 of the next lambda in case that it is in charge: after
        `patience` rejections in a row, or `most` in all, it takes over."""
        rule = Ceres()
        dtype = self.worked.dtype
        accepted = step.accepted
        decades = jnp.log10(step.damping).astype(dtype)
        worked = jnp.where(accepted, decades, self.worked).astype(dtype)
        in_a_row = jnp.where(accepted, 0, self.in_a_row + 1).astype(jnp.int32)
        rejections = (self.rejections + ~accepted).astype(jnp.int32)
        growth = jnp.where(accepted, 1.0, jnp.maximum(2 * self.growth, rule.reject_growth)).astype(
            dtype
        )
        following = decades + jnp.log10(
            rule.factor(accepted, finite_gain(step).astype(dtype), growth)
        )
        start = jnp.where(worked > following, worked, FIRST_DAMPING)
        following = jnp.where(in_a_row == patience, jnp.maximum(following, start), following)
        in_charge = self.in_charge | (in_a_row >= patience) | (rejections >= most)
        return Rescue(
            worked, in_a_row, rejections, jnp.where(in_charge, growth, 0).astype(dtype)
        ), following


class GuardedState(NamedTuple):
    """What `Guarded` remembers."""

    rescue: Rescue
    least: Float[Array, ""]  # log10 of lambda after a step that did not fail


@register_pytree
@dataclass(frozen=True)
class Guarded:
    """Nearly Gauss-Newton, with all embedded iterations: lambda is `initial`, and from then on
    `least` as long as no step fails.

    A rejection raises lambda by half a decade, and so does every time that an accepted step was
    shortened. A step of full length brings it back, unless it was inexact. After two rejections in
    a row, or eight in all, Ceres' rule chooses it to the end (`Rescue`). Both numbers, and three
    point iterations for one, were chosen by `python -m benchmarks.default_policy`, in the means and
    beside the better of other policies."""

    min_gain: float = 0.25
    """Gain ratio that a candidate must exceed; otherwise the step is shortened and tried again.
    Source: the sufficient decrease of trust regions (Nocedal, Wright 2006, algorithm 4.1)."""

    initial: float = 1e-6
    """Lambda of the first iteration. Of 1e-5 to 1e-8 none is best everywhere. On windows 1e-7 takes
    0.92 of the iterations, but six times as many on Ladybug-49, however little its start is moved,
    and ends 11% higher on bulani1; 1e-8 takes twice as many on a street of 400 cameras far from the
    truth."""

    least: float = 1e-8
    """Lambda after a step that did not fail."""

    least_without_pixels: float = 1e-12
    """The same for problems without pixels, such as chains of inertial measurements. There lambda
    holds back how long chains of poses move together: the diagonal of the Hessian, which it
    multiplies, is that of stiff rows between neighbours. Thirteen inertial states take 23
    iterations with 1e-8, 6 with 1e-10, 5 with 1e-12 (GTSAM: 4 or 5) and 8 with 1e-13; a pose graph
    of 200 takes as many with all of them. Windows of real images do not gain: where lambda falls
    below 1e-8 they take 1.14 of the iterations to convergence."""

    def step_options(self, base: StepOptions) -> StepOptions:
        """All embedded iterations."""
        return embedded().step_options(base)

    def init(self, info: ProblemInfo) -> tuple[GuardedState, Array]:
        """See `DampingPolicy`."""
        dtype = info.cost.dtype
        least = jnp.where(info.observations > 0, self.least, self.least_without_pixels).astype(
            dtype
        )
        least = jnp.maximum(jnp.log10(least), smallest_decades(-math.inf, dtype))
        state = GuardedState(Rescue.begin(dtype), least)
        return state, jnp.maximum(jnp.asarray(self.initial, dtype), 10**least)

    def propose(self, state: GuardedState, step: StepInfo) -> tuple[GuardedState, Array]:
        """See `DampingPolicy`."""
        least = state.least
        rescue, of_rescue = state.rescue.after(
            step, AgentConfig.patience, AgentConfig.max_rejections
        )
        decades = jnp.log10(step.damping).astype(least.dtype)
        failures = jnp.where(step.accepted, times_shortened(step), 1.0)
        without_failure = jnp.maximum(least, jnp.where(is_inexact(step), decades, least))
        escalated = decades + AgentConfig.escalate * failures
        following = jnp.where(failures > 0, escalated, without_failure)
        following = jnp.where(rescue.in_charge, of_rescue, following)
        damping = jnp.clip(10**following, 10**least, LARGEST)
        return GuardedState(rescue, least), damping
