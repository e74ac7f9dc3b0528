"""Stopping rules: when a solve ends, and why.

Three convergence tests on accepted steps, as in Ceres (relative decrease of the cost, relative step
length, largest gradient entry), and one on rejected steps whose predicted decrease is below the
rounding error of the cost. A strongly damped step is short whatever the distance to the minimum, so
the first two ask in addition that damping is not what made it short."""

from __future__ import annotations

import enum
import math
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxba.lm.records import StepInfo
from jaxba.refinement.acceptance import COST_ROUNDING

# a step rejected with such a lambda ends the solve. Source: Ceres, min_trust_region_radius
DAMPING_LIMIT = 1e32
# a small decrease or short step is convergence if, undamped, at most so many times as large
MAX_UNDAMPED_RATIO = 100.0
# machine epsilons within which a damping fraction is one: for 1e30 it was just below
FRACTION_ROUNDING = 64.0

LEFT_BY_DAMPING = 3000.0
LEAST_LEFT = 0.01
MOST_LEFT = 300.0
"""What is left after a step, in units of its decrease, is at most the first number times the
damping fraction, between the other two: so in 95 of 100 solves by the default (`python -m
benchmarks.default_policy --within`)."""


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
    NO_WEIGHT = 10
    WITHIN = 11
    NOTHING = 12
    TIME_LIMIT = 13

    @property
    def converged(self) -> bool:
        """Whether a convergence test ended the solve."""
        tests = ("COST", "STEP", "GRADIENT", "ROUNDING", "WITHIN")
        return self.name in tests

    @property
    def reason(self) -> str:
        """One phrase for the user."""
        return _REASONS[self]


_REASONS = {
    Termination.RUNNING: "still running",
    Termination.COST: "relative decrease of an accepted step within ftol",
    Termination.STEP: "accepted step within xtol",
    Termination.GRADIENT: "gradient within gtol",
    Termination.ROUNDING: "predicted decrease of a rejected step within the rounding of the cost",
    Termination.NO_WEIGHT: "every residual lies beyond the scale of the loss, so that no "
    "observation has a weight: "
    "choose a larger scale, or another loss",
    Termination.MAX_ITERATIONS: "iteration limit",
    Termination.TIME_LIMIT: "time limit",
    Termination.STALLED: "a rejected step would be repeated unchanged",
    Termination.STOPPED: "stopped by the caller",
    Termination.WITHIN: "estimated as near to the end as asked for",
    Termination.NOTHING: "nothing is observed, so that nothing was solved",
    Termination.TARGET: "cost at or below the target",
    Termination.DAMPING_LIMIT: "lambda at its upper limit, or not a number, and still rejected",
}


class Tolerances(NamedTuple):
    """Tolerances of the convergence tests, a target cost and a limit of time. The defaults are
    those of Ceres.

    `ftol` and `xtol` apply to accepted steps. Rejected steps end a solve by `lost_in_rounding`."""

    ftol: float = 1e-6
    """An accepted step with `f - f_new <= ftol f` that damping did not make short
    (`converged_in_cost`)."""

    xtol: float = 1e-8
    """An accepted step with `|d| <= xtol (|x| + xtol)` that damping did not make short."""

    gtol: float = 1e-10
    """Largest absolute gradient entry."""

    target: float = 0.0
    """Cost in pixels^2 at or below which a solve ends, converged or not; 0 switches it off."""

    within: float = 0.0
    """Estimated relative distance of the cost to its end at which a solve ends (`distance_to_end`);
    0 switches it off."""

    seconds: float | None = None
    """Limit of seconds of a solve from its call on, set-up and compilation included; None: no
    limit. The solve ends after what runs then, an iteration or a compilation, and gives the best
    state so far: if that was before the first iteration the start, with a ProblemWarning.
    `solve_loop` does not know this limit."""


def distance_to_end(step: StepInfo, where: Any = jnp.where) -> Any:
    """Relative distance of a cost to that of the end, seldom too small; infinite after a rejected
    or shortened step.

    What is left to do after a step is what damping kept it from doing. Where damping has no share
    of it (the fraction is zero), next steps decrease the cost by far less than this one; in a flat
    valley, where it has, by as much for many times. `where` is NumPy's for records of NumPy
    arrays."""
    decrease = (step.previous_cost - step.cost) / step.cost
    share = step.damping_fraction
    # of one direction the undamped model predicts s^2 / (1 - s^2) times the decrease
    # (`converged_in_cost`)
    left = decrease * (LEFT_BY_DAMPING * share).clip(LEAST_LEFT, MOST_LEFT) / (1 - share**2)
    return where(step.accepted & ~(step.step_fraction < 1), left, math.inf)


def converged_in_cost(step: StepInfo, ftol: Any) -> Bool[Array, ""]:
    """Whether an accepted step lowered the cost by at most `ftol f`, and not because damping made
    it short.

    Let `s = d.D d / d.(H + D) d` be the damping fraction. Along a direction of curvature h it is
    `s = lambda / (h + lambda)`, and the undamped model predicts `1 / (1 - s^2)` times the decrease.
    This estimate may be at most `MAX_UNDAMPED_RATIO` times the tolerance."""
    return step.accepted & _is_negligible(step.previous_cost - step.cost, step, ftol)


def lost_in_rounding(step: StepInfo) -> Bool[Array, ""]:
    """Whether a step was rejected whose predicted decrease is below the rounding error of the cost.

    Such a rejection says nothing about the step, and the next steps, damped more, predict even
    less. In float64 this is far below useful tolerances. In float32 it happens before `ftol` is
    met."""
    rounding = COST_ROUNDING * float(jnp.finfo(step.cost.dtype).eps)
    # peers do not report rejected steps
    known = (step.predicted > 0) & jnp.isfinite(step.step_norm)
    return ~step.accepted & known & _is_negligible(step.predicted, step, rounding)


def _is_negligible(decrease: Float[Array, ""], step: StepInfo, tolerance: Any) -> Bool[Array, ""]:
    """Whether a decrease is within a tolerance relative to the cost, for the damped step and
    without damping."""
    undamped_bound = MAX_UNDAMPED_RATIO * _undamped_fraction(step) * (1 + step.damping_fraction)
    damping_limited = decrease > undamped_bound * tolerance * step.previous_cost
    full_step = ~(step.step_fraction < 1)  # a backtracked step is short for another reason
    return (decrease <= tolerance * step.previous_cost) & ~damping_limited & full_step


def _undamped_fraction(step: StepInfo) -> Float[Array, ""]:
    """`1 - s` for the damping fraction s; zero where only rounding is left of it."""
    rest = 1 - step.damping_fraction
    return jnp.where(
        rest <= FRACTION_ROUNDING * float(jnp.finfo(step.cost.dtype).eps),
        jnp.zeros_like(rest),
        rest,
    )


def termination_of(
    step: StepInfo,
    stuck: Bool[Array, ""],
    iteration: Int[Array, ""],
    tolerances: Tolerances,
    max_iterations: Any,
) -> Int[Array, ""]:
    """The first stopping rule that applies to a step, as the integer of a `Termination`. `stuck`:
    whether a rejected step would be repeated unchanged. `iteration`: iterations so far, this one
    included."""
    by_cost = converged_in_cost(step, tolerances.ftol)
    bound = tolerances.xtol * (step.parameter_norm + tolerances.xtol)
    damping_limited = step.step_norm > MAX_UNDAMPED_RATIO * _undamped_fraction(step) * bound
    by_step = (
        step.accepted & (step.step_norm <= bound) & ~damping_limited & ~(step.step_fraction < 1)
    )
    by_gradient = step.gradient_max <= tolerances.gtol
    limit = ~step.accepted & ~(step.damping < DAMPING_LIMIT)
    stalled = ~step.accepted & stuck
    rules: list[tuple[Bool[Array, ""], Termination]] = [
        # first: small decreases and a zero gradient say nothing there
        (step.weightless, Termination.NO_WEIGHT),
        (by_cost, Termination.COST),
        (by_step, Termination.STEP),
        (by_gradient, Termination.GRADIENT),
        (lost_in_rounding(step), Termination.ROUNDING),
        (limit, Termination.DAMPING_LIMIT),
        (stalled, Termination.STALLED),
        (
            (distance_to_end(step) <= tolerances.within) & (tolerances.within > 0),
            Termination.WITHIN,
        ),
        ((step.cost <= tolerances.target) & (tolerances.target > 0), Termination.TARGET),
        (iteration >= max_iterations, Termination.MAX_ITERATIONS),
    ]
    return jnp.select(
        [rule for rule, _ in rules],
        [jnp.asarray(int(code), jnp.int32) for _, code in rules],
        jnp.zeros((), jnp.int32),
    )
