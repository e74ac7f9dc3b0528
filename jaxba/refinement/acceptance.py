"""The accept decision on a candidate, after its embedded point iterations.

With the cost f, the candidate x' and the decrease that the linear model predicts, a candidate is accepted if

    f(x') < f(x)   and   rho = (f(x) - f(x')) / predicted > min_gain

and no focal length changes its sign (`retraction.keep_focal_signs`).

If a problem decomposes into subproblems (subproblems.py), the decision is made for each of them separately, and the
arrays below have an axis `parts`.

Source of the gain ratio rho: Nielsen 1999, "Damping Parameter in Marquardt's Method"; of embedded point iterations:
Jeong et al. 2012, "Pushing the Envelope of Modern Methods for Bundle Adjustment".
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxba.linear.step import Step
from jaxba.model.linearize import Reference
from jaxba.problem.options import StepOptions
from jaxba.problem.safe_math import safe_divide
from jaxba.refinement.points import PreviousPoints
from jaxba.refinement.retraction import keep_focal_signs
from jaxba.refinement.subproblems import PointSearch, Subproblems

NEGLIGIBLE = 1e-6
"""Predicted decrease, relative to the cost, below which there are no camera rounds and no further trials. Source: Ceres
function_tolerance."""

POINT_DECREASE = 1e-2
"""Candidates after the full step stop their point iterations once one lowers the cost by less than this fraction of the
predicted decrease. Not the full step: with the same rule there, `ceres+refine3` took 34 instead of 22 iterations to a
relative error of 1e-3 on kitti00vo."""

NEAR_CONVERGENCE = 1e-3
"""Predicted decrease, relative to the cost, below which points are refined from both of their starts, which doubles the
time. Measured: in earlier iterations it brings nothing more."""


COST_ROUNDING = 8.0
"""Rounding error of a cost in machine epsilons, relative to the cost: 1e-6 in float32, which was measured on real
problems, and 2e-15 in float64."""


class Work(NamedTuple):
    """What the search for the candidate of a step took, for every subproblem."""

    repairs: Int[Array, "*parts"]
    """Camera rounds, trials and pattern moves after the first candidate."""

    camera_rounds: Int[Array, "*parts"]
    """The camera rounds among them."""

    point_iterations: Int[Array, "*parts"]
    """Embedded point iterations of all candidates, as many as each might make."""


class Candidate(NamedTuple):
    """Proposed parameters, with the accept decision for every subproblem."""

    cameras: Float[Array, "parameters cameras"]
    """Proposed cameras."""

    points: Float[Array, "3 points"]
    """Proposed points, scene units."""

    cost: Float[Array, "*parts"]
    """Their cost, pixels^2."""

    predicted: Float[Array, "*parts"]
    """Decrease that the linear model predicts for this step fraction, pixels^2."""

    gain: Float[Array, "*parts"]
    """Actual over predicted decrease."""

    accepted: Bool[Array, "*parts"]
    """The accept decision."""

    step_fraction: Float[Array, "*parts"]
    """Length relative to the full step."""

    work: Work
    """What the search for it took so far."""


class Comparison(NamedTuple):
    """The data of one step with which its candidates are evaluated."""

    parts: Subproblems
    """The subproblems, each with its own accept decision."""

    cameras: Float[Array, "parameters cameras"]
    """Cameras before the step."""

    points: Float[Array, "3 points"]
    """Points before the step, scene units."""

    cost: Float[Array, "*parts"]
    """Cost before the step, pixels^2."""

    terms: Float[Array, " terms"]
    """Terms of that cost. Differences are summed, since the difference of sums cancels in float32."""

    previous: PreviousPoints
    """Where diverged points return to."""

    step: Step
    """The full step."""

    options: StepOptions
    """Options of the step."""

    min_gain: float | Float[Array, ""]
    """Gain ratio that an accepted candidate must exceed."""

    starts: Int[Array, ""]
    """Starts of points after the full step, see `PointSearch`."""

    matters: Bool[Array, "*parts"]
    """Whether the predicted decrease is worth camera rounds and further trials."""


def comparison(
    parts: Subproblems,
    cameras: Float[Array, "parameters cameras"],
    points: Float[Array, "3 points"],
    cost: Float[Array, "*parts"],
    reference: Reference,
    step: Step,
    options: StepOptions,
    min_gain: float | Float[Array, ""],
) -> Comparison:
    """The `Comparison` of a step. Arguments as for `best_candidate`."""
    predicted = step.predicted(jnp.ones_like(cost))
    previous = PreviousPoints.of(parts.layout, points, reference)
    return Comparison(
        parts=parts,
        cameras=cameras,
        points=points,
        cost=cost,
        terms=parts.terms(reference, previous, options),
        previous=previous,
        step=step,
        options=options,
        min_gain=min_gain,
        starts=jnp.where(jnp.all(predicted <= NEAR_CONVERGENCE * cost), 2, 1),
        matters=predicted > NEGLIGIBLE * cost,
    )


def assess(
    against: Comparison,
    cameras: Float[Array, "parameters cameras"],
    points: Float[Array, "3 points"],
    step_fraction: Float[Array, "*parts"],
    work: Work,
    full_step: Bool[Array, ""],
) -> Candidate:
    """Refines the points of a candidate and decides whether it is accepted.

    Args:
        against: data of the step.
        cameras: cameras of the candidate.
        points: points before their embedded iterations.
        step_fraction: it scales the predicted decrease.
        work: what the search took so far, without the point iterations of this candidate.
        full_step: whether this is the full step of some subproblem, after which points may also start from their rays.
    """
    options, parts = against.options, against.parts
    min_decrease = jnp.where(full_step, -jnp.inf, POINT_DECREASE * jnp.sum(against.step.predicted(step_fraction)))
    iterations = options.refinement.points
    search = PointSearch(iterations, jnp.where(full_step, against.starts, 0), min_decrease)
    work = work._replace(point_iterations=(work.point_iterations + iterations).astype(jnp.int32))
    points, terms = parts.refine(cameras, points, against.previous, options, search)
    cost, decrease = parts.sums(terms), parts.sums(against.terms - terms)
    predicted = against.step.predicted(step_fraction)
    gain = safe_divide(decrease, predicted)
    accepted = (decrease > 0) & (cost <= against.cost) & (predicted > 0) & (gain > against.min_gain)
    # costs before and after come from two computations: a decrease that nothing predicts may be their rounding alone
    rounding = float(jnp.finfo(against.cost.dtype).eps) * against.cost
    accepted = accepted & ((predicted > rounding) | (decrease > COST_ROUNDING * rounding))
    accepted = accepted & jnp.isfinite(cost) & parts.all_cameras(keep_focal_signs(against.cameras, cameras))
    return Candidate(cameras, points, cost, predicted, gain, accepted, step_fraction, work)


def select(parts: Subproblems, which: Bool[Array, "*parts"], new: Candidate, old: Candidate) -> Candidate:
    """The new candidate for the subproblems in `which`, the old one for the others."""
    values = jax.tree.map(lambda *pair: jnp.where(which, *pair), new[2:], old[2:])
    cameras = jnp.where(parts.of_cameras(which), new.cameras, old.cameras)
    return Candidate(cameras, jnp.where(parts.of_points(which), new.points, old.points), *values)
