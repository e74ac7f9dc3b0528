"""The guard between an agent and the solver: which lambda follows from an action.

An action in (-1, 1) is linear in log10 of lambda. With guard `hand-over` lambda is then limited:

    first iteration           lambda >= 10**first_low
    later                     lambda >= last lambda / 10**descent
    after a rejection         lambda >= last lambda * 10**escalate
    after a shortened step    lambda >= last lambda * 10**(escalate * times shortened)
    after an overdamped step  lambda <= last lambda / 10
    after an inexact step     lambda >= last lambda

After `patience` rejections in a row, or `max_rejections` in all, Ceres' rule chooses lambda to the end of the solve.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxba.damping.agent_config import AgentConfig
from jaxba.damping.rules import LARGEST, Ceres
from jaxba.lm.records import StepInfo
from jaxba.refinement.backtracking import SHORTER

FIRST_DAMPING = -4.0
"""log10 of the lambda at which Ceres' rule starts. Source: Ceres initial_trust_region_radius 1e4."""

INEXACT_FRACTION = 0.1
"""A step is inexact if damping's share of its curvature is below this fraction of the forcing term. A smaller lambda
then changes nothing but the number of iterations of conjugate gradients. On random scenes of 600 to 1,197 cameras 0.01
instead saved fewer iterations."""

OVERDAMPED_DECREASE, OVERDAMPED_FRACTION = 1e-2, 0.5
"""A step of full length is overdamped if its relative decrease is below the first number and damping's share of its
curvature above the second. The next lambda must then be ten times smaller, or a solve could stop making progress
without having converged. Shortened steps do not count: in a narrow valley (the COLMAP model bulani7) a smaller lambda
was rejected twice after them, and Ceres' rule took over in iteration 8."""


class GuardState(NamedTuple):
    """What the guard remembers between iterations."""

    iteration: Int[Array, ""]  # number of the next iteration, from 0
    damping: Float[Array, ""]  # log10 of the last lambda
    accepted_damping: Float[Array, ""]  # log10 of the last accepted lambda
    gain: Float[Array, ""]  # gain ratio of the last step, -1 if not finite
    shortened: Float[Array, ""]  # how often the last step was shortened
    consecutive_rejections: Int[Array, ""]
    rejections: Int[Array, ""]  # in all
    growth: Float[Array, ""]  # factor of Ceres' rule after the next rejection
    handed_over: Bool[Array, ""]  # Ceres' rule chooses lambda to the end
    overdamped: Bool[Array, ""]  # of the last step, see `OVERDAMPED_DECREASE`
    inexact: Bool[Array, ""]  # of the last step, see `INEXACT_FRACTION`


def initial_guard(dtype: Any) -> GuardState:
    """Before the first iteration."""
    number = lambda x: jnp.asarray(x, dtype)
    zero, no = jnp.zeros((), jnp.int32), jnp.zeros((), bool)
    return GuardState(
        iteration=zero,
        damping=number(FIRST_DAMPING),
        accepted_damping=number(FIRST_DAMPING),
        gain=number(0.0),
        shortened=number(0.0),
        consecutive_rejections=zero,
        rejections=zero,
        growth=number(Ceres().reject_growth),
        handed_over=no,
        overdamped=no,
        inexact=no,
    )


def update_guard(config: AgentConfig, guard: GuardState, step: StepInfo) -> GuardState:
    """After an iteration."""
    dtype = guard.damping.dtype
    damping = jnp.log10(step.damping).astype(dtype)
    decrease = (step.previous_cost - step.cost) / step.previous_cost
    gain = jnp.where(jnp.isfinite(step.gain_ratio), step.gain_ratio, -1.0)
    shortened = jnp.round(-jnp.log(step.step_fraction) / -math.log(SHORTER))
    consecutive = jnp.where(step.accepted, 0, guard.consecutive_rejections + 1).astype(jnp.int32)
    rejections = (guard.rejections + ~step.accepted).astype(jnp.int32)
    growth = jnp.where(guard.handed_over, 2 * guard.growth, Ceres().reject_growth)
    growth = jnp.where(step.accepted, 0.5 * Ceres().reject_growth, growth).astype(dtype)
    weak = (decrease < OVERDAMPED_DECREASE) & (step.damping_fraction > OVERDAMPED_FRACTION)
    return GuardState(
        iteration=(guard.iteration + 1).astype(jnp.int32),
        damping=damping,
        accepted_damping=jnp.where(step.accepted, damping, guard.accepted_damping).astype(dtype),
        gain=gain.astype(dtype),
        shortened=shortened.astype(dtype),
        consecutive_rejections=consecutive,
        rejections=rejections,
        growth=growth,
        handed_over=guard.handed_over | (rejections >= config.max_rejections) | (consecutive >= config.patience),
        overdamped=step.accepted & (step.step_fraction == 1) & weak,
        inexact=step.accepted & (step.damping_fraction < INEXACT_FRACTION * step.forcing),
    )


def action_of(config: AgentConfig, decades: Float[Array, ""]) -> Float[Array, ""]:
    """The action that asks for a lambda of `10**decades`; beyond (-1, 1) if no action does."""
    middle, half = _scale(config)
    return (decades - middle) / half


def damping_of(config: AgentConfig, guard: GuardState, action: Float[Array, ""]) -> Float[Array, ""]:
    """The lambda that the guard allows.

    Args:
        config: range of lambda and limits.
        guard: state before the iteration.
        action: in (-1, 1).
    """
    dtype = guard.damping.dtype
    middle, half = _scale(config)
    least = _smallest_decades(config, dtype)
    wanted = jnp.clip(middle + half * action.astype(dtype), least, config.high)
    if not config.guarded:
        return 10**wanted
    lowest = jnp.where(guard.iteration == 0, config.first_low, guard.damping - config.descent)
    wanted = jnp.maximum(wanted, jnp.where(guard.inexact, guard.damping, lowest))
    rejected = guard.consecutive_rejections > 0
    must_rise = rejected | (guard.shortened > 0)
    rise = config.escalate * jnp.where(rejected, 1.0, guard.shortened)
    wanted = jnp.where(must_rise, jnp.maximum(wanted, guard.damping + rise), wanted)
    wanted = jnp.where(guard.overdamped, jnp.minimum(wanted, guard.damping - 1), wanted)
    rule = guard.damping + jnp.log10(Ceres().factor(~rejected, guard.gain, guard.growth))
    # Ceres' rule starts at the last accepted lambda, or at its own first one if twice the rejected lambda is larger.
    # It starts again in the same way when it is rejected `patience` times in a row itself.
    restart = jnp.where(guard.accepted_damping > rule, guard.accepted_damping, FIRST_DAMPING)
    rule = jnp.where(guard.consecutive_rejections == config.patience, jnp.maximum(rule, restart), rule)
    return jnp.clip(10 ** jnp.where(guard.handed_over, rule, wanted), 10**least, LARGEST)


def _scale(config: AgentConfig) -> tuple[float, float]:
    """log10 of lambda for the action 0, and how many decades above it the action 1 is."""
    return 0.5 * (config.low + config.high), 0.5 * (config.high - config.low)


def _smallest_decades(config: AgentConfig, dtype: Any) -> float:
    """log10 of the smallest lambda: one below the rounding unit is lost when it is added to a diagonal.

    In float64 that is below every agent's range. In float32 `learned` would go to 1e-9, at which the systems of real
    problems have no correct digit left, and steps are rejected or shortened to a quarter.
    """
    return max(config.low, math.log10(float(jnp.finfo(dtype).eps)))
