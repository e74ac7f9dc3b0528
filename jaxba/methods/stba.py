"""Stochastic bundle adjustment (STBA): a step from a system that decomposes into clusters of
cameras.

Each iteration draws a partition of the cameras into clusters (structure/random_partitions.py):

1. A point that several clusters see is split into independent point replicas, one per cluster. The
   reduced camera system of the split problem is block-diagonal, one small dense system per cluster.
2. A few Richardson iterations on the true reduced camera system correct the camera step.
3. The points follow by back-substitution, unsplit.

Lambda damps cameras, points and replicas. With a large lambda the step is nearly a steepest-descent
step, in which the replicas of a point differ; `consensus_gradient` makes them agree.

Source: Zhou et al. 2020, "Stochastic Bundle Adjustment for Efficient and Scalable 3D
Reconstruction", sections 3 and 4, and the authors' code."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import jax
import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Float

from jaxba.linear.cholesky import MIN_UNKNOWNS, factor_and_solve
from jaxba.linear.cholesky3 import Cholesky3, cholesky3
from jaxba.linear.formed import reduced_blocks
from jaxba.linear.preconditioners import block_inverse
from jaxba.linear.schur import DampedSystem, apply_reduced, damping_diagonal, lift_to_cameras
from jaxba.lm.method import MethodStep, StepMethod
from jaxba.model.linearize import Linearization, normal_entries
from jaxba.problem.options import StepOptions, check_count
from jaxba.runtime import loops
from jaxba.runtime.fusion import computed_after
from jaxba.structure.layout import Layout
from jaxba.structure.random_partitions import Partition
from jaxba.structure.segment_sums import point_sum, take, take_each, take_rows, tree_sum

# smallest lambda for which gradients of replicas agree. Source: the authors' code
MIN_CONSENSUS_DAMPING = 1.0

SplitSystem: TypeAlias = tuple[list[list[Array]], list[Array]]
"""The eliminated point replicas (linear/schur.py), of each slot's replica: Q = J_p L^-T, [2][3] of
(slots,), and h = L^-1 g, [3] of (slots,)."""


@dataclass(frozen=True)
class StochasticClusters(StepMethod):
    """The method `stba`."""

    cluster_cameras: int = 100  # largest number of cameras in a cluster. Source: the authors' code
    # Richardson iterations on the true system after the clusters' solution. Source: the authors'
    # code
    repairs: int = 4

    name = "stba"
    rule = "stba"
    forms_reduced_system = True

    def __post_init__(self) -> None:
        check_count("cluster_cameras", self.cluster_cameras, 1)
        check_count("repairs", self.repairs, 0)

    def solve(self, system: DampedSystem, options: StepOptions) -> MethodStep:
        """See `StepMethod`."""
        partition = system.layout.part("partitions").at(system.iteration)
        step = clustered_step(system, partition, options, self.repairs)
        return MethodStep(step, None, jnp.zeros((), jnp.int32), False)


def clustered_step(
    system: DampedSystem, partition: Partition, options: StepOptions, repairs: int
) -> Float[Array, "cameras width"]:
    """The camera step of one STBA iteration, in manifold coordinates. `system` is that of the
    unsplit problem, whose layout has pairs; `partition` is that of this iteration, and `repairs`
    the number of Richardson iterations."""
    layout, linear, points, cameras, damping = system[:5]
    split = eliminate_replicas(layout, linear, damping, partition, options)
    right = lift_to_cameras(layout, linear, *split) - cameras.gradient  # -sum J_c^T (r - Q h)
    parts = system._replace(points=points._replace(projected=split[0]))
    return richardson(system, solve_clusters(parts, right, partition), repairs)


def eliminate_replicas(
    layout: Layout,
    linear: Linearization,
    damping: Float[Array, ""],
    partition: Partition,
    options: StepOptions,
) -> SplitSystem:
    """As `schur.eliminate_points`, for point replicas."""
    rows = jnp.stack(normal_entries(linear.point_jacobian, linear.residual))
    sums = tree_sum(rows.T, partition.levels).T
    matrix = [sums[k] for k in range(6)]
    gradient = sums[6:]
    for entry in (0, 2, 5):
        matrix[entry] = matrix[entry] + damping_diagonal(matrix[entry], damping, options)
    diagonal = jnp.stack([matrix[entry] for entry in (0, 2, 5)])
    consensus = consensus_gradient(layout, partition, diagonal, gradient)
    gradient = jnp.where(damping >= MIN_CONSENSUS_DAMPING, consensus, gradient)
    factor = cholesky3(matrix)
    solved = jnp.stack(factor.forward(list(gradient)))
    at_slot = Cholesky3(*take(jnp.stack(factor), partition.slot_replica))
    projected = [at_slot.forward(row) for row in linear.point_jacobian]
    return projected, take_each(solved, partition.slot_replica)


def consensus_gradient(
    layout: Layout,
    partition: Partition,
    diagonal: Float[Array, "3 replicas"],
    gradient: Float[Array, "3 replicas"],
) -> Float[Array, "3 replicas"]:
    """Gradients of replicas for which all replicas of a point take the same step `-D_k^-1 g_k`.

        g_k <- D_k (sum_j g_j) / (sum_j D_j)

    These are the nearest such gradients in the metric of `D^-1`: the closed form of the published
    projection `g - H^T (H D^-1 H^T)^-1 H D^-1 g`, where H takes differences to the first replica.
    `diagonal` is D, the diagonal of the damped block of each replica in the partition of this
    iteration, and `gradient` is its g."""
    # Sums over the replicas of a point run over its slots, with weights that sum to one for each
    # replica.
    count = tree_sum(jnp.asarray(layout.slot_mask, gradient.dtype)[:, None], partition.levels)[:, 0]
    weight = jnp.where(count > 0, 1 / jnp.maximum(count, 1), 0)
    per_slot = (
        take(jnp.concatenate([gradient, diagonal]) * weight, partition.slot_replica)
        * layout.slot_mask
    )
    by_slot = take(point_sum(layout, per_slot), layout.slot_point) * layout.slot_mask
    # back to replicas: all slots of a replica have the same value, so take their mean
    sums = tree_sum(by_slot.T, partition.levels).T * weight
    diagonal_sum = sums[3:]
    return jnp.where(
        diagonal_sum > 0,
        diagonal * sums[:3] / jnp.where(diagonal_sum > 0, diagonal_sum, 1),
        gradient,
    )


def solve_clusters(
    system: DampedSystem, right: Float[Array, "cameras width"], partition: Partition
) -> Float[Array, "cameras width"]:
    """Solves the block-diagonal system of damped camera blocks, one dense factorisation per
    cluster; of its points only `projected` is used, which couples the cameras of a cluster. Returns
    the camera step, in manifold coordinates; non-finite for a cluster whose factorisation
    failed."""
    blocks = reduced_blocks(system)
    blocks = jnp.concatenate([blocks, jnp.eye(blocks.shape[-1], dtype=blocks.dtype)[None]])
    clusters, size = partition.members.shape
    table = take_rows(blocks, partition.blocks)  # the lower triangle of the block of each cluster
    matrices = table.transpose(0, 1, 3, 2, 4).reshape(clusters, size * blocks.shape[-1], -1)
    padded = jnp.concatenate([right, jnp.zeros((1, right.shape[1]), right.dtype)])
    rights = take_rows(padded, partition.members).reshape(clusters, -1)
    # large systems are solved one by one on a CPU, where each factorisation uses all cores
    if jax.default_backend() == "cpu" and rights.shape[1] >= MIN_UNKNOWNS:
        steps = lax.map(lambda pair: factor_and_solve(*pair), (matrices, rights))
    else:
        steps = jax.vmap(factor_and_solve)(matrices, rights)
    steps = steps.reshape(*partition.members.shape, -1)
    # every camera is in one cluster; padding writes to the extra last row
    return jnp.zeros_like(padded).at[partition.members].set(steps)[:-1]


def richardson(system: DampedSystem, step: Array, rounds: int) -> Float[Array, "cameras width"]:
    """Richardson iterations `x <- x + B^-1 (b - S x)` on the true reduced camera system.

    They converge: each multiplies the error by `B^-1 E C^-1 E^T` (damped B and C), whose spectral
    radius is below one."""
    inverse = block_inverse(computed_after(step, system.cameras.blocks))

    def iteration(_, x):
        return x + inverse(system.cameras.right - apply_reduced(system, x))

    return loops.fori_loop(0, rounds, iteration, step)
