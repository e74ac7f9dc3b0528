"""Clusters of cameras that see the same points, for the coarse system of the two-level preconditioner.

Agglomerative clustering: pairs of clusters with many common points for their size are merged, many pairs at a time,
until few enough clusters are left. The coarse system is formed like the reduced camera system, with clusters in place
of cameras: a *coarse slot* stands for all observations of one point by one cluster.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import csr_matrix

from jaxba.structure.covisibility import PairLayout, pair_layout
from jaxba.structure.sum_trees import fitting_width, sorted_by, sum_tree
from jaxba.typing import AnyArray, register_pytree

CLUSTER_CAMERAS = 8
"""Cameras per cluster, unless that makes more than `MAX_CLUSTERS`. Measured on real problems: as many conjugate
gradient iterations as with 4, and down to half of those with 16."""

MAX_CLUSTERS = 128
"""At most 1280 coarse unknowns. Factoring these costs as much as two or three products with a system of that many
clusters."""

MAX_DENSE_ENTRIES = 1 << 20
"""Cameras times points up to which common points are counted by a sparse-dense product, which takes half the time."""

MAX_PRODUCTS = 2e7
"""Most pairs of observations that are counted to find common points; a second's work."""


@register_pytree
@dataclass(frozen=True)
class ClusterLayout:
    """The cluster of each camera, and the index arrays that form the coarse system."""

    label: Int[AnyArray, " cameras"]
    """Cluster of each camera."""

    members: Int[AnyArray, "clusters size"]
    """Cameras of a cluster; the number of cameras in the padding."""

    levels: tuple[Int[AnyArray, "_ _"], ...]
    """Summation tree from slots to coarse slots, of which the last is empty."""

    point: Int[AnyArray, " coarse"]
    """Point of each coarse slot, in layout order; arbitrary for the empty one."""

    pairs: PairLayout
    """Pairs of coarse slots of one point, which form the blocks of the coarse system."""


def cluster_layout(
    camera: Int[np.ndarray, " observations"],
    point: Int[np.ndarray, " observations"],
    slot: Int[np.ndarray, " observations"],
    cameras: int,
    points: int,
    slot_point: Int[np.ndarray, " slots"],
    empty: int,
) -> ClusterLayout:
    """Clusters the cameras and lists the pairs of clusters with common points.

    Args:
        camera: camera of each observation; observations are sorted by point, then by camera.
        point: point of each observation.
        slot: slot of each observation.
        cameras: number of cameras.
        points: number of points.
        slot_point: point of each slot, in layout order.
        empty: an empty slot.
    """
    num_clusters = max(1, min(MAX_CLUSTERS, cameras // CLUSTER_CAMERAS))
    label = agglomerate(shared_points(camera, point, cameras, points)[0], cameras, num_clusters)
    clusters = int(label.max()) + 1
    order = sorted_by(label[camera], clusters)
    order = order[sorted_by(point[order], points)]
    keys = point[order].astype(np.int64) * clusters + label[camera[order]]
    first = np.flatnonzero(np.diff(keys, prepend=-1))
    keys, counts = keys[first], np.diff(first, append=len(keys))
    seen_by = np.bincount(keys // clusters, minlength=points)
    start = np.cumsum(seen_by) - seen_by
    coarse = np.arange(len(keys))
    return ClusterLayout(
        label=label.astype(np.int32),
        members=cluster_members(label, clusters, int(np.bincount(label).max())),
        levels=sum_tree(slot[order], np.append(counts, 0), empty, fitting_width(counts)),
        point=slot_point[np.append(slot[order][first], empty)],
        pairs=pair_layout(keys % clusters, coarse, seen_by, start, clusters, len(keys), factor=True, banded=False),
    )


def cluster_members(
    label: Int[np.ndarray, " cameras"], clusters: int, size: int
) -> Int[np.ndarray, "{clusters} {size}"]:
    """The cameras of every cluster in order; rows are padded to `size` with the number of cameras."""
    table = np.full((clusters, size), len(label), np.int32)
    order = np.argsort(label, kind="stable")
    counts = np.bincount(label, minlength=clusters)
    table[label[order], np.arange(len(label)) - np.repeat(np.cumsum(counts) - counts, counts)] = order
    return table


def shared_points(
    camera: Int[np.ndarray, " observations"], point: Int[np.ndarray, " observations"], cameras: int, points: int
) -> tuple[csr_matrix, Float[np.ndarray, " cameras"]]:
    """Number of common points of each pair of cameras, without the diagonal, and number of points of each camera."""
    kept = np.ones(len(point), bool)
    work = float(np.sum(np.bincount(point).astype(float) ** 2))
    if work > MAX_PRODUCTS:  # a sample of the points is enough
        kept = point % int(-(-work // MAX_PRODUCTS)) == 0
    seen = csr_matrix((np.ones(kept.sum(), np.float32), (camera[kept], point[kept])), shape=(cameras, points))
    few = cameras * points <= MAX_DENSE_ENTRIES
    shared = csr_matrix(seen @ seen.T.toarray()) if few else (seen @ seen.T).tocsr()
    own = shared.diagonal().astype(float)
    shared.setdiag(0)
    shared.eliminate_zeros()
    return shared, own


def agglomerate(shared: csr_matrix, nodes: int, clusters: int) -> Int[np.ndarray, " nodes"]:
    """Agglomerative clustering of a graph.

    In every round each group picks the group with the largest weight between them, divided by the product of their
    sizes, and mutual picks are merged. Groups without common edges are merged arbitrarily at the end.

    Args:
        shared: symmetric edge weights without a diagonal, [nodes, nodes].
        nodes: number of nodes.
        clusters: largest number of groups.

    Returns:
        Label of each node, numbered from 0.
    """
    label, size, weight = np.arange(nodes), np.ones(nodes), shared
    while (groups := len(size)) > clusters:
        degree, column = np.diff(weight.indptr), weight.indices
        row = np.repeat(np.arange(groups), degree)
        best, strength = np.full(groups, -1), np.zeros(groups)
        if len(row):
            affinity = weight.data / (size[row] * size[column])
            begin = weight.indptr[:-1][degree > 0]
            strength[degree > 0] = np.maximum.reduceat(affinity, begin)
            best[degree > 0] = np.minimum.reduceat(np.where(affinity == strength[row], column, groups), begin)
        pair = np.flatnonzero(best >= 0)
        pair = pair[(best[best[pair]] == pair) & (pair < best[pair])]
        if not len(pair):
            label = label * clusters // groups
            break
        pair = pair[np.argsort(-strength[pair], kind="stable")][: groups - clusters]
        into = np.arange(groups)
        into[best[pair]] = pair
        kept, new = np.unique(into, return_inverse=True)
        row, column = new[row], new[column]
        between = row != column
        weight = csr_matrix((weight.data[between], (row[between], column[between])), shape=(len(kept), len(kept)))
        size, label = np.bincount(new, size), new[label]
    return np.unique(label, return_inverse=True)[1]
