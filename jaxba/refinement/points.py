"""Embedded point iterations: every point is re-optimised on its own with the cameras held fixed.

For fixed cameras the cost is a sum of independent problems with three unknowns, one per point.
Every point takes damped Gauss-Newton steps of its own, accepted only if its own cost falls, so that
the total cost never rises. An iteration takes one pass over the observations. Points that a long
camera step threw off come back in this way.

Two cases do not come back by themselves, since the cost does not see them:

- A point behind a camera projects like its mirror image in front of it, and a distant point gets
  there by way of infinity. It may fit for a while and then be stuck: kittistereo00s ended 1.8%
  above the best known cost with 61 such points. So a point that the step sent behind a camera
  starts again from its previous position (`PreviousPoints`).
- With nearly parallel rays, one step may increase the distance of a point a million times, to where
  its gradient vanishes, or send it through infinity behind its cameras. So neither the step nor the
  point's own iterations may increase its distance more than `MAX_DISTANCE_RATIO` times.

Source: Jeong et al. 2012, "Pushing the Envelope of Modern Methods for Bundle Adjustment"; Ceres'
inner iterations."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxba.linear.cholesky3 import cholesky3
from jaxba.model import camera
from jaxba.model.linearize import Reference, point_terms
from jaxba.model.observations import Views, point_passes
from jaxba.model.residuals import add_point_terms, points_alone
from jaxba.problem.losses import Loss
from jaxba.runtime import loops
from jaxba.runtime.fusion import compute_in_one_loop
from jaxba.structure.devices import sum_over_devices
from jaxba.structure.layout import Layout
from jaxba.structure.segment_sums import point_sums
from jaxba.structure.sharing import Mask

# relative damping of a point's first step: Gauss-Newton except for parallel rays
INITIAL_DAMPING = 1e-6
REJECTED_DAMPING = 1e-2  # smallest relative damping after a point's step was rejected
# factor on a point's damping after a rejected step, and its inverse after an accepted one
DAMPING_FACTOR = 10.0

MAX_DISTANCE_RATIO = 100.0
"""Largest growth of the distance of a point from its cameras by the step, and again by its own
iterations. The distance is the harmonic mean of its depths, negative behind a camera; a point that
starts behind its cameras has no limit. With a ratio of 8 kitti00vo ended 3e-4 above the best known
cost, with 100 it ended 2e-7 above."""

# largest decrease of an iteration, relative to the cost, after which they may stop early
SMALL_DECREASE = 1e-2


class PreviousPoints(NamedTuple):
    """Points before the step. Diverged points return to their positions."""

    points: Float[Array, "3 points"]

    front: Bool[Array, " slots"]  # whether the point was in front of the camera
    # sum over the cameras of a point, negative in front of them
    inverse_depth_sum: Float[Array, " points"]
    costs: Float[Array, " points"]  # cost of the observations of each point, pixels^2

    @classmethod
    def of(
        cls, layout: Layout, points: Float[Array, "3 points"], reference: Reference
    ) -> PreviousPoints:
        """From the positions of points and the reference of every slot there."""
        return cls(
            points,
            reference.inverse_depth < 0,
            *point_sums(layout, [reference.inverse_depth, reference.costs]),
        )

    @classmethod
    def unknown(cls, layout: Layout, points: Float[Array, "3 points"]) -> PreviousPoints:
        """None that a point could return to: in front of no camera, so that no point counts as
        diverged."""
        zero = jnp.zeros_like(points[0])
        return cls(points, jnp.zeros(layout.num_slots, bool), zero, zero)


class _Search(NamedTuple):
    """The iterations of all points, between two passes over the observations."""

    points: Float[Array, "3 points"]  # best so far
    costs: Float[Array, " points"]
    system: Float[Array, "9 points"]  # lower triangle of `J_p^T J_p` and gradient at `points`
    damping: Float[Array, " points"]
    trial: Float[Array, "3 points"]  # next positions to evaluate
    inverse_depth_sum: Float[Array, " points"]  # at the start
    # whether the point was reset, and so is a pass behind the others
    delayed: Bool[Array, " points"]
    passes: Int[Array, ""]
    more: Bool[Array, ""]  # whether there is another pass


def refine_points(
    layout: Layout,
    cameras: Float[Array, "parameters cameras"],
    frames: camera.Frames,
    points: Float[Array, "3 points"],
    loss: Loss,
    iterations: int | Int[Array, ""],
    previous: PreviousPoints | None = None,
    min_decrease: float | Float[Array, ""] = -jnp.inf,
) -> tuple[Float[Array, "3 points"], Float[Array, " points"]]:
    """Improves every point by up to `iterations` damped Gauss-Newton steps of its own. Returns
    points, and the cost of the observations of each (pixels^2). It is never larger than at the
    start, which for reset points is the previous position.

    Args:
        layout: the problem's observations.
        cameras: cameras, held fixed.
        frames: camera of every slot (`linearize.slot_frames`).
        points: start.
        loss: robust loss.
        iterations: steps per point, zero or more. Each takes one pass over the observations; there
            is one more pass at the end, and another one if points are reset.
        previous: points before the step. A diverged point is reset to its previous position first:
            one that is behind a camera and was in front of it, or more than `MAX_DISTANCE_RATIO`
            times as far away.
        min_decrease: stop after an iteration that lowers the total cost by at most this (pixels^2)
            and by at most `SMALL_DECREASE` of the cost that is left."""
    one_pass = point_passes(layout, frames)
    before = previous or PreviousPoints.unknown(layout, points)
    alone = points_alone(layout)

    def terms(views: Views, front: Array) -> list[Array]:
        found = point_terms(views, loss)
        return [*found, (front & (found[-1] > 0)).astype(points.dtype)]

    def next_pass(now: _Search) -> _Search:
        *found, inverse_depth_sum, lost = one_pass(now.trial, terms, before.front)
        *system, costs = add_point_terms(layout, cameras, now.trial, found)
        diverged = (now.passes == 0) & (
            (lost > 0) | has_receded(inverse_depth_sum, before.inverse_depth_sum)
        )
        diverged = alone.where(diverged, False)
        delayed = now.delayed | diverged
        start = jnp.where(jnp.isinf(now.costs), inverse_depth_sum, now.inverse_depth_sum)
        active = ~diverged & (delayed | (now.passes <= iterations))
        accepted = (costs < now.costs) & ~has_receded(inverse_depth_sum, start) & active
        least = jnp.where(accepted, costs, now.costs)
        counts = (
            jnp.sum(jnp.where(accepted, now.costs - costs, 0)),
            jnp.sum(least),
            jnp.any(delayed).astype(jnp.int32),
        )
        lowered, left, late = sum_over_devices(layout, counts)
        converged = lowered <= jnp.minimum(min_decrease, SMALL_DECREASE * left)
        grown = jnp.maximum(REJECTED_DAMPING, now.damping * DAMPING_FACTOR)
        damping = jnp.where(
            diverged, now.damping, jnp.where(accepted, now.damping / DAMPING_FACTOR, grown)
        )
        best = jnp.where(accepted, now.trial, now.points)
        system = jnp.where(accepted, jnp.stack(system), now.system)
        trial = jnp.stack(compute_in_one_loop(_moved, best, system, damping, alone))
        return _Search(
            points=jnp.where(diverged, before.points, best),
            costs=least,
            system=system,
            damping=damping,
            trial=jnp.where(diverged, before.points, trial),
            inverse_depth_sum=start,
            delayed=delayed,
            passes=now.passes + 1,
            more=(now.passes + 1 <= iterations + (late > 0)) & ~converged,
        )

    # start and end are passes like the others, with infinite initial costs: the program contains a
    # pass only once
    zero = jnp.zeros_like(points[0])
    search = _Search(
        points=points,
        costs=jnp.full_like(zero, jnp.inf),
        system=jnp.zeros((9, *zero.shape), points.dtype),
        damping=jnp.full_like(zero, DAMPING_FACTOR * INITIAL_DAMPING),
        trial=points,
        inverse_depth_sum=zero,
        delayed=jnp.zeros(zero.shape, bool),
        passes=jnp.zeros((), jnp.int32),
        more=jnp.ones((), bool),
    )
    search = loops.while_loop(lambda search: search.more, next_pass, search)
    return search.points, search.costs


def _moved(points: Array, system: Array, damping: Array, free: Mask) -> list[Array]:
    """Points after a damped step of their own systems; those that are not free stay."""
    matrix = [
        entry * (1 + damping) if k in (0, 2, 5) else entry for k, entry in enumerate(system[:6])
    ]
    factor = cholesky3(matrix)
    after = [
        x - d
        for x, d in zip(points, factor.backward(factor.forward(list(system[6:]))), strict=True)
    ]
    return [free.where(new, old) for new, old in zip(after, points, strict=True)]


def has_receded(
    inverse_depth_sum: Float[Array, " points"], before: Float[Array, " points"]
) -> Bool[Array, " points"]:
    """Whether points have moved behind their cameras or more than `MAX_DISTANCE_RATIO` times as far
    away.

    Both arguments are sums of inverse depths over a point's cameras, negative in front of them. A
    point that was behind its cameras before has not receded, wherever it is."""
    return (before < 0) & (MAX_DISTANCE_RATIO * inverse_depth_sum > before)
