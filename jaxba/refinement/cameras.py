"""Resection: every camera is re-optimised on its own with the points held fixed."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from jaxba.linear.cholesky import solve_positive
from jaxba.model import camera
from jaxba.model.linearize import linearize, observation_costs, only_free
from jaxba.problem.options import DIAGONAL_MAXIMUM, DIAGONAL_MINIMUM, StepOptions
from jaxba.refinement.retraction import keep_focal_signs
from jaxba.runtime import loops
from jaxba.runtime.fusion import compute_unfused
from jaxba.structure.devices import sum_over_devices
from jaxba.structure.layout import Layout
from jaxba.structure.segment_sums import as_rows, outer_sum, take_rows, tree_sum

# relative damping of the first attempt at a camera's step, and of one after a failure
DAMPINGS = (1e-6, 1e-2)


def refine_cameras(
    layout: Layout,
    cameras: Float[Array, "parameters cameras"],
    points: Float[Array, "3 points"],
    options: StepOptions,
) -> Float[Array, "parameters cameras"]:
    """One damped Gauss-Newton step of every camera on its own, accepted if that camera's own cost
    falls. Returns new cameras; the total cost is never larger than before."""
    linear = linearize(layout, cameras, points, options.loss)
    linear = only_free(layout, linear, options.intrinsics, alone=True)
    rows = [entry for k in range(2) for entry in (*linear.camera_jacobian[k], linear.residual[k])]
    level, *levels = layout.camera_levels
    width = len(linear.camera_jacobian[0])
    gathered = take_rows(as_rows(rows), level).reshape(level.shape[0], -1, width + 1)
    products = sum_over_devices(
        layout, tree_sum(outer_sum(gathered[..., :width], gathered), tuple(levels))
    )
    blocks = products[:, :, :width]
    gradient = products[:, :, width]
    unknowns = layout.unknowns
    diagonal = jnp.clip(jnp.diagonal(blocks, axis1=1, axis2=2), DIAGONAL_MINIMUM, DIAGONAL_MAXIMUM)

    # not fused with its uses: XLA would recompute the sums in each of them
    def each_sum(costs):
        return tree_sum(costs[:, None], layout.camera_levels)[:, 0]

    def own_cost(costs):
        return sum_over_devices(layout, compute_unfused(each_sum, costs, index=layout.slot_camera))

    before = own_cost(linear.reference.costs)

    def attempt(carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        best, done, attempt_number = carry
        damped = blocks + (dampings[attempt_number] * diagonal)[:, :, None] * jnp.eye(
            width, dtype=blocks.dtype
        )
        step = -solve_positive(damped, gradient).T
        # the Jacobian, and so the step, is in manifold coordinates
        trial = camera.moved(cameras, unknowns.expanded(step), unknowns)
        costs = observation_costs(layout, trial, points, options.loss)
        better = (own_cost(costs) < before) & ~done & keep_focal_signs(cameras, trial)
        return jnp.where(better, trial, best), done | better, attempt_number + 1

    # a loop instead of unrolled attempts: half as much to compile
    dampings = jnp.asarray(DAMPINGS, cameras.dtype)
    unseen = ~jnp.asarray(layout.camera_seen)

    def more(carry):
        return (carry[2] < len(DAMPINGS)) & ~jnp.all(carry[1])

    return loops.while_loop(more, attempt, (cameras, unseen, jnp.zeros((), jnp.int32)))[0]
