"""A two-level preconditioner whose coarse space is the motion of whole clusters of cameras.

What makes conjugate gradients slow on a long sequence are its smooth, nearly free deformations: neighbouring cameras
move as one, points with them, and hardly any residual changes. Such motions are spanned by one similarity (rotation,
translation, scale) for each cluster of cameras, to which a common change of focal length and distortion is added. With
their ten columns per cluster in P, the preconditioner is `M^-1 = D^-1 + P (P^T S P)^-1 P^T`, D the block diagonal of S.

A similarity moves cameras and points together without changing a residual, so that `J_c P = -J_p [a x X, b, s X]`:
the columns of S P come from the point Jacobians, no camera is differentiated anew.

Source: additive two-level Schwarz with a Nicolaides coarse space (Toselli and Widlund 2005, section 3); Jian, Balcan
and Dellaert 2011 and Kushal and Agarwal 2012 precondition the same system with subgraphs and clusters instead.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from jaxba.linear.blocks import dense_blocks, pair_products
from jaxba.linear.cholesky import factor_panels
from jaxba.linear.schur import CameraSystem, PointSystem
from jaxba.model.linearize import Linearization
from jaxba.runtime.fusion import compute_unfused
from jaxba.structure.camera_clusters import ClusterLayout
from jaxba.structure.layout import Layout
from jaxba.structure.segment_sums import as_rows, take_each, take_rows, tree_sum

MODES = 10
"""Seven of a similarity, then focal length, k1 and k2."""

SHIFT = 64.0
"""Rounding units per coarse unknown added to the scaled diagonal: a cluster of one camera has nine unknowns only."""


COARSE_PANEL = 256
"""Columns of a panel of the coarse system's factor: with 1280 unknowns a step took as long as with panels of 128,
within 2%, and a second less to compile."""


class Anchor(NamedTuple):
    """Where the cameras and points are, for the directions of the modes."""

    rotation: Float[Array, "3 3 cameras"]
    translation: Float[Array, "3 cameras"]
    points: Float[Array, "3 points"]


def camera_modes(layout: Layout, anchor: Anchor) -> Float[Array, "cameras 9 10"]:
    """P: how each camera follows a motion of its cluster, in manifold coordinates; zero for unseen cameras.

    The world moves by `X <- exp(a) X + b`, then grows by `1 + s`; a camera that follows turns by `-R a` and shifts by
    `-R b + s t`.
    """
    turned = -jnp.moveaxis(anchor.rotation, -1, 0)
    count = turned.shape[0]
    zero = lambda *shape: jnp.zeros((count, *shape), turned.dtype)
    rotation = jnp.concatenate([turned, zero(3, 7)], axis=2)
    translation = jnp.concatenate([zero(3, 3), turned, anchor.translation.T[:, :, None], zero(3, 3)], axis=2)
    lens = jnp.broadcast_to(jnp.eye(3, MODES, 7, dtype=turned.dtype), (count, 3, MODES))
    modes = jnp.concatenate([rotation, translation, lens], axis=1)
    return jnp.where(layout.camera_seen[:, None, None], modes, jnp.zeros_like(modes))


def coarse_preconditioner(
    layout: Layout, linear: Linearization, points: PointSystem, system: CameraSystem, anchor: Anchor
) -> Callable[[Array], Array]:
    """`P (P^T S P)^-1 P^T`; zero where the coarse system is not positive definite."""
    clusters = _clusters(layout)
    modes = camera_modes(layout, anchor)
    matrix = coarse_system(layout, linear, points, system, anchor, modes)
    diagonal = jnp.diagonal(matrix)
    scale = jnp.where(diagonal > 0, 1 / jnp.sqrt(jnp.where(diagonal > 0, diagonal, 1)), 0)
    unknowns = matrix.shape[0]
    shift = jnp.where(diagonal > 0, SHIFT * unknowns * float(jnp.finfo(matrix.dtype).eps), 1.0)
    scaled = matrix * scale[:, None] * scale + jnp.diag(shift)
    panels = factor_panels(scaled, COARSE_PANEL)
    found = jnp.isfinite(panels.inverses[-1]).all()  # what fails in one panel spoils all later ones

    def apply(r: Array) -> Array:
        inner = cluster_sum(clusters, jnp.einsum("cam,ca->cm", modes, r))
        moved = scale * panels.solve(scale * inner.reshape(-1))
        moved = jnp.where(found, moved, jnp.zeros_like(moved)).reshape(-1, MODES)
        return jnp.einsum("cam,cm->ca", modes, take_rows(moved, clusters.label))

    return apply


def coarse_system(
    layout: Layout,
    linear: Linearization,
    points: PointSystem,
    system: CameraSystem,
    anchor: Anchor,
    modes: Float[Array, "cameras 9 10"],
) -> Float[Array, "unknowns unknowns"]:
    """The lower triangle of `P^T S P`, by clusters: `P^T B P` less the products of what clusters share by points."""
    clusters = _clusters(layout)
    shared = pair_products(clusters.pairs, _shared_rows(layout, linear, points, anchor.points), MODES)
    own = jnp.einsum("cam,cab,cbn->cmn", modes, system.blocks, modes).reshape(-1, MODES * MODES)
    own = cluster_sum(clusters, own)
    own = jnp.concatenate([own, jnp.zeros((1, MODES * MODES), own.dtype)])
    blocks = take_rows(own, clusters.pairs.block_camera) - shared
    return dense_blocks(clusters.pairs, blocks, MODES)


def cluster_sum(clusters: ClusterLayout, rows: Float[Array, "cameras k"]) -> Float[Array, "clusters k"]:
    """Sums the rows of each cluster's cameras."""
    padded = jnp.concatenate([rows, jnp.zeros((1, rows.shape[1]), rows.dtype)])
    return jnp.sum(take_rows(padded, clusters.members), axis=1)


def _shared_rows(
    layout: Layout, linear: Linearization, points: PointSystem, positions: Float[Array, "3 points"]
) -> Float[Array, "coarse 30"]:
    """`(J_c P)^T Q` summed over each cluster's view of each point, the point's index slow and the mode's fast.

    All slots of one view share the point, so that only `J_p^T Q` and the lens columns are summed over slots.
    """
    clusters = _clusters(layout)
    over, under = points.projected
    (first, second), (high, low) = linear.point_jacobian, linear.camera_jacobian
    moved = [[first[k] * over[i] + second[k] * under[i] for k in range(3)] for i in range(3)]
    lens = [[high[6 + k] * over[i] + low[6 + k] * under[i] for k in range(3)] for i in range(3)]
    columns = [column for i in range(3) for column in moved[i] + lens[i]]
    sums = compute_unfused(lambda rows: tree_sum(rows, clusters.levels), as_rows(columns), index=clusters.point).T
    x, y, z = take_each(positions, clusters.point)
    rows = []
    for i in range(3):
        p, q, r, *own = sums[6 * i : 6 * i + 6]
        rows += [q * z - r * y, r * x - p * z, p * y - q * x, -p, -q, -r, -(p * x + q * y + r * z), *own]
    return as_rows(rows)


def _clusters(layout: Layout) -> ClusterLayout:
    if layout.clusters is None:
        raise ValueError("this layout has no clusters: build it with clusters=True for the two-level preconditioner")
    return layout.clusters
