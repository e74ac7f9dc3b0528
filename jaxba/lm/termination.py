"""When a solve ends, and why."""

from __future__ import annotations

import enum
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxba.lm.records import StepInfo

DAMPING_LIMIT = 1e32
"""A step rejected with this lambda ends the solve. Source: Ceres min_trust_region_radius 1e-32."""

HIDDEN_DECREASE = 100.0
"""A small decrease ends a solve only if, without damping, it would be estimated at no more than this times as large. A
step that lambda made short says nothing about how far the minimum is."""


SHARE_ROUNDING = 64.0
"""Rounding units within which a share of damping is one: under a lambda of 1e30 it came out as one or just below."""

COST_ROUNDING = 8.0
"""Rounding units of a cost within which the promise of a refused step tells nothing: 1e-6 in float32, where costs of
real problems have errors of that size (docs/performance.md), 2e-15 in float64."""


class Termination(enum.IntEnum):
    """Why a solve ended."""

    RUNNING = 0
    COST = 1
    STEP = 2
    GRADIENT = 3
    MAX_ITERATIONS = 4
    STALLED = 5
    DAMPING_LIMIT = 6
    STOPPED = 7
    TARGET = 8
    ROUNDING = 9

    @property
    def converged(self) -> bool:
        """Whether a convergence test ended the solve."""
        return self in (Termination.COST, Termination.STEP, Termination.GRADIENT, Termination.ROUNDING)

    @property
    def reason(self) -> str:
        """One phrase for a person."""
        return _REASONS[self]


_REASONS = {
    Termination.RUNNING: "still running",
    Termination.COST: "relative decrease of an accepted step within ftol",
    Termination.STEP: "accepted step within xtol",
    Termination.GRADIENT: "gradient within gtol",
    Termination.ROUNDING: "promised decrease of a refused step within the rounding of the cost",
    Termination.MAX_ITERATIONS: "iteration limit",
    Termination.STALLED: "a rejected step would be repeated unchanged",
    Termination.STOPPED: "stopped by the caller",
    Termination.TARGET: "cost at or below the target",
    Termination.DAMPING_LIMIT: "lambda at its upper limit, or not a number, and still rejected",
}


class Tolerances(NamedTuple):
    """Convergence tests (design, section 2), and a cost that is good enough.

    The first two are for accepted steps. A refused one ends a solve where nothing can be told any more
    (`lost_in_rounding`).
    """

    ftol: float = 1e-6
    """`|f - f'| <= ftol f`, by a step that is not short for its damping (`converged_in_cost`)."""

    xtol: float = 1e-8
    """`|step| <= xtol (|x| + xtol)`."""

    gtol: float = 1e-10
    """Largest gradient entry."""

    target: float = 0.0
    """Cost in pixels squared at which a solve may end, converged or not; 0 switches it off."""


def converged_in_cost(step: StepInfo, ftol: Any) -> Bool[Array, ""]:
    """An accepted step lowered the cost by at most `ftol f`, and not because damping made it short.

    Let s be the share of the step's curvature `d.(H + D) d` that is damping's. In a direction of curvature h,
    `s = lambda / (h + lambda)`, and the undamped model would promise `1 / (1 - s^2)` times the decrease. That may not
    exceed `HIDDEN_DECREASE` times the tolerance.
    """
    return step.accepted & _is_little(step.previous_cost - step.cost, step, ftol)


def lost_in_rounding(step: StepInfo) -> Bool[Array, ""]:
    """A step was refused that promised less than what its cost is rounded by, and not because damping made it short.

    Whether such a step is any good cannot be seen, and the next ones, damped more, promise less still. In float64 that
    is beyond all useful tolerances; in float32 it comes before `ftol` is met, which then needs a step accepted by luck.
    """
    rounding = COST_ROUNDING * float(jnp.finfo(step.cost.dtype).eps)
    told = (step.predicted > 0) & jnp.isfinite(step.step_norm)  # peers do not tell what they refused (peers/driven.py)
    return ~step.accepted & told & _is_little(step.predicted, step, rounding)


def _is_little(decrease: Float[Array, ""], step: StepInfo, tolerance: Any) -> Bool[Array, ""]:
    """Whether a decrease is within a tolerance relative to the cost, also as it would be without damping."""
    hidden = decrease > HIDDEN_DECREASE * _undamped(step) * (1 + step.damping_share) * tolerance * step.previous_cost
    whole = ~(step.share < 1)  # a step that had to be shortened says nothing either
    return (decrease <= tolerance * step.previous_cost) & ~hidden & whole


def _undamped(step: StepInfo) -> Float[Array, ""]:
    """What damping leaves of the step's curvature, as a share; none where it would be told by the last digits alone."""
    left = 1 - step.damping_share
    return jnp.where(left <= SHARE_ROUNDING * float(jnp.finfo(step.cost.dtype).eps), jnp.zeros_like(left), left)


def termination_of(
    step: StepInfo, stuck: Bool[Array, ""], iteration: Int[Array, ""], tolerances: Tolerances, max_iterations: Any
) -> Int[Array, ""]:
    """First stop rule that applies. Only an accepted step, a zero gradient, or a promise that drowns in rounding ends a
    solve as converged."""
    by_cost = converged_in_cost(step, tolerances.ftol)
    bound = tolerances.xtol * (step.parameter_norm + tolerances.xtol)
    hidden = step.step_norm > HIDDEN_DECREASE * _undamped(step) * bound
    by_step = step.accepted & (step.step_norm <= bound) & ~hidden & ~(step.share < 1)
    by_gradient = step.gradient_max <= tolerances.gtol
    limit = ~step.accepted & ~(step.damping < DAMPING_LIMIT)
    stalled = ~step.accepted & stuck
    rules: list[tuple[Bool[Array, ""], Termination]] = [
        (by_cost, Termination.COST),
        (by_step, Termination.STEP),
        (by_gradient, Termination.GRADIENT),
        (lost_in_rounding(step), Termination.ROUNDING),
        (limit, Termination.DAMPING_LIMIT),
        (stalled, Termination.STALLED),
        ((step.cost <= tolerances.target) & (tolerances.target > 0), Termination.TARGET),
        (iteration >= max_iterations, Termination.MAX_ITERATIONS),
    ]
    return jnp.select(
        [rule for rule, _ in rules], [jnp.asarray(int(code), jnp.int32) for _, code in rules], jnp.zeros((), jnp.int32)
    )
