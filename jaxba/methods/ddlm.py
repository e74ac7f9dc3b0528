"""Stochastic domain decomposition of DeepLM (`ddlm`): clusters of cameras optimised independently.

Each round draws a partition of the cameras into clusters (structure/random_partitions.py):

1. Points that several clusters see are held fixed, so that clusters have no variable and no residual in common. Each
   cluster takes a damped step of its cameras and of the points that it alone sees, with the refinements of any other
   step (`jaxba/refinement`), and accepts it only if its own cost falls.
2. Cameras are held fixed, and every shared point takes a damped step, or embedded point iterations, under the same
   condition.

The total cost never rises. Lambda is the same for all clusters and shared points of a round.

Source: Huang et al. 2021, "DeepLM: Large-scale Nonlinear Least Squares on Deep Learning Frameworks using Stochastic
Domain Decomposition", section 4. The authors' code has the parts, but no schedule of rounds; the one here is our own.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float, Int

from jaxba.linear.cholesky3 import cholesky3
from jaxba.linear.schur import (
    RotationCoordinates,
    back_substitute,
    camera_system,
    damping_diagonal,
    eliminate_points,
    jacobian_product,
    largest_gradient,
)
from jaxba.linear.step import Step
from jaxba.lm.method import Round
from jaxba.methods.stba import solve_clusters
from jaxba.model.linearize import Linearization, Reference, is_weightless, linearize, point_terms, slot_frames
from jaxba.model.observations import point_passes, view_terms
from jaxba.problem.options import StepOptions, check_count
from jaxba.refinement.acceptance import NEGLIGIBLE
from jaxba.refinement.candidates import best_candidate
from jaxba.refinement.points import PreviousPoints, refine_points
from jaxba.refinement.subproblems import Clusters
from jaxba.structure.conventions import components_first
from jaxba.structure.layout import Layout, partition_of
from jaxba.structure.random_partitions import Partition
from jaxba.structure.segment_sums import take, total

MIN_STEP_FRACTION = 1 / 64
"""Step fraction of a round in which no cluster was accepted; positive because policies use its logarithm."""


@dataclass(frozen=True)
class DomainDecomposition:
    """The method `ddlm`."""

    cluster_cameras: int = 100
    """Largest number of cameras in a cluster. Source: as for `stba`."""

    name: str = field(default="ddlm", init=False)
    description: str = field(
        default="DeepLM's stochastic domain decomposition: clusters optimised independently, then shared points",
        init=False,
    )
    rule: str = field(default="ceres", init=False)
    forms_reduced_system: bool = field(default=True, init=False)
    conjugate_gradients: None = field(default=None, init=False)
    single_solve: bool = field(default=False, init=False)
    uses_previous_steps: bool = field(default=False, init=False)

    def __post_init__(self) -> None:
        check_count("cluster_cameras", self.cluster_cameras, 1)

    def options(self, base: StepOptions) -> StepOptions:
        """See `Method`."""
        return replace(base, method=self)

    def round(
        self,
        layout: Layout,
        cameras: Float[Array, "parameters cameras"],
        points: Float[Array, "3 points"],
        cost: Float[Array, ""],
        damping: Float[Array, ""],
        iteration: int | Int[Array, ""],
        options: StepOptions,
        min_gain: float | Float[Array, ""],
    ) -> Round:
        """See `RoundMethod`."""
        partition = partition_of(layout).at(iteration)
        return decomposed_round(layout, cameras, points, cost, damping, partition, options, min_gain)


def decomposed_round(
    layout: Layout,
    cameras: Float[Array, "parameters cameras"],
    points: Float[Array, "3 points"],
    cost: Float[Array, ""],
    damping: Float[Array, ""],
    partition: Partition,
    options: StepOptions,
    min_gain: float | Float[Array, ""],
) -> Round:
    """One round with a given partition.

    Args:
        layout: the problem's observations, with pairs.
        cameras: current cameras.
        points: current points.
        cost: their cost, pixels^2.
        damping: lambda.
        partition: the partition of this round.
        options: refinement of the clusters' steps and of shared points.
        min_gain: a cluster's step is accepted if its cost falls and its gain ratio exceeds this.
    """
    parts = Clusters.of(layout, partition)

    linear = linearize(layout, cameras, points, options.loss)
    dampings = jnp.full(partition.members.shape[0], damping)
    step = _cluster_steps(parts, linear, cameras, dampings, options)
    before = parts.sums(linear.costs)
    found = best_candidate(parts, cameras, points, before, linear.reference, step, options, min_gain)
    accepted, full_step = found.accepted, step.predicted(jnp.ones_like(before))
    solved = jnp.isfinite(full_step)  # clusters whose factorisation did not fail
    sum_of = lambda values: jnp.sum(jnp.where(solved, values, 0))
    shared = jnp.asarray(partition.is_shared)
    cameras = jnp.where(parts.of_cameras(accepted), found.cameras, cameras)
    points = jnp.where(parts.of_points(accepted) & ~shared, found.points, points)
    predicted = sum_of(jnp.where(accepted, found.predicted, full_step))
    decrease = sum_of(jnp.where(accepted, found.gain * found.predicted, 0))
    offered = jnp.sum(jnp.where(solved, full_step, jnp.inf))
    taken = sum_of(jnp.where(accepted, found.step_fraction * full_step, 0))
    new_points, new_cost = _step_shared_points(layout, cameras, points, damping, partition, options)
    # if every cluster was rejected, shared points alone may lower the cost a little, which is no sign of convergence
    fraction = jnp.where(offered - taken > NEGLIGIBLE * cost, taken / offered, 1)
    return Round(
        cameras,
        new_points,
        jnp.minimum(new_cost, cost),
        predicted,
        jnp.where(predicted > 0, decrease / predicted, 0),  # zero if every factorisation failed
        sum_of(step.slope),
        sum_of(step.slope - step.damped),
        step.gradient_max,
        jnp.clip(fraction, MIN_STEP_FRACTION, 1),
        jax.tree.map(jnp.max, found.work),
        new_cost < cost,
        is_weightless(layout, linear, cost, options.loss),
    )


def _cluster_steps(
    parts: Clusters,
    linear: Linearization,
    cameras: Array,
    dampings: Float[Array, " clusters"],
    options: StepOptions,
) -> Step:
    """Steps of all clusters with shared points held fixed; `gradient_max` is that of the whole problem.

    The step of a cluster whose factorisation failed is zero, and its slope is nan.
    """
    layout, partition = parts.layout, parts.partition
    coordinates, of_camera = RotationCoordinates.of(cameras, options), parts.of_cameras(dampings)
    eliminated = eliminate_points(layout, linear, parts.of_points(dampings), options)
    free = take(jnp.where(partition.is_shared, 0, 1).astype(cameras.dtype), layout.slot_point)
    projected = [[free * entry for entry in row] for row in eliminated.projected]
    eliminated = eliminated._replace(projected=projected)
    system = camera_system(layout, linear, eliminated, coordinates, of_camera[:, None], options)
    camera_step = solve_clusters(layout, linear, eliminated, system, system.right, partition)
    # set failed clusters to zero: padding reads empty slots, which belong to some camera, and would spread a nan
    finite = jnp.all(jnp.isfinite(camera_step), axis=1).at[partition.members].get(mode="fill", fill_value=True)
    solved = jnp.all(finite, axis=1)
    camera_step = jnp.where(layout.camera_seen[:, None] & parts.of_cameras(solved)[:, None], camera_step, 0)
    point_step = jnp.stack(back_substitute(layout, linear, eliminated, camera_step))
    point_step = jnp.where(partition.is_shared | ~parts.of_points(solved), 0, point_step)
    product = jacobian_product(layout, linear, camera_step, point_step)
    slopes = parts.sums(-(linear.residual[0] * product[0] + linear.residual[1] * product[1]))
    slopes = jnp.where(solved, slopes, jnp.nan)
    curvatures = parts.sums(product[0] * product[0] + product[1] * product[1])
    gradient_max = largest_gradient(layout, eliminated, system, coordinates)
    none = jnp.zeros((), jnp.int32), jnp.zeros_like(gradient_max)
    return Step(
        components_first(coordinates.from_manifold(camera_step)),
        point_step,
        slopes,
        slopes - curvatures,
        gradient_max,
        *none,
    )


def _step_shared_points(
    layout: Layout, cameras: Array, points: Array, damping: Array, partition: Partition, options: StepOptions
) -> tuple[Float[Array, "3 points"], Float[Array, ""]]:
    """Optimises shared points with cameras held fixed: embedded iterations, or a damped step if there are none.

    Returns:
        All points, and the total cost (pixels^2). A point changes only if its own cost falls.
    """
    frames = slot_frames(layout, cameras)
    one_pass = point_passes(layout, frames)
    terms = lambda views: point_terms(views, options.loss)[:10]
    *entries, before = one_pass(points, terms)
    if options.refinement.points:
        own, depth = view_terms(layout, frames, points, lambda views: point_terms(views, options.loss)[9:])
        previous = PreviousPoints.of(layout, points, Reference(own, depth))
        refined, costs = refine_points(layout, frames, points, options.loss, options.refinement.points, previous)
        costs = jnp.where(partition.is_shared, costs, before)
        return jnp.where(partition.is_shared, refined, points), total(costs)
    matrix = entries[:6]
    for entry in (0, 2, 5):
        matrix[entry] = matrix[entry] + damping_diagonal(matrix[entry], damping, options)
    factor = cholesky3(matrix)
    step = jnp.stack(factor.backward(factor.forward(entries[6:])))
    trial = points - jnp.where(partition.is_shared, step, 0)
    costs = one_pass(trial, terms)[9]
    better = costs < before
    return jnp.where(better, trial, points), total(jnp.where(better, costs, before))
