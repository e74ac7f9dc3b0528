"""Embedded camera iterations: every camera re-optimised alone while the points stand still (resection)."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Float

from jaxba.linear.cholesky import solve_positive
from jaxba.model import camera
from jaxba.model.linearize import linearize, observation_costs, with_free_lenses
from jaxba.problem.options import DIAGONAL_MAXIMUM, DIAGONAL_MINIMUM, StepOptions
from jaxba.runtime.fusion import compute_unfused
from jaxba.structure.conventions import components_first
from jaxba.structure.layout import Layout
from jaxba.structure.segment_sums import as_rows, outer_sum, take_rows, tree_sum

DAMPINGS = (1e-6, 1e-2)
"""Relative damping of a camera's step, and of a second one where the first did not help."""


def refine_cameras(
    layout: Layout, cameras: Float[Array, "9 cameras"], points: Float[Array, "3 points"], options: StepOptions
) -> Float[Array, "9 cameras"]:
    """One damped Gauss-Newton step of every camera by itself, kept only where that camera's own cost falls.

    Args:
        layout: slots.
        cameras: where to start.
        points: they stand still.
        options: loss, and whether intrinsics stay.

    Returns:
        Cameras; the total cost is never larger than before.
    """
    linear = linearize(layout, cameras, points, options.loss)
    linear = with_free_lenses(layout, linear, options.intrinsics, alone=True)
    rows = [entry for k in range(2) for entry in (*linear.camera_jacobian[k], linear.residual[k])]
    level, *levels = layout.camera_levels
    gathered = take_rows(as_rows(rows), level).reshape(level.shape[0], -1, 10)
    products = tree_sum(outer_sum(gathered[..., :9], gathered), tuple(levels))
    blocks, gradient = products[:, :, :9], products[:, :, 9]
    diagonal = jnp.clip(jnp.diagonal(blocks, axis1=1, axis2=2), DIAGONAL_MINIMUM, DIAGONAL_MAXIMUM)
    # XLA would add up a camera's costs anew for every number that depends on them
    each_sum = lambda costs: tree_sum(costs[:, None], layout.camera_levels)[:, 0]
    own_cost = lambda costs: compute_unfused(each_sum, costs, index=layout.slot_camera)
    before = own_cost(linear.costs)

    def attempt(carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        best, done, turn = carry
        damped = blocks + (dampings[turn] * diagonal)[:, :, None] * jnp.eye(9, dtype=blocks.dtype)
        step = -components_first(solve_positive(damped, gradient))
        # on the manifold, in which the Jacobian is written
        moved = (cameras + step).at[:3].set(camera.compose_left(step[:3], cameras[:3]))
        costs = observation_costs(layout, moved, points, options.loss)
        upright = moved[6] * cameras[6] >= 0  # as in candidates.py
        better = (own_cost(costs) < before) & ~done & upright
        return jnp.where(better, moved, best), done | better, turn + 1

    # a loop and not two copies: half of it to compile
    dampings, unseen = jnp.asarray(DAMPINGS, cameras.dtype), ~jnp.asarray(layout.camera_seen)
    more = lambda carry: (carry[2] < len(DAMPINGS)) & ~jnp.all(carry[1])
    return lax.while_loop(more, attempt, (cameras, unseen, jnp.zeros((), jnp.int32)))[0]
