"""A two-level preconditioner whose coarse space is the motion of clusters of cameras.

    M^-1 = D^-1 + P (P^T S P)^-1 P^T,    D = the block diagonal of S.

Conjugate gradients are slow on long sequences because of smooth deformations with small
eigenvalues: neighbouring cameras and their points move together, and residuals hardly change. P
spans such motions with seven columns per cluster for a similarity (rotation a, translation b, scale
s), and one for a common change of each number of the lenses. All clusters that share a lens have
the columns of its numbers in common, and those with cameras of one frame their motion: P is in the
range of T (structure/unknowns.py).

A similarity of cameras and points together changes no pixel, so that `J_c P = -J_p [a x X, b, s
X]`: the columns of `S P` follow from the point Jacobians. Where poses are constant, frames have
offsets or there are other residuals, this does not hold, and they are computed from the camera
Jacobians.

Source: additive two-level Schwarz with a Nicolaides coarse space (Toselli and Widlund 2005, section
3); Jian, Balcan and Dellaert 2011 and Kushal and Agarwal 2012 precondition the same system with
subgraphs and clusters instead."""

from __future__ import annotations

from collections.abc import Callable

import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from jaxba.linear.cholesky import factor_panels
from jaxba.linear.formed import dense_blocks, pair_products
from jaxba.linear.schur import DampedSystem, coupling_rows
from jaxba.problem.intrinsics import POSE_SIZE
from jaxba.rotations import rotation_matrix
from jaxba.runtime.fusion import compute_unfused
from jaxba.structure.camera_clusters import ClusterLayout
from jaxba.structure.devices import sum_over_devices
from jaxba.structure.layout import Layout
from jaxba.structure.segment_sums import as_rows, take_each, take_rows, tree_sum
from jaxba.structure.sharing import Sharing

SIMILARITY = 7  # columns of a similarity; those of the numbers of lenses follow
# machine epsilons per unknown added to the diagonal, singular for clusters of one camera
SHIFT = 64.0
# columns of a panel of the coarse factor: with 1280 unknowns as fast as 128, compiled sooner
COARSE_PANEL = 256


def camera_modes(
    layout: Layout, cameras: Float[Array, "parameters cameras"], width: int
) -> Float[Array, "cameras width modes"]:
    """P: the step of each camera for a motion of its cluster, in manifold coordinates; zero for
    unseen cameras.

    For the similarity `X <- (1 + s) (exp(a) X + b)` of the world, the camera step that keeps all
    projections is `-R a` for the rotation and `-R b + s t` for the translation."""
    minus_rotation = -jnp.moveaxis(rotation_matrix(cameras[:3]), -1, 0)
    count = minus_rotation.shape[0]
    numbers = width - POSE_SIZE

    def zeros(*shape):
        return jnp.zeros((count, *shape), minus_rotation.dtype)

    rotation = jnp.concatenate([minus_rotation, zeros(3, 4 + numbers)], axis=2)
    translation = jnp.concatenate(
        [zeros(3, 3), minus_rotation, cameras[3:6].T[:, :, None], zeros(3, numbers)], axis=2
    )
    lens = jnp.eye(numbers, SIMILARITY + numbers, SIMILARITY, dtype=minus_rotation.dtype)
    lens = jnp.broadcast_to(lens, (count, *lens.shape))
    modes = jnp.concatenate([rotation, translation, lens], axis=1)
    return jnp.where(layout.camera_seen[:, None, None], modes, jnp.zeros_like(modes))


def coarse_preconditioner(system: DampedSystem) -> Callable[[Array], Array]:
    """The product with `P (P^T S P)^-1 P^T`; zero if the coarse system is not positive definite."""
    clusters = system.layout.part("clusters")
    modes = camera_modes(system.layout, system.parameters[0], system.cameras.blocks.shape[-1])
    sizes = [SIMILARITY, *(size for _, size in system.layout.unknowns.parts[1:])]
    tied = Sharing.joined(*zip(clusters.ties, sizes, strict=True))
    matrix = tied.merged(coarse_system(system, modes))
    diagonal = jnp.diagonal(matrix)
    scale = jnp.where(diagonal > 0, 1 / jnp.sqrt(jnp.where(diagonal > 0, diagonal, 1)), 0)
    unknowns = matrix.shape[0]
    shift = jnp.where(diagonal > 0, SHIFT * unknowns * float(jnp.finfo(matrix.dtype).eps), 1.0)
    scaled = matrix * scale[:, None] * scale + jnp.diag(shift)
    panels = factor_panels(scaled, COARSE_PANEL)
    # a failed panel makes all later ones non-finite
    valid = jnp.isfinite(panels.inverses[-1]).all()

    def apply(r: Array) -> Array:
        inner = cluster_sum(clusters, jnp.einsum("cam,ca->cm", modes, r))
        coarse = scale * panels.solve(scale * tied.total(inner.reshape(-1)))
        coarse = tied.copied(jnp.where(valid, coarse, jnp.zeros_like(coarse))).reshape(inner.shape)
        return jnp.einsum("cam,cm->ca", modes, take_rows(coarse, clusters.label))

    return apply


def coarse_system(
    system: DampedSystem, modes: Float[Array, "cameras width modes"]
) -> Float[Array, "unknowns unknowns"]:
    """The lower triangle of `P^T S P = P^T (B + D_c) P - sum (P^T Y) (P^T Y)^T`, in blocks of
    clusters."""
    clusters = system.layout.part("clusters")
    count = modes.shape[-1]
    layout = system.layout
    unknowns = system.layout.unknowns
    # whether a similarity of cameras and points changes no residual, cluster by cluster
    similar = unknowns.free.everywhere and not unknowns.in_rigs and not layout.residuals
    coupling = _similar_rows(system) if similar else _coupling_rows(system, modes)
    shared = sum_over_devices(layout, pair_products(clusters.pairs, coupling, count))
    own = jnp.einsum("cam,cab,cbn->cmn", modes, system.cameras.blocks, modes).reshape(-1, count**2)
    own = cluster_sum(clusters, own)
    own = jnp.concatenate([own, jnp.zeros((1, count**2), own.dtype)])
    blocks = take_rows(own, clusters.pairs.block_camera) - shared
    return dense_blocks(clusters.pairs, blocks.reshape(-1, count, count))


def cluster_sum(
    clusters: ClusterLayout, rows: Float[Array, "cameras k"]
) -> Float[Array, "clusters k"]:
    """The sum of the rows of each cluster's cameras."""
    padded = jnp.concatenate([rows, jnp.zeros((1, rows.shape[1]), rows.dtype)])
    return jnp.sum(take_rows(padded, clusters.members), axis=1)


def _coupling_rows(
    system: DampedSystem, modes: Float[Array, "cameras width modes"]
) -> Float[Array, "coarse rows"]:
    """`P^T Y`, transposed and flattened, summed over the observations of each point by each
    cluster."""
    motions = modes[:, :POSE_SIZE, :SIMILARITY]
    at_slot = take_rows(motions.reshape(len(motions), -1), system.layout.slot_camera).reshape(
        -1, *motions.shape[1:]
    )
    coupling = coupling_rows(system).reshape(-1, 3, modes.shape[1])
    moved = jnp.einsum("nia,nam->nim", coupling[:, :, :POSE_SIZE], at_slot)
    rows = jnp.concatenate([moved, coupling[:, :, POSE_SIZE:]], axis=2)
    return tree_sum(rows.reshape(-1, 3 * modes.shape[2]), system.layout.part("clusters").levels)


def _similar_rows(system: DampedSystem) -> Float[Array, "coarse rows"]:
    """The same where modes change no residual, `J_c P = -J_p [a x X, b, s X]`. The observations
    have the point X in common, so that only `J_p^T Q` and the columns of the lenses are summed."""
    clusters = system.layout.part("clusters")
    linear = system.linear
    over, under = system.points.projected
    (first, second) = linear.point_jacobian
    (high, low) = linear.camera_jacobian
    moved = [[first[k] * over[i] + second[k] * under[i] for k in range(3)] for i in range(3)]
    numbers = range(POSE_SIZE, len(high))
    lens = [[high[k] * over[i] + low[k] * under[i] for k in numbers] for i in range(3)]
    columns = [column for i in range(3) for column in moved[i] + lens[i]]
    sums = compute_unfused(
        lambda rows: tree_sum(rows, clusters.levels), as_rows(columns), index=clusters.point
    ).T
    x, y, z = take_each(system.parameters[1], clusters.point)
    rows = []
    for i in range(3):
        p, q, r, *own = sums.reshape(3, -1, sums.shape[-1])[i]
        rows += [
            q * z - r * y,
            r * x - p * z,
            p * y - q * x,
            -p,
            -q,
            -r,
            -(p * x + q * y + r * z),
            *own,
        ]
    return as_rows(rows)
