"""Embedded point iterations: every point re-optimised alone while the cameras stand still.

Given cameras, the cost splits into one small problem a point, so that each point may take damped
Gauss-Newton steps of its own, kept only if its own cost falls. The total cost can only fall. Points that a
bold camera step threw far away come back in one pass over the observations each.

Projection does not see the difference between a point and its mirror image behind the camera, and a point far away
comes to the other side by way of infinity. There it may fit for a while and never find back: kittistereo00s ended 1.8%
above the best known cost with 61 such points. So a point that the step sent behind a camera starts again from where it
was before the step (`Home`).

Nor does it see distance where rays are nearly parallel: one step may take a point a million times as far, where it
feels nothing any more, or through infinity behind its cameras. So neither the step nor a point's own iterations take
it more than `FARTHEST` times as far (docs/game.md, "Starts that are far away").

Source: "embedded point iterations", Jeong et al., "Pushing the Envelope of Modern Methods for Bundle
Adjustment", PAMI 2012; Ceres calls the same idea inner iterations.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Bool, Float, Int

from jaxba import camera
from jaxba.blocks3 import cholesky3
from jaxba.layout import Layout
from jaxba.linearize import behind, point_normal_equations, residuals, slot_costs
from jaxba.losses import Loss
from jaxba.sums import point_sum

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


class Home(NamedTuple):
    """Where points were before the step, and the slots from whose camera they were visible there."""

    points: Float[Array, "3 points"]
    front: Bool[Array, " slots"]


class _Carry(NamedTuple):
    points: Float[Array, "3 points"]  # best so far
    costs: Float[Array, " points"]
    system: Float[Array, "9 points"]  # lower triangle of the block, then the gradient, there
    damping: Float[Array, " points"]
    trial: Float[Array, "3 points"]  # where to look next
    nearness: Float[Array, " points"]  # of the start, see `_gone`


def refine_points(
    layout: Layout,
    frames: camera.Frames,
    points: Float[Array, "3 points"],
    loss: Loss,
    iterations: int | Int[Array, ""],
    home: Home | None = None,
) -> tuple[Float[Array, "3 points"], Float[Array, " points"]]:
    """Improves every point by `iterations` steps of its own.

    Args:
        layout: slots.
        frames: camera of every slot (`linearize.slot_frames`).
        points: where to start.
        loss: robust loss.
        iterations: steps per point, none or more; each costs one pass over the observations, a home two.
        home: a point that lies behind a camera in front of which it was at home, or `FARTHEST` times as far from its
            cameras, starts from there.

    Returns:
        Points, and the cost of each point's observations there (pixels squared), never larger than where it
        started, which is its home for a point that was taken there.
    """

    if home is not None:
        points = _brought_home(layout, frames, points, home)

    def propose(best: _Carry) -> _Carry:
        matrix = [best.system[k] for k in range(6)]
        for k in (0, 2, 5):
            matrix[k] = matrix[k] * (1 + best.damping)
        factor = cholesky3(matrix)
        step = factor.backward(factor.forward([best.system[k] for k in range(6, 9)]))
        return best._replace(trial=best.points - jnp.stack(step))

    def body(_: Array, carry: _Carry) -> _Carry:
        projection, residual = residuals(layout, frames, carry.trial)
        entries = point_normal_equations(layout, frames, projection, residual, loss)
        sums = point_sum(layout, jnp.stack([*entries, slot_costs(loss, residual), projection.inverse_depth]))
        nearness = jnp.where(jnp.isinf(carry.costs), sums[10], carry.nearness)
        better = (sums[9] < carry.costs) & ~_gone(sums[10], nearness)
        grown = jnp.maximum(REJECTED_DAMPING, carry.damping * DAMPING_FACTOR)
        best = _Carry(
            points=jnp.where(better, carry.trial, carry.points),
            costs=jnp.where(better, sums[9], carry.costs),
            system=jnp.where(better, sums[:9], carry.system),
            damping=jnp.where(better, carry.damping / DAMPING_FACTOR, grown),
            trial=carry.trial,
            nearness=nearness,
        )
        return propose(best)

    # the start is a trial better than nothing: one copy of the body in the program, and less to compile
    nothing = jnp.full_like(points[0], jnp.inf)
    first = jnp.full_like(nothing, DAMPING_FACTOR * INITIAL_DAMPING)
    zero = jnp.zeros_like(nothing)
    carry = _Carry(points, nothing, jnp.zeros((9, nothing.shape[0]), points.dtype), first, points, zero)
    carry = lax.fori_loop(0, iterations, body, carry)
    # nothing follows the last step, so that its cost and where it led are all there is to know
    projection, residual = residuals(layout, frames, carry.trial)
    costs, nearness = point_sum(layout, jnp.stack([slot_costs(loss, residual), projection.inverse_depth]))
    better = (costs < carry.costs) & ~_gone(nearness, carry.nearness)
    return jnp.where(better, carry.trial, carry.points), jnp.where(better, costs, carry.costs)


def _brought_home(
    layout: Layout, frames: camera.Frames, points: Float[Array, "3 points"], home: Home
) -> Float[Array, "3 points"]:
    """Points, but those behind a camera in front of which they were at home, or gone far away, which are taken back."""
    projection, before = (residuals(layout, frames, place)[0] for place in (points, home.points))
    lost = (home.front & behind(projection)).astype(points.dtype)
    lost, *nearness = point_sum(layout, jnp.stack([lost, projection.inverse_depth, before.inverse_depth]))
    return jnp.where((lost > 0) | _gone(*nearness), home.points, points)


def _gone(nearness: Float[Array, " points"], before: Float[Array, " points"]) -> Bool[Array, " points"]:
    """Whether points in front of their cameras are more than `FARTHEST` times as far away as before, or behind.

    Nearness is the sum of inverse depths over a point's cameras, negative in front of them. What was behind is free.
    """
    return (before < 0) & (FARTHEST * nearness > before)
