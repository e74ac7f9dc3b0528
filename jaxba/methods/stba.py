"""Stochastic bundle adjustment (STBA): a step from a system that falls apart into clusters of cameras.

A point that several clusters see is split into a copy per cluster, and for this step nothing holds the copies together.
The reduced camera system is then block-diagonal, a small dense system per cluster. What the split lost is repaired by a
few Richardson steps on the true reduced camera system, and the points follow the cameras unsplit.

Lambda damps cameras (times `camera_damping`), points and copies. Large ones make the copies of a point disagree about a
steepest-descent step; `agreed_gradient` mends that.

Source: Zhou et al. 2020, "Stochastic Bundle Adjustment for Efficient and Scalable 3D Reconstruction", sections 3 and 4,
and the authors' code. Clusters: structure/random_partitions.py.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Float, Int

from jaxba.linear.cholesky import MIN_UNKNOWNS, factor_and_solve
from jaxba.linear.cholesky3 import Cholesky3, cholesky3
from jaxba.linear.preconditioners import block_inverse
from jaxba.linear.reduced_system import reduced_blocks
from jaxba.linear.schur import CameraSystem, PointSystem, apply_reduced, damping_diagonal
from jaxba.lm.method import DampedSystem, MethodStep
from jaxba.model.linearize import Linearization, normal_entries
from jaxba.problem.options import StepOptions, check_count
from jaxba.runtime.fusion import computed_after
from jaxba.structure.layout import Layout, partition_of
from jaxba.structure.random_partitions import Partition
from jaxba.structure.segment_sums import as_rows, point_sum, take, take_each, take_rows, tree_sum

CORRECTED_FROM = 1.0
"""Lambda from which on the copies of a point are made to agree. Source: the authors' code (radius at most 1)."""


class SplitSystem(NamedTuple):
    """The eliminated copies."""

    projected: list[list[Array]]  # J_p L^-T of each slot's copy, [2][3] of (slots,)
    solved: list[Array]  # L^-1 g of each slot's copy, [3] of (slots,)


@dataclass(frozen=True)
class StochasticClusters:
    """The method `stba`."""

    cluster_cameras: int = 100
    """Cameras of a cluster at most. Source: the authors' code."""

    repairs: int = 4
    """Richardson steps on the true system after the clusters' solution. Source: the authors' code."""

    name: str = field(default="stba", init=False)
    description: str = field(
        default="stochastic bundle adjustment: random clusters of cameras solved apart, then four repairs",
        init=False,
    )
    rule: str = field(default="stba", init=False)
    forms_reduced_system: bool = field(default=True, init=False)
    conjugate_gradients: None = field(default=None, init=False)
    single_solve: bool = field(default=True, init=False)
    uses_previous_steps: bool = field(default=False, init=False)

    def __post_init__(self) -> None:
        check_count("cluster_cameras", self.cluster_cameras, 1)
        check_count("repairs", self.repairs, 0)

    def options(self, base: StepOptions) -> StepOptions:
        """See `Method`."""
        return replace(base, method=self)

    def solve(
        self,
        system: DampedSystem,
        options: StepOptions,
        forcing: float | Float[Array, ""],
        iteration: int | Int[Array, ""],
        parameters: Float[Array, "9 cameras"],
        previous: Float[Array, "steps 9 cameras"] | None,
    ) -> MethodStep:
        """See `StepMethod`."""
        partition = partition_of(system.layout).at(iteration)
        step = clustered_step(*system, partition, options, self.repairs)
        return MethodStep(step, None, jnp.zeros((), jnp.int32), False)


def clustered_step(
    layout: Layout,
    linear: Linearization,
    points: PointSystem,
    system: CameraSystem,
    damping: Float[Array, ""],
    partition: Partition,
    options: StepOptions,
    repairs: int,
) -> Float[Array, "cameras 9"]:
    """The camera step of one STBA iteration, in manifold coordinates.

    Args:
        layout: slots, with pairs.
        linear: Jacobians and residuals.
        points: the true points, eliminated.
        system: the true camera system, damped.
        damping: lambda.
        partition: of this iteration.
        options: scaling of the damping.
        repairs: Richardson steps.
    """
    split = eliminate_copies(layout, linear, damping, partition, options)
    right = split_right(layout, linear, system, split)
    step = solve_clusters(layout, linear, points._replace(projected=split.projected), system, right, partition)
    return repair(layout, linear, points, system, step, repairs)


def eliminate_copies(
    layout: Layout, linear: Linearization, damping: Float[Array, ""], partition: Partition, options: StepOptions
) -> SplitSystem:
    """As `eliminate.eliminate_points`, for copies."""
    rows = jnp.stack(normal_entries(linear.point_jacobian, linear.residual))
    sums = tree_sum(rows.T, partition.levels).T
    matrix, gradient = [sums[k] for k in range(6)], sums[6:]
    for place in (0, 2, 5):
        matrix[place] = matrix[place] + damping_diagonal(matrix[place], damping, options)
    diagonal = jnp.stack([matrix[place] for place in (0, 2, 5)])
    agreed = agreed_gradient(layout, partition, diagonal, gradient)
    gradient = jnp.where(damping >= CORRECTED_FROM, agreed, gradient)
    factor = cholesky3(matrix)
    solved = jnp.stack(factor.forward(list(gradient)))
    at_slot = Cholesky3(*take(jnp.stack(factor), partition.slot_replica))
    projected = [at_slot.forward(row) for row in linear.point_jacobian]
    return SplitSystem(projected, take_each(solved, partition.slot_replica))


def agreed_gradient(
    layout: Layout, partition: Partition, diagonal: Float[Array, "3 copies"], gradient: Float[Array, "3 copies"]
) -> Float[Array, "3 copies"]:
    """Gradients `D_k (sum_j g_j) / (sum_j D_j)`: the copies of a point then agree about the step `-D_k^-1 g_k`.

    The nearest gradients, in the metric of `D^-1`, for which they do; the closed form of the published projection
    `g - H^T (H D^-1 H^T)^-1 H D^-1 g`, where `H` takes differences to the first copy. Sums over the copies of a point
    run over its slots, each copy shared out among its own.
    """
    count = tree_sum(jnp.asarray(layout.slot_mask, gradient.dtype)[:, None], partition.levels)[:, 0]
    share = jnp.where(count > 0, 1 / jnp.maximum(count, 1), 0)
    per_slot = take(jnp.concatenate([gradient, diagonal]) * share, partition.slot_replica) * layout.slot_mask
    by_slot = take(point_sum(layout, per_slot), layout.slot_point) * layout.slot_mask
    # back to copies, of which every slot knows the same: their mean
    ours = tree_sum(by_slot.T, partition.levels).T * share
    whole = ours[3:]
    return jnp.where(whole > 0, diagonal * ours[:3] / jnp.where(whole > 0, whole, 1), gradient)


def split_right(
    layout: Layout, linear: Linearization, system: CameraSystem, split: SplitSystem
) -> Float[Array, "cameras 9"]:
    """Right-hand side of the split system, `-J_c^T (r - Q h)`."""
    inner = [sum(split.projected[k][i] * split.solved[i] for i in range(3)) for k in range(2)]
    first, second = linear.camera_jacobian
    rows = as_rows([first[a] * inner[0] + second[a] * inner[1] for a in range(9)])
    return tree_sum(rows, layout.camera_levels) - system.gradient


def solve_clusters(
    layout: Layout,
    linear: Linearization,
    points: PointSystem,
    system: CameraSystem,
    right: Float[Array, "cameras 9"],
    partition: Partition,
) -> Float[Array, "cameras 9"]:
    """Solves the block-diagonal system, one dense factorisation per cluster.

    Args:
        points: whose `projected` couples the cameras of one cluster; nothing else of it is used.
        right: right-hand side.
    """
    matrices = cluster_matrices(layout, linear, points, system, partition)
    padded = jnp.concatenate([right, jnp.zeros((1, 9), right.dtype)])
    rights = take_rows(padded, partition.members).reshape(partition.members.shape[0], -1)
    # large ones one after the other on a CPU, where each factorisation uses all cores by itself
    if jax.default_backend() == "cpu" and rights.shape[1] >= MIN_UNKNOWNS:
        found = lax.map(lambda pair: factor_and_solve(*pair), (matrices, rights))
    else:
        found = jax.vmap(factor_and_solve)(matrices, rights)
    found = found.reshape(*partition.members.shape, 9)
    # cameras and places in clusters name each other; padding writes where nobody reads
    return jnp.zeros_like(padded).at[partition.members].set(found)[:-1]


def cluster_matrices(
    layout: Layout, linear: Linearization, points: PointSystem, system: CameraSystem, partition: Partition
) -> Float[Array, "clusters n n"]:
    """The diagonal blocks of the split system; only their lower triangles are filled."""
    blocks = reduced_blocks(layout, linear, points, system)
    blocks = jnp.concatenate([blocks, jnp.eye(9, dtype=blocks.dtype)[None]])
    clusters, size = partition.members.shape
    table = take_rows(blocks, partition.blocks)
    return table.transpose(0, 1, 3, 2, 4).reshape(clusters, 9 * size, 9 * size)


def repair(
    layout: Layout, linear: Linearization, points: PointSystem, system: CameraSystem, step: Array, rounds: int
) -> Float[Array, "cameras 9"]:
    """Richardson steps `x + B^-1 (b - S x)` on the true system: the error shrinks by the spectral radius of
    `B^-1 E C^-1 E^T`, which is below one."""
    inverse = block_inverse(computed_after(step, system.blocks))
    again = lambda _, x: x + inverse(system.right - apply_reduced(layout, linear, points, system, x))
    return lax.fori_loop(0, rounds, again, step)
