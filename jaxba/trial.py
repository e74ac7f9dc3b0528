"""What becomes of a step: the candidate it leads to, embedded iterations around it, and whether it is accepted.

The linear model is wrong far from where it was made, and mostly wrong locally: points fly off, cameras turn away from
what they see. Repairing that locally is cheap beside a linear solve, and lets bolder steps pass:

1. `refine_points`: every point re-optimised alone at the new cameras; one that the step sent behind a camera starts
   from where it was.
2. `camera_rounds`: where the step did less than half of what the model promised and is not hopeless, cameras alone,
   then points alone again, a few times over. A step along a curved valley comes back to its floor.
3. `trials`: a candidate that is still refused is tried again at a quarter of the length, with 1 and at most one round
   of 2.

None of it takes another linear solve, so it is all one iteration (design, section 2). Source: 1 is Jeong et al. 2012,
"embedded point iterations", and Ceres' inner iterations; 2 is resection and intersection (Chen, Chen, Wang 2019,
"Bundle adjustment revisited"), here as a repair of second-order steps; 3 is a backtracking line search.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Bool, Float, Int

from jaxba.effort import Effort
from jaxba.layout import Layout
from jaxba.linearize import Linearization, residuals, slot_costs, slot_frames
from jaxba.options import StepOptions
from jaxba.refine import Home, refine_points
from jaxba.resect import move_cameras, refine_cameras
from jaxba.schur import Step
from jaxba.sums import point_sum, total

SHORTER = 0.25
"""Factor on the length of a step that was refused. Measured with 4 trials on Ladybug-49 under lambda 1e-6."""

GOOD_GAIN = 0.5
"""Gain ratio from which on the linear model is trusted and cameras stay where it put them."""

HOPELESS = 1.5
"""Candidates that cost more than this times the present cost get no camera rounds: wild points would pull the cameras
after them. On Ladybug-49 under lambda 1e-6 a limit of 10 led into a minimum 19% above, 1.5 did not."""

ROUNDS_OF_SHORTER = 1
"""Camera rounds of a shortened candidate. On 457 held-out scenes `learned` came within 1e-4 of the best in 6.40
iterations on average without any, 6.02 with one, 5.88 with three; on real problems three took a tenth more work than
one."""

NEGLIGIBLE = 1e-6
"""Promised decrease relative to the cost that is not worth repairs or further trials. Source: Ceres
function_tolerance."""


class Trial(NamedTuple):
    """A candidate and the verdict on it."""

    cameras: Float[Array, "9 cameras"]
    points: Float[Array, "3 points"]
    cost: Float[Array, ""]
    predicted: Float[Array, ""]  # decrease promised by the linear model at this length
    gain: Float[Array, ""]  # actual over predicted decrease
    accepted: Bool[Array, ""]
    share: Float[Array, ""]  # length relative to the whole step
    repairs: Int[Array, ""]  # camera rounds and further trials that it took


def best_trial(
    layout: Layout,
    cameras: Float[Array, "9 cameras"],
    points: Float[Array, "3 points"],
    cost: Float[Array, ""],
    linear: Linearization,
    step: Step,
    options: StepOptions,
    min_gain: float | Float[Array, ""],
    effort: Effort | None = None,
) -> Trial:
    """The first accepted candidate, or the last refused one.

    Args:
        layout: the problem's observations.
        cameras: present cameras.
        points: present points.
        cost: their cost, pixels squared.
        linear: what was known there; only its costs and what lay in front of its camera are used.
        step: the solution of the damped system.
        options: static.
        min_gain: a candidate is accepted if the cost falls and the gain ratio exceeds this.
        effort: number of point iterations, where it is not that of the options.
    """
    point_iterations = options.refine_points
    if effort is not None:
        point_iterations = jnp.minimum(effort.point_iterations, point_iterations)
    # costs are compared term by term: two sums would cancel in float32. A term is a point where points are refined.
    before = point_sum(layout, linear.costs[None])[0] if options.refine_points else linear.costs

    matters = step.predicted(jnp.ones((), cost.dtype)) > NEGLIGIBLE * cost

    def judge(cameras: Array, points: Array, costs: Array, share: Array) -> Trial:
        candidate, decrease, predicted = total(costs), total(before - costs), step.predicted(share)
        gain = decrease / predicted
        accepted = (decrease > 0) & (candidate <= cost) & (predicted > 0) & (gain > min_gain) & jnp.isfinite(candidate)
        return Trial(cameras, points, candidate, predicted, gain, accepted, share, jnp.zeros((), jnp.int32))

    home = Home(points, linear.front)

    def settle(cameras: Array, points: Array, share: Array) -> Trial:
        frames = slot_frames(layout, cameras)
        if options.refine_points:
            points, costs = refine_points(layout, frames, points, options.loss, point_iterations, home)
        else:
            costs = slot_costs(options.loss, residuals(layout, frames, points)[1])
        return judge(cameras, points, costs, share)

    def repair(turn: tuple[Trial, Array]) -> tuple[Trial, Array]:
        trial, left = turn
        moved = refine_cameras(layout, trial.cameras, trial.points, options)
        return settle(moved, trial.points, trial.share)._replace(repairs=trial.repairs + 1), left - 1

    def worth_it(turn: tuple[Trial, Array]) -> Bool[Array, ""]:
        trial, left = turn
        return (left > 0) & (trial.gain < GOOD_GAIN) & (trial.cost < HOPELESS * cost) & matters

    def attempt(share: Array, repairs: Array) -> Trial:
        moved = move_cameras(cameras, share * step.cameras, options)
        trial = settle(moved, points + share * step.points, share)._replace(repairs=repairs)
        if not options.camera_rounds:
            return trial
        rounds = jnp.where(share == 1, options.camera_rounds, min(ROUNDS_OF_SHORTER, options.camera_rounds))
        return lax.while_loop(worth_it, repair, (trial, rounds))[0]

    one, none = jnp.ones((), cost.dtype), jnp.zeros((), jnp.int32)
    if options.trials == 1:
        return attempt(one, none)
    # the whole step is the first turn of the loop, so that the program has one copy of all this
    last = 1.5 * SHORTER ** (options.trials - 1)
    again = lambda trial: ~trial.accepted & (trial.share > last) & (matters | (trial.share > 1))
    shorter = lambda trial: attempt(SHORTER * trial.share, trial.repairs + 1)
    bad = jnp.full_like(cost, jnp.inf)
    nothing = Trial(cameras, points, bad, -one, -bad, jnp.zeros((), bool), one / SHORTER, none - 1)
    return lax.while_loop(again, shorter, nothing)
