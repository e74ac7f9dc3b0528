"""Stochastic domain decomposition (DeepLM's, "ddlm"): clusters of cameras optimised beside each other.

One round: points that several clusters see stand still, so that clusters share neither a variable nor a residual. Each
takes a damped step of its own cameras and of the points that it alone sees, with the embedded iterations, camera rounds
and trials of any other step (`jaxba/refinement`), and keeps it only if its own cost falls. Then cameras stand still
and every separator takes a damped step of its own, or embedded iterations, kept under the same condition. The cost of
the whole can only fall. The next round draws other clusters.

Lambda is one number a round, for clusters and shared points.

Source: Huang et al. 2021, "DeepLM", section 4. The authors' code holds the pieces but not the schedule of rounds, which
is ours.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

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
from jaxba.model.linearize import Linearization, linearize, point_terms, slot_frames
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

LEAST_SHARE = 1 / 64
"""Share of a round in which no cluster was accepted, not zero because policies look at its logarithm."""


@dataclass(frozen=True)
class DomainDecomposition:
    """The method `ddlm`."""

    cluster_cameras: int = 100
    """Cameras of a cluster at most. Source: as for `stba`."""

    name: str = field(default="ddlm", init=False)
    description: str = field(
        default="DeepLM's stochastic domain decomposition: clusters optimised beside each other, then shared points",
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
        cameras: Float[Array, "9 cameras"],
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
        options: what is embedded in the steps of the clusters, and what shared points do after them.
        min_gain: a cluster's step is accepted if its cost falls and its gain ratio exceeds this.
    """
    parts = Clusters.of(layout, partition)

    linear = linearize(layout, cameras, points, options.loss)
    dampings = jnp.full(partition.members.shape[0], damping)
    step = _cluster_steps(parts, linear, cameras, dampings, options)
    before = parts.sums(linear.costs)
    found = best_candidate(parts, cameras, points, before, linear.reference, step, options, min_gain)
    good, whole = found.accepted, step.predicted(jnp.ones_like(before))
    possible = jnp.isfinite(whole)
    sum_of = lambda values: jnp.sum(jnp.where(possible, values, 0))
    shared = jnp.asarray(partition.is_shared)
    cameras = jnp.where(parts.of_cameras(good), found.cameras, cameras)
    points = jnp.where(parts.of_points(good) & ~shared, found.points, points)
    predicted = sum_of(jnp.where(good, found.predicted, whole))
    gained = sum_of(jnp.where(good, found.gain * found.predicted, 0))
    offered = jnp.sum(jnp.where(possible, whole, jnp.inf))
    taken = sum_of(jnp.where(good, found.share * whole, 0))
    moved, after = _separators(layout, cameras, points, damping, partition, options)
    # points alone may lower the cost a little where every cluster was refused, which is no sign of convergence
    share = jnp.where(offered - taken > NEGLIGIBLE * cost, taken / offered, 1)
    return Round(
        cameras,
        moved,
        jnp.minimum(after, cost),
        predicted,
        jnp.where(predicted > 0, gained / predicted, 0),  # no cluster's matrix could be factored
        sum_of(step.slope),
        sum_of(step.slope - step.damped),
        step.gradient_max,
        jnp.clip(share, LEAST_SHARE, 1),
        jnp.max(found.repairs),
        after < cost,
    )


def _cluster_steps(
    parts: Clusters,
    linear: Linearization,
    cameras: Array,
    dampings: Float[Array, " clusters"],
    options: StepOptions,
) -> Step:
    """Steps of all clusters, separators standing still; the gradient is that of the whole problem.

    A cluster whose factorisation failed stands still, and its slope is nan.
    """
    layout, partition = parts.layout, parts.partition
    coordinates, of_camera = RotationCoordinates.of(cameras, options), parts.of_cameras(dampings)
    eliminated = eliminate_points(layout, linear, parts.of_points(dampings), options)
    free = take(jnp.where(partition.is_shared, 0, 1).astype(cameras.dtype), layout.slot_point)
    projected = [[free * entry for entry in row] for row in eliminated.projected]
    eliminated = eliminated._replace(projected=projected)
    system = camera_system(layout, linear, eliminated, coordinates, of_camera[:, None], options)
    moves = solve_clusters(layout, linear, eliminated, system, system.right, partition)
    # what is no number would spread: empty slots belong to some camera, and padding reads them
    finite = jnp.all(jnp.isfinite(moves), axis=1).at[partition.members].get(mode="fill", fill_value=True)
    solved = jnp.all(finite, axis=1)
    moves = jnp.where(layout.camera_seen[:, None] & parts.of_cameras(solved)[:, None], moves, 0)
    point_moves = jnp.stack(back_substitute(layout, linear, eliminated, moves))
    point_moves = jnp.where(partition.is_shared | ~parts.of_points(solved), 0, point_moves)
    moved = jacobian_product(layout, linear, moves, point_moves)
    slopes = parts.sums(-(linear.residual[0] * moved[0] + linear.residual[1] * moved[1]))
    slopes = jnp.where(solved, slopes, jnp.nan)
    curvatures = parts.sums(moved[0] * moved[0] + moved[1] * moved[1])
    gradient_max = largest_gradient(eliminated, system, coordinates)
    none = jnp.zeros((), jnp.int32), jnp.zeros_like(gradient_max)
    return Step(
        components_first(coordinates.from_manifold(moves)),
        point_moves,
        slopes,
        slopes - curvatures,
        gradient_max,
        *none,
    )


def _separators(
    layout: Layout, cameras: Array, points: Array, damping: Array, partition: Partition, options: StepOptions
) -> tuple[Float[Array, "3 points"], Float[Array, ""]]:
    """Every separator after its embedded iterations, or a damped step where there are none; the cost after that."""
    frames = slot_frames(layout, cameras)
    one_pass = point_passes(layout, frames)
    terms = lambda views: point_terms(views, options.loss)[:10]
    *entries, before = one_pass(points, terms)
    if options.refinement.points:
        (inverse_depth,) = view_terms(layout, frames, points, lambda views: [views.projected().inverse_depth])
        previous = PreviousPoints.of(layout, points, inverse_depth)
        refined, costs = refine_points(layout, frames, points, options.loss, options.refinement.points, previous)
        costs = jnp.where(partition.is_shared, costs, before)
        return jnp.where(partition.is_shared, refined, points), total(costs)
    matrix = entries[:6]
    for place in (0, 2, 5):
        matrix[place] = matrix[place] + damping_diagonal(matrix[place], damping, options)
    factor = cholesky3(matrix)
    step = jnp.stack(factor.backward(factor.forward(entries[6:])))
    trial = points - jnp.where(partition.is_shared, step, 0)
    costs = one_pass(trial, terms)[9]
    better = costs < before
    return jnp.where(better, trial, points), total(jnp.where(better, costs, before))
