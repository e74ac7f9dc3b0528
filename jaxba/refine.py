"""Embedded point iterations: every point re-optimised alone while the cameras stand still.

Given cameras, the cost splits into one small problem a point, so that each point may take damped
Gauss-Newton steps of its own, kept only if its own cost falls. The total cost can only fall. Points that a
bold camera step threw far away come back in one pass over the observations each.

Source: "embedded point iterations", Jeong et al., "Pushing the Envelope of Modern Methods for Bundle
Adjustment", PAMI 2012; Ceres calls the same idea inner iterations.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Float

from jaxba import camera
from jaxba.blocks3 import cholesky3
from jaxba.layout import Layout
from jaxba.linearize import point_normal_equations, residuals, slot_costs
from jaxba.losses import Loss
from jaxba.sums import point_sum

INITIAL_DAMPING = 1e-6
"""Relative damping of a point's first step: plain Gauss-Newton but for parallel rays."""

REJECTED_DAMPING = 1e-2
"""Damping after a point's first rejected step."""

DAMPING_FACTOR = 10.0
"""Growth of a point's damping after a further rejection, and its decay after success."""


class _Carry(NamedTuple):
    points: Float[Array, "3 points"]
    costs: Float[Array, " points"]
    system: Float[Array, "9 points"]  # lower triangle of the block, then the gradient
    damping: Float[Array, " points"]


def refine_points(
    layout: Layout, frames: camera.Frames, points: Float[Array, "3 points"], loss: Loss, iterations: int
) -> tuple[Float[Array, "3 points"], Float[Array, " points"]]:
    """Improves every point by `iterations` steps of its own.

    Args:
        layout: slots.
        frames: camera of every slot (`linearize.slot_frames`).
        points: where to start.
        loss: robust loss.
        iterations: steps per point; each costs one pass over the observations.

    Returns:
        Points, and the cost of each point's observations there (pixels squared), never larger than before.
    """

    def evaluate(points: Array) -> tuple[Array, Array]:
        projection, residual = residuals(layout, frames, points)
        entries = point_normal_equations(layout, frames, projection, residual, loss)
        sums = point_sum(layout, jnp.stack([*entries, slot_costs(loss, residual)]))
        return sums[:9], sums[9]

    def body(_: Array, carry: _Carry) -> _Carry:
        matrix = [carry.system[k] for k in range(6)]
        for k in (0, 2, 5):
            matrix[k] = matrix[k] * (1 + carry.damping)
        factor = cholesky3(matrix)
        step = factor.backward(factor.forward([carry.system[k] for k in range(6, 9)]))
        trial = carry.points - jnp.stack(step)
        system, costs = evaluate(trial)
        better = costs < carry.costs
        grown = jnp.maximum(REJECTED_DAMPING, carry.damping * DAMPING_FACTOR)
        return _Carry(
            jnp.where(better, trial, carry.points),
            jnp.where(better, costs, carry.costs),
            jnp.where(better, system, carry.system),
            jnp.where(better, carry.damping / DAMPING_FACTOR, grown),
        )

    system, costs = evaluate(points)
    carry = _Carry(points, costs, system, jnp.full_like(costs, INITIAL_DAMPING))
    carry = lax.fori_loop(0, iterations, body, carry)
    return carry.points, carry.costs
