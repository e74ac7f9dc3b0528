"""The accept decision on a candidate, after its embedded point iterations.

With the cost f, the candidate x' and the decrease that the linear model predicts, a candidate is
accepted if

    f(x') < f(x)   and   rho = (f(x) - f(x')) / predicted > min_gain

and no focal length changes its sign (`retraction.keep_focal_signs`).

Source of the gain ratio rho: Nielsen 1999, "Damping Parameter in Marquardt's Method"; of embedded
point iterations: Jeong et al. 2012, "Pushing the Envelope of Modern Methods for Bundle
Adjustment"."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxba.model.linearize import Reference, observation_costs, slot_frames
from jaxba.problem.options import StepOptions
from jaxba.problem.safe_math import safe_divide
from jaxba.refinement.midpoints import refine_from_starts
from jaxba.refinement.points import PreviousPoints, refine_points
from jaxba.refinement.retraction import keep_focal_signs
from jaxba.structure.devices import kept, sum_over_devices
from jaxba.structure.layout import Layout
from jaxba.structure.segment_sums import total

# relative predicted decrease below which are no camera rounds or further trials. Source: Ceres
NEGLIGIBLE = 1e-6

POINT_DECREASE = 1e-2
"""Candidates after the full step stop their point iterations once one lowers the cost by less than
this part of the prediction. Not the full step: `ceres+refine3` would take 34 instead of 22
iterations to 1e-3 on kitti00vo."""

# predicted decrease, relative to the cost, below which both starts of points are refined
NEAR_CONVERGENCE = 1e-3
# relative rounding error of a cost in machine epsilons: 1e-6 in float32, 2e-15 in float64
COST_ROUNDING = 8.0


class Step(NamedTuple):
    """A damped step d and the terms of its linear model (lm/damped_step.py)."""

    cameras: Float[Array, "parameters cameras"]  # in the coordinates of the options
    points: Float[Array, "3 points"]
    # -g.d, which is d.(H + D) d if the step solves the damped system; pixels^2
    slope: Float[Array, ""]
    # -g.d - d.H d, which is d.D d if the step solves the damped system; pixels^2
    damped: Float[Array, ""]
    gradient_max: Float[Array, ""]  # largest absolute gradient entry before the step
    cg_iterations: Int[Array, ""]  # 0 when the system was factored
    forcing: Float[Array, ""]  # forcing term that stopped them; 0 for an exact solve

    def predicted(self, fraction: Float[Array, ""]) -> Float[Array, ""]:
        """Decrease of the cost that the linear model predicts for `fraction * d`, pixels^2.

        `m(0) - m(a d) = -a g.d - a^2 d.H d / 2`, written with `slope` and `damped`, which are not
        negative, so that nothing cancels."""
        return fraction * (0.5 * fraction * self.damped + (1 - 0.5 * fraction) * self.slope)


class Candidate(NamedTuple):
    """Proposed parameters, with the accept decision."""

    cameras: Float[Array, "parameters cameras"]
    points: Float[Array, "3 points"]  # scene units
    cost: Float[Array, ""]  # pixels^2
    # decrease that the linear model predicts for this step fraction, pixels^2
    predicted: Float[Array, ""]
    gain: Float[Array, ""]  # actual over predicted decrease
    accepted: Bool[Array, ""]
    step_fraction: Float[Array, ""]  # length relative to the full step
    repairs: Int[Array, ""]  # camera rounds, trials and pattern moves after the first candidate


class Comparison(NamedTuple):
    """The data of one step with which its candidates are evaluated."""

    layout: Layout
    cameras: Float[Array, "parameters cameras"]  # before the step
    cost: Float[Array, ""]  # before the step, pixels^2
    # terms of that cost, of points if points are refined, else of slots; differences are summed,
    # since the difference of sums cancels in float32
    terms: Float[Array, " terms"]
    previous: PreviousPoints  # before the step; diverged points return there
    step: Step  # the full step
    options: StepOptions
    min_gain: float | Float[Array, ""]  # gain ratio that an accepted candidate must exceed
    starts: Int[Array, ""]  # starts of points after the full step (`midpoints.refine_from_starts`)
    # whether the predicted decrease is worth camera rounds and further trials
    matters: Bool[Array, ""]


def comparison(
    layout: Layout,
    cameras: Float[Array, "parameters cameras"],
    points: Float[Array, "3 points"],
    cost: Float[Array, ""],
    reference: Reference,
    step: Step,
    options: StepOptions,
    min_gain: float | Float[Array, ""],
) -> Comparison:
    """The `Comparison` of a step from current cameras and points, whose cost, costs of slots and
    depths are known."""
    predicted = step.predicted(jnp.ones_like(cost))
    matters = predicted > NEGLIGIBLE * cost
    previous = kept(layout, PreviousPoints.of(layout, points, reference))
    terms = previous.costs if options.refinement.points else reference.costs
    return Comparison(
        layout=layout,
        cameras=cameras,
        cost=cost,
        terms=terms,
        previous=previous,
        step=step,
        options=options,
        min_gain=min_gain,
        starts=jnp.where(predicted <= NEAR_CONVERGENCE * cost, 2, 1),
        matters=matters,
    )


def assess(
    against: Comparison,
    cameras: Float[Array, "parameters cameras"],
    points: Float[Array, "3 points"],
    step_fraction: Float[Array, ""],
    repairs: Int[Array, ""],
    full_step: Bool[Array, ""],
) -> Candidate:
    """Refines the points of a candidate, given before their embedded iterations, and decides
    whether it is accepted. `step_fraction` scales the predicted decrease. `repairs` are camera
    rounds, trials and pattern moves until then, with this one. `full_step`: whether this is the
    full step, after which points may also start from their rays."""
    layout = against.layout
    predicted = against.step.predicted(step_fraction)
    points, terms = _refined(against, cameras, points, predicted, full_step)
    cost, decrease = (
        sum_over_devices(layout, total(each)) for each in (terms, against.terms - terms)
    )
    gain = safe_divide(decrease, predicted)
    accepted = (decrease > 0) & (cost <= against.cost) & (predicted > 0) & (gain > against.min_gain)
    # costs before and after come from two computations: a decrease that nothing predicts may be
    # their rounding alone
    rounding = float(jnp.finfo(against.cost.dtype).eps) * against.cost
    accepted = accepted & ((predicted > rounding) | (decrease > COST_ROUNDING * rounding))
    accepted = accepted & jnp.isfinite(cost) & jnp.all(keep_focal_signs(against.cameras, cameras))
    return Candidate(cameras, points, cost, predicted, gain, accepted, step_fraction, repairs)


def _refined(
    against: Comparison,
    cameras: Array,
    points: Array,
    predicted: Float[Array, ""],
    full_step: Bool[Array, ""],
) -> tuple[Float[Array, "3 points"], Float[Array, " terms"]]:
    """The points after embedded iterations, if there are any, and the terms of the cost there."""
    layout = against.layout
    loss = against.options.loss
    refinement = against.options.refinement
    if not refinement.points:
        return points, observation_costs(layout, cameras, points, loss)
    arguments = (
        layout,
        cameras,
        slot_frames(layout, cameras),
        points,
        loss,
        refinement.points,
        against.previous,
    )
    min_decrease = jnp.where(full_step, -jnp.inf, POINT_DECREASE * predicted)
    if refinement.starts == "step":
        return refine_points(*arguments, min_decrease)
    return refine_from_starts(*arguments, jnp.where(full_step, against.starts, 0), min_decrease)


def select(which: Bool[Array, ""], new: Any, old: Any) -> Any:
    """A pytree if `which`, else another one."""
    return jax.tree.map(lambda *pair: jnp.where(which, *pair), new, old)
