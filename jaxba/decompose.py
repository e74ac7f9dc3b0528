"""Stochastic domain decomposition (DeepLM's, "ddlm"): clusters of cameras optimised beside each other.

One round: points that several clusters see stand still, so that clusters share neither a variable nor a residual. Each
takes a damped step of its own cameras and of the points that it alone sees, and keeps it only if its own cost falls.
Then cameras stand still and every separator takes a damped step of its own, kept under the same condition. The cost of
the whole can only fall. The next round draws other clusters.

Lambda is one number a round, for clusters and separators. With `block_steps` above one, a cluster that fails multiplies
it for itself.

Source: Huang et al. 2021, "DeepLM", section 4. The authors' code holds the pieces but not the schedule of rounds, which
is ours.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Bool, Float

from jaxba.blocks3 import cholesky3
from jaxba.eliminate import (
    Coordinates,
    back_substitute,
    camera_system,
    damping_diagonal,
    eliminate_points,
    largest_gradient,
)
from jaxba.layout import Layout
from jaxba.linearize import (
    Linearization,
    in_front,
    linearize,
    point_normal_equations,
    residuals,
    slot_costs,
    slot_frames,
)
from jaxba.normal import image
from jaxba.options import StepOptions
from jaxba.partition import Partition
from jaxba.refine import Home, refine_points
from jaxba.resect import move_cameras
from jaxba.split import solve_clusters
from jaxba.sums import point_sum, take, total, tree_sum
from jaxba.trial import NEGLIGIBLE

LOCAL_FACTOR = 4.0
"""Factor on a cluster's own lambda after its step failed."""

LEAST_SHARE = 1 / 64
"""Share of a round in which no cluster was accepted, not zero because policies look at its logarithm."""


class Round(NamedTuple):
    """What a round did."""

    cameras: Float[Array, "9 cameras"]
    points: Float[Array, "3 points"]
    cost: Float[Array, ""]  # pixels squared
    predicted: Float[Array, ""]  # decrease that the clusters' linear models promised, all clusters
    gain: Float[Array, ""]  # what clusters that were accepted gained, over that
    slope: Float[Array, ""]  # -g.d
    curvature: Float[Array, ""]  # d.H d
    gradient_max: Float[Array, ""]  # before the round
    share: Float[Array, ""]  # of the promised decrease, that of accepted clusters; 1 where the rest is negligible
    accepted: Bool[Array, ""]


class _Carry(NamedTuple):
    cameras: Array
    points: Array
    dampings: Float[Array, " clusters"]
    predicted: Array
    gained: Array
    refused: Array
    slope: Array
    curvature: Array
    gradient_max: Array


def decomposed_round(
    layout: Layout,
    cameras: Float[Array, "9 cameras"],
    points: Float[Array, "3 points"],
    cost: Float[Array, ""],
    damping: Float[Array, ""],
    partition: Partition,
    options: StepOptions,
    min_gain: float | Float[Array, ""],
) -> Round:
    """One round of one partition.

    Args:
        layout: slots, with pairs.
        cameras: present cameras.
        points: present points.
        cost: their cost, pixels squared.
        damping: lambda.
        partition: of this round.
        options: `block_steps` steps of the clusters, and embedded point iterations of all points after them.
        min_gain: a cluster's step is accepted if its cost falls and its gain ratio exceeds this.
    """
    fixed = take(jnp.asarray(partition.separator), layout.slot_point)
    inside = partition.members < layout.num_cameras

    def by_cluster(per_slot: Array) -> Float[Array, " clusters"]:
        per_camera = tree_sum(per_slot[:, None], layout.camera_levels)[:, 0]
        return jnp.sum(jnp.where(inside, per_camera.at[partition.members].get(mode="clip"), 0), axis=1)

    def body(count: Array, carry: _Carry) -> _Carry:
        linear = linearize(layout, carry.cameras, carry.points, options.loss)
        moves, point_moves, gradient_max = _cluster_steps(
            layout, linear, carry.cameras, carry.dampings, partition, fixed, options
        )
        coordinates = Coordinates.of(carry.cameras, options)
        moved = image(layout, linear, moves, point_moves)
        slopes = by_cluster(-(linear.residual[0] * moved[0] + linear.residual[1] * moved[1]))
        curvatures = by_cluster(moved[0] * moved[0] + moved[1] * moved[1])
        turned = jnp.einsum("cij,cj->ci", coordinates.inverse, moves[:, :3])
        step = jnp.concatenate([turned, moves[:, 3:]], axis=1).T
        trial = move_cameras(carry.cameras, step, options)
        home = Home(carry.points, linear.front)
        trial_points, costs = _own_points(layout, trial, carry.points + point_moves, home, partition, options)
        decrease, predicted = by_cluster(linear.costs - costs), slopes - curvatures / 2
        good = (decrease > 0) & (predicted > 0) & (decrease > min_gain * predicted)  # false where they are no numbers
        sum_of = lambda values: jnp.sum(jnp.where(jnp.isfinite(predicted), values, 0))
        good_camera, good_point = _spread(layout, partition, good)
        return _Carry(
            jnp.where(good_camera, trial, carry.cameras),
            jnp.where(good_point, trial_points, carry.points),
            jnp.where(good, carry.dampings, LOCAL_FACTOR * carry.dampings),
            carry.predicted + sum_of(predicted),
            carry.gained + sum_of(jnp.where(good, decrease, 0)),
            carry.refused + jnp.sum(jnp.where(good, 0, jnp.where(jnp.isfinite(predicted), predicted, jnp.inf))),
            carry.slope + sum_of(slopes),
            carry.curvature + sum_of(curvatures),
            jnp.where(count == 0, gradient_max, carry.gradient_max),
        )

    zero = jnp.zeros_like(cost)
    dampings = jnp.full(partition.members.shape[0], damping)
    start = _Carry(cameras, points, dampings, zero, zero, zero, zero, zero, zero)
    end = lax.fori_loop(0, options.block_steps, body, start)
    moved, after = _separators(layout, end.cameras, end.points, damping, partition, options)
    # points alone may lower the cost a little where every cluster was refused, which is no sign of convergence
    share = jnp.clip(1 - end.refused / jnp.maximum(end.predicted, end.refused), LEAST_SHARE, 1)
    share = jnp.where(end.refused > NEGLIGIBLE * cost, jnp.nan_to_num(share, nan=LEAST_SHARE), 1)
    return Round(
        end.cameras,
        moved,
        jnp.minimum(after, cost),
        end.predicted,
        end.gained / end.predicted,
        end.slope,
        end.curvature,
        end.gradient_max,
        share.astype(cost.dtype),
        after < cost,
    )


def _cluster_steps(
    layout: Layout,
    linear: Linearization,
    cameras: Array,
    dampings: Float[Array, " clusters"],
    partition: Partition,
    fixed: Bool[Array, " slots"],
    options: StepOptions,
) -> tuple[Float[Array, "cameras 9"], Float[Array, "3 points"], Float[Array, ""]]:
    """Steps of all clusters, separators standing still, and the largest entry of the whole gradient.

    A cluster whose factorisation failed gets a step of nan.
    """
    coordinates, of_camera = Coordinates.of(cameras, options), take(dampings, partition.label)
    eliminated = eliminate_points(layout, linear, _point_value(layout, of_camera), options)
    free = jnp.where(fixed, 0, 1).astype(cameras.dtype)
    projected = [[free * entry for entry in row] for row in eliminated.projected]
    eliminated = eliminated._replace(projected=projected)
    system = camera_system(layout, linear, eliminated, coordinates, of_camera[:, None], options)
    moves = solve_clusters(layout, linear, eliminated, system, system.right, partition)
    moves = jnp.where(layout.camera_seen[:, None], moves, 0)
    point_moves = jnp.stack(back_substitute(layout, linear, eliminated, moves))
    return moves, jnp.where(partition.separator, 0, point_moves), largest_gradient(eliminated, system, coordinates)


def _point_value(layout: Layout, of_camera: Float[Array, " cameras"]) -> Float[Array, " points"]:
    """Of each point the mean of a number that its observers agree about; of a separator nobody uses it."""
    seen = layout.slot_mask.astype(of_camera.dtype)
    sums = point_sum(layout, jnp.stack([take(of_camera, layout.slot_camera) * seen, seen]))
    return jnp.where(sums[1] > 0, sums[0] / jnp.maximum(sums[1], 1), of_camera[0])


def _own_points(
    layout: Layout, cameras: Array, points: Array, home: Home, partition: Partition, options: StepOptions
) -> tuple[Float[Array, "3 points"], Float[Array, " slots"]]:
    """The clusters' points after embedded iterations, if there are any, and the cost of every slot."""
    frames = slot_frames(layout, cameras)
    if options.refine_points:
        points = refine_points(layout, frames, points, options.loss, options.refine_points, home)[0]
        points = jnp.where(partition.separator, home.points, points)
    return points, slot_costs(options.loss, residuals(layout, frames, points)[1])


def _spread(
    layout: Layout, partition: Partition, good: Bool[Array, " clusters"]
) -> tuple[Bool[Array, " cameras"], Bool[Array, " points"]]:
    """Whether a camera's cluster, and a point's only cluster, is good."""
    good_camera = take(good, partition.label)
    bad = (~take(good_camera, layout.slot_camera) & layout.slot_mask).astype(jnp.float32)
    return good_camera, (point_sum(layout, bad[None])[0] == 0) & ~partition.separator


def _separators(
    layout: Layout, cameras: Array, points: Array, damping: Array, partition: Partition, options: StepOptions
) -> tuple[Float[Array, "3 points"], Float[Array, ""]]:
    """A damped step of every separator, then embedded iterations of all points; the cost after them."""
    frames = slot_frames(layout, cameras)
    if options.refine_points:
        home = Home(points, in_front(residuals(layout, frames, points)[0]))
        points, costs = refine_points(layout, frames, points, options.loss, options.refine_points, home)
        return points, total(costs)
    projection, residual = residuals(layout, frames, points)
    entries = point_normal_equations(layout, frames, projection, residual, options.loss)
    sums = point_sum(layout, jnp.stack([*entries, slot_costs(options.loss, residual)]))
    matrix = [sums[k] for k in range(6)]
    for place in (0, 2, 5):
        matrix[place] = matrix[place] + damping_diagonal(matrix[place], damping, options)
    factor = cholesky3(matrix)
    step = jnp.stack(factor.backward(factor.forward([sums[k] for k in range(6, 9)])))
    trial = points - jnp.where(partition.separator, step, 0)
    costs = point_sum(layout, slot_costs(options.loss, residuals(layout, frames, trial)[1])[None])[0]
    better = costs < sums[9]
    return jnp.where(better, trial, points), total(jnp.where(better, costs, sums[9]))
