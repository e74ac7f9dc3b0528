"""The guard between an agent and the solver: which lambda follows from an action.

An action in (-1, 1) is linear in log10 of lambda. With guard `hand-over` lambda is then limited:

    first iteration           lambda >= 10**first_low
    later                     lambda >= last lambda / 10**descent
    after a rejection         lambda >= last lambda * 10**escalate
    after a shortened step    lambda >= last lambda * 10**(escalate * times shortened)
    after an overdamped step  lambda <= last lambda / 10
    after an inexact step     lambda >= last lambda

After `patience` rejections in a row, or `max_rejections` in all, Ceres' rule chooses lambda to the
end of the solve."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from jaxba.damping.agent_config import AgentConfig
from jaxba.damping.default_policy import Rescue, is_inexact, smallest_decades, times_shortened
from jaxba.damping.rules import LARGEST
from jaxba.lm.records import StepInfo

OVERDAMPED_DECREASE = 1e-2
OVERDAMPED_FRACTION = 0.5
"""A step of full length is overdamped if its relative decrease is below the first number and
damping's share of its curvature above the second. The next lambda must then be ten times smaller,
or a solve could stop making progress without having converged. Shortened steps do not count: in a
narrow valley (the COLMAP model bulani7) a smaller lambda was rejected twice after them, and Ceres'
rule took over in iteration 8."""

# log10 of the largest lambda of any rule: finite, as a state of the game must be
UNLIMITED = math.log10(LARGEST)


class GuardState(NamedTuple):
    """What the guard remembers between iterations."""

    lowest: Float[Array, ""]  # log10 of the smallest lambda that it allows next
    highest: Float[Array, ""]  # and of the largest
    rescue: Rescue


def initial_guard(config: AgentConfig, dtype: Any) -> GuardState:
    """Before the first iteration."""
    return GuardState(
        jnp.asarray(config.first_low, dtype), jnp.asarray(UNLIMITED, dtype), Rescue.begin(dtype)
    )


def update_guard(config: AgentConfig, guard: GuardState, step: StepInfo) -> GuardState:
    """After an iteration."""
    rescue, rule = guard.rescue.after(step, config.patience, config.max_rejections)
    damping = jnp.log10(step.damping)
    failures = jnp.where(step.accepted, times_shortened(step), 1.0)
    lowest = jnp.where(is_inexact(step), damping, damping - config.descent)
    lowest = jnp.where(
        failures > 0, jnp.maximum(lowest, damping + config.escalate * failures), lowest
    )
    decrease = (step.previous_cost - step.cost) / step.previous_cost
    weak = (decrease < OVERDAMPED_DECREASE) & (step.damping_fraction > OVERDAMPED_FRACTION)
    highest = jnp.where(step.accepted & (step.step_fraction == 1) & weak, damping - 1, UNLIMITED)

    def decided(limit):
        return jnp.where(rescue.in_charge, rule, limit).astype(guard.lowest.dtype)

    return GuardState(decided(lowest), decided(highest), rescue)


def action_of(config: AgentConfig, decades: Float[Array, ""]) -> Float[Array, ""]:
    """The action that asks for a lambda of `10**decades`; beyond (-1, 1) if no action does."""
    middle, half = _scale(config)
    return (decades - middle) / half


def damping_of(
    config: AgentConfig, guard: GuardState, action: Float[Array, ""]
) -> Float[Array, ""]:
    """The lambda that the guard, in its state before the iteration, allows for an action in (-1,
    1)."""
    dtype = guard.lowest.dtype
    middle, half = _scale(config)
    least = smallest_decades(config.low, dtype)
    wanted = jnp.clip(middle + half * action.astype(dtype), least, config.high)
    if config.guard == "off":
        return 10**wanted
    return jnp.clip(10 ** jnp.clip(wanted, guard.lowest, guard.highest), 10**least, LARGEST)


def _scale(config: AgentConfig) -> tuple[float, float]:
    """log10 of lambda for the action 0, and how many decades above it the action 1 is."""
    return 0.5 * (config.low + config.high), 0.5 * (config.high - config.low)
