"""Whether a candidate is accepted: its cost after embedded point iterations, against what the linear model predicted.

A candidate is accepted if its cost falls and its gain ratio, the actual over the predicted decrease, exceeds a bound.
Where a problem falls into subproblems (`subproblems.py`), each is accepted or rejected by itself. Source of the gain
ratio: Nielsen 1999, "Damping Parameter in Marquardt's Method"; of embedded point iterations: Jeong et al. 2012.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxba.linear.step import Effort, Step
from jaxba.model.linearize import Reference
from jaxba.problem.options import StepOptions
from jaxba.refinement.points import PreviousPoints
from jaxba.refinement.subproblems import PointSearch, Subproblems

NEGLIGIBLE = 1e-6
"""Predicted decrease relative to the cost that is not worth repairs or further trials. Source: Ceres
function_tolerance."""

ENOUGH = 1e-2
"""Decrease by the points' own iterations, relative to what the step predicted, after which they need no further one in
what is tried after the whole step. Where it held for that too, `ceres+refine3` took 34 iterations to 1e-3 on
kitti00vo instead of 22."""

LITTLE_LEFT = 1e-3
"""Predicted decrease relative to the cost below which points are refined from both of their starts, which takes as
long again. In every trial it brought no more."""


class Candidate(NamedTuple):
    """Parameters that might be accepted, one decision for every subproblem."""

    cameras: Float[Array, "9 cameras"]
    points: Float[Array, "3 points"]
    cost: Float[Array, "*parts"]
    predicted: Float[Array, "*parts"]  # decrease predicted by the linear model at this length
    gain: Float[Array, "*parts"]  # actual over predicted decrease
    accepted: Bool[Array, "*parts"]
    share: Float[Array, "*parts"]  # length relative to the whole step
    repairs: Int[Array, "*parts"]  # camera rounds, further trials and pattern moves that it took


class Comparison(NamedTuple):
    """What candidates of one step are compared with."""

    parts: Subproblems
    cameras: Float[Array, "9 cameras"]  # before the step
    points: Float[Array, "3 points"]
    cost: Float[Array, "*parts"]  # there, pixels squared
    terms: Float[Array, " terms"]  # the same in pieces, compared one by one: two sums would cancel in float32
    previous: PreviousPoints
    step: Step
    options: StepOptions
    min_gain: float | Float[Array, ""]
    point_iterations: int | Int[Array, ""]
    starts: Int[Array, ""]  # of points after the whole step, see `PointSearch`
    matters: Bool[Array, "*parts"]  # whether the step predicts a decrease worth repairs and further trials


def comparison(
    parts: Subproblems,
    cameras: Float[Array, "9 cameras"],
    points: Float[Array, "3 points"],
    cost: Float[Array, "*parts"],
    reference: Reference,
    step: Step,
    options: StepOptions,
    min_gain: float | Float[Array, ""],
    effort: Effort | None,
) -> Comparison:
    """What the candidates of a step are compared with; arguments are those of `best_candidate`."""
    point_iterations = options.refinement.points
    if effort is not None:
        point_iterations = jnp.minimum(effort.point_iterations, point_iterations)
    predicted = step.predicted(jnp.ones_like(cost))
    return Comparison(
        parts=parts,
        cameras=cameras,
        points=points,
        cost=cost,
        terms=parts.terms(reference.costs, options),
        previous=PreviousPoints.of(parts.layout, points, reference.inverse_depth),
        step=step,
        options=options,
        min_gain=min_gain,
        point_iterations=point_iterations,
        starts=jnp.where(jnp.all(predicted <= LITTLE_LEFT * cost), 2, 1),
        matters=predicted > NEGLIGIBLE * cost,
    )


def assess(
    against: Comparison,
    cameras: Float[Array, "9 cameras"],
    points: Float[Array, "3 points"],
    share: Float[Array, "*parts"],
    repairs: Int[Array, "*parts"],
    whole: Bool[Array, ""] | None = None,
) -> Candidate:
    """A candidate after its embedded point iterations, and whether it is accepted.

    Args:
        against: what it is compared with.
        cameras: of the candidate.
        points: where their iterations start.
        share: its length relative to the whole step.
        repairs: what it took so far.
        whole: whether it is the whole step of some subproblem, after which points may also start from their rays; None
            after a camera round, which finds points where their cameras left them.
    """
    options, parts = against.options, against.parts
    if whole is None:
        whole = jnp.zeros((), bool)
        options = replace(options, refinement=replace(options.refinement, starts="step"))
    enough = jnp.where(whole, -jnp.inf, ENOUGH * jnp.sum(against.step.predicted(share)))
    search = PointSearch(against.point_iterations, jnp.where(whole, against.starts, 0), enough)
    points, terms = parts.refine(cameras, points, against.previous, options, search)
    cost, decrease, predicted = parts.sums(terms), parts.sums(against.terms - terms), against.step.predicted(share)
    gain = decrease / predicted
    accepted = (decrease > 0) & (cost <= against.cost) & (predicted > 0) & (gain > against.min_gain)
    return Candidate(cameras, points, cost, predicted, gain, accepted & jnp.isfinite(cost), share, repairs)


def chosen(parts: Subproblems, which: Bool[Array, "*parts"], new: Candidate, old: Candidate) -> Candidate:
    """The new candidate of some subproblems, the old one of the others."""
    values = [jnp.where(which, *pair) for pair in zip(new[2:], old[2:], strict=True)]
    cameras = jnp.where(parts.of_cameras(which), new.cameras, old.cameras)
    return Candidate(cameras, jnp.where(parts.of_points(which), new.points, old.points), *values)
