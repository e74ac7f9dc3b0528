"""Embedded point iterations: every point re-optimised alone while the cameras stand still.

Given cameras, the cost splits into one small problem a point, so that each point may take damped
Gauss-Newton steps of its own, kept only if its own cost falls. The total cost can only fall. Points that a
bold camera step threw far away come back in one pass over the observations each.

Projection does not see the difference between a point and its mirror image behind the camera, and a point far away
comes to the other side by way of infinity. There it may fit for a while and never find back: kittistereo00s ended 1.8%
above the best known cost with 61 such points. So a point that the step sent behind a camera starts again from where it
was before the step (`PreviousPoints`).

Nor does it see distance where rays are nearly parallel: one step may take a point a million times as far, where it
feels nothing any more, or through infinity behind its cameras. So neither the step nor a point's own iterations take
it more than `FARTHEST` times as far.

Source: "embedded point iterations", Jeong et al., "Pushing the Envelope of Modern Methods for Bundle
Adjustment", PAMI 2012; Ceres calls the same idea inner iterations.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Bool, Float, Int

from jaxba.linear.cholesky3 import Cholesky3, cholesky3
from jaxba.model import camera
from jaxba.model.linearize import point_terms
from jaxba.model.observations import Views, point_passes
from jaxba.problem.losses import Loss
from jaxba.runtime.fusion import compute_in_one_loop
from jaxba.structure.layout import Layout
from jaxba.structure.segment_sums import point_sum

INITIAL_DAMPING = 1e-6
"""Relative damping of a point's first step: plain Gauss-Newton but for parallel rays."""

REJECTED_DAMPING = 1e-2
"""Damping after a point's first rejected step."""

DAMPING_FACTOR = 10.0
"""Growth of a point's damping after a further rejection, and its decay after success."""


FARTHEST = 100.0
"""Distance that a point may have from its cameras after the step, and again after its own iterations, relative to where
it was before. Distances are harmonic means over its cameras; those behind count as negative. What starts behind its
cameras has no limit. The depths of a scene span two decades.
8 stopped points that should go: kitti00vo ended 3e-4 above the best known cost, 2e-7 with 100."""

LITTLE = 1e-2
"""Share of the cost below which the decrease of a pass is small."""


class PreviousPoints(NamedTuple):
    """Where points were before the step, and what was visible there."""

    points: Float[Array, "3 points"]
    front: Bool[Array, " slots"]  # whether the point lay in front of the camera
    nearness: Float[Array, " points"]  # see `gone`

    @classmethod
    def of(
        cls, layout: Layout, points: Float[Array, "3 points"], inverse_depth: Float[Array, " slots"]
    ) -> PreviousPoints:
        """Where points are, with `Projection.inverse_depth` of every slot there."""
        return cls(points, inverse_depth < 0, point_sum(layout, inverse_depth[None])[0])


class _Carry(NamedTuple):
    points: Float[Array, "3 points"]  # best so far
    costs: Float[Array, " points"]
    system: Float[Array, "9 points"]  # lower triangle of the block, then the gradient, there
    damping: Float[Array, " points"]
    trial: Float[Array, "3 points"]  # where to look next
    nearness: Float[Array, " points"]  # of the start, see `gone`
    late: Bool[Array, " points"]  # whether it was put back, and so is a pass behind the others
    passes: Int[Array, ""]
    settled: Bool[Array, ""]  # whether the last pass brought too little for another one


def refine_points(
    layout: Layout,
    frames: camera.Frames,
    points: Float[Array, "3 points"],
    loss: Loss,
    iterations: int | Int[Array, ""],
    previous: PreviousPoints | None = None,
    enough: float | Float[Array, ""] = -jnp.inf,
) -> tuple[Float[Array, "3 points"], Float[Array, " points"]]:
    """Improves every point by `iterations` steps of its own.

    Args:
        layout: slots.
        frames: of every slot (`linearize.slot_frames`).
        points: where to start.
        loss: robust loss.
        iterations: steps per point, none or more; each costs one pass over the observations, and so does the end, and
            one more where points are put back.
        previous: where points were before the step. A point that lies behind a camera in front of which it was, or
            `FARTHEST` times as far from its cameras, is put back there first.
        enough: ends after a step that lowered the cost by no more than this, all points together, nor by more than
            `LITTLE` of what is left.

    Returns:
        Points, and the cost of each point's observations there (pixels squared), never larger than where it
        started, which is its previous place for a point that was put back.
    """
    one_pass = point_passes(layout, frames)
    fronts = () if previous is None else (previous.front,)

    def terms(views: Views, *front: Array) -> list[Array]:
        found = point_terms(views, loss)
        return [*found, *((seen & (found[-1] > 0)).astype(points.dtype) for seen in front)]

    def propose(best: _Carry) -> Float[Array, "3 points"]:
        matrix = [best.system[k] for k in range(6)]
        for k in (0, 2, 5):
            matrix[k] = matrix[k] * (1 + best.damping)

        def moved(points: Array, factor: Cholesky3, gradient: Array) -> list[Array]:
            return [x - d for x, d in zip(points, factor.backward(factor.forward(list(gradient))), strict=True)]

        factor = cholesky3(matrix)
        return jnp.stack(compute_in_one_loop(moved, best.points, factor, best.system[6:]))

    def body(carry: _Carry) -> _Carry:
        *system, costs, nearness = (found := one_pass(carry.trial, terms, *fronts))[:11]
        diverged, late = jnp.zeros_like(carry.late), carry.late
        if previous is not None:
            diverged = (carry.passes == 0) & ((found[11] > 0) | gone(nearness, previous.nearness))
            late = late | diverged
        start = jnp.where(jnp.isinf(carry.costs), nearness, carry.nearness)
        going_on = ~diverged & (late | (carry.passes <= iterations))
        better = (costs < carry.costs) & ~gone(nearness, start) & going_on
        grown = jnp.maximum(REJECTED_DAMPING, carry.damping * DAMPING_FACTOR)
        damping = jnp.where(better, carry.damping / DAMPING_FACTOR, grown)
        least, lowered = jnp.where(better, costs, carry.costs), jnp.sum(jnp.where(better, carry.costs - costs, 0))
        best = _Carry(
            points=jnp.where(better, carry.trial, carry.points),
            costs=least,
            system=jnp.where(better, jnp.stack(system), carry.system),
            damping=jnp.where(diverged, carry.damping, damping),
            trial=carry.trial,
            nearness=start,
            late=late,
            passes=carry.passes + 1,
            settled=lowered <= jnp.minimum(enough, LITTLE * jnp.sum(least)),
        )
        best = best._replace(trial=propose(best))
        if previous is None:
            return best
        return best._replace(
            points=jnp.where(diverged, previous.points, best.points),
            trial=jnp.where(diverged, previous.points, best.trial),
        )

    # the start is a trial better than nothing, and the end one like the others: the program has one copy of a pass
    nothing = jnp.full_like(points[0], jnp.inf)
    first = jnp.full_like(nothing, DAMPING_FACTOR * INITIAL_DAMPING)
    none, zero = jnp.zeros(nothing.shape, bool), jnp.zeros_like(nothing)
    system = jnp.zeros((9, *nothing.shape), points.dtype)
    carry = _Carry(points, nothing, system, first, points, zero, none, jnp.zeros((), jnp.int32), jnp.zeros((), bool))
    more = lambda c: (c.passes <= iterations + jnp.any(c.late)) & ~c.settled
    carry = lax.while_loop(more, body, carry)
    return carry.points, carry.costs


def gone(nearness: Float[Array, " points"], before: Float[Array, " points"]) -> Bool[Array, " points"]:
    """Whether points in front of their cameras are more than `FARTHEST` times as far away as before, or behind.

    Nearness is the sum of inverse depths over a point's cameras, negative in front of them. What was behind is free.
    """
    return (before < 0) & (FARTHEST * nearness > before)
