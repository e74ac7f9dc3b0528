"""Groups of cameras that see the same points, for a coarse copy of the reduced camera system.

Clusters grow by merging the two that share most points for their size, many pairs at a time, until few enough are left.
Their system is listed as that of the cameras: a *coarse slot* is one cluster's view of one point.
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
"""Cameras a cluster; larger where that would make more than `MAX_CLUSTERS`. On the real problems at hand 8 took as many
conjugate gradient iterations as 4, and up to half of those with 16 (docs/performance.md)."""

MAX_CLUSTERS = 128
"""1280 coarse unknowns at most: factoring them costs as much as two or three products with a system worth that many."""

MOST_DENSE = 1 << 20
"""Cameras times points up to which one side of the product that counts shared points is dense: in half of the time."""

MAX_PRODUCTS = 2e7
"""Pairs of observations counted to find out which cameras share points; a second's work."""


@register_pytree
@dataclass(frozen=True)
class ClusterLayout:
    """Which cluster a camera belongs to, and how the coarse system is summed."""

    label: Int[AnyArray, " cameras"]
    members: Int[AnyArray, "clusters size"]
    """Cameras of a cluster; the number of cameras in the padding."""

    levels: tuple[Int[AnyArray, "_ _"], ...]
    """Tree from slots to coarse slots, of which the last is empty."""

    point: Int[AnyArray, " coarse"]
    """Column of the point that a coarse slot sees, in layout order; any for the empty one."""

    pairs: PairLayout


def cluster_layout(
    camera: Int[np.ndarray, " observations"],
    point: Int[np.ndarray, " observations"],
    slot: Int[np.ndarray, " observations"],
    cameras: int,
    points: int,
    slot_point: Int[np.ndarray, " slots"],
    empty: int,
) -> ClusterLayout:
    """Clusters of cameras and the pairs of clusters that see one point.

    Args:
        camera: of each observation, sorted by point, then by camera.
        point: of each observation.
        slot: of each observation.
        cameras: number of cameras.
        points: number of points.
        slot_point: column of the point of each slot.
        empty: a slot that holds no observation.
    """
    wanted = max(1, min(MAX_CLUSTERS, cameras // CLUSTER_CAMERAS))
    label = agglomerate(shared_points(camera, point, cameras, points)[0], cameras, wanted)
    clusters = int(label.max()) + 1
    order = sorted_by(label[camera], clusters)
    order = order[sorted_by(point[order], points)]
    names = point[order].astype(np.int64) * clusters + label[camera[order]]
    first = np.flatnonzero(np.diff(names, prepend=-1))
    names, counts = names[first], np.diff(first, append=len(names))
    seen_by = np.bincount(names // clusters, minlength=points)
    start = np.cumsum(seen_by) - seen_by
    coarse = np.arange(len(names))
    return ClusterLayout(
        label=label.astype(np.int32),
        members=cluster_members(label, clusters, int(np.bincount(label).max())),
        levels=sum_tree(slot[order], np.append(counts, 0), empty, fitting_width(counts)),
        point=slot_point[np.append(slot[order][first], empty)],
        pairs=pair_layout(names % clusters, coarse, seen_by, start, clusters, len(names), factor=True, banded=False),
    )


def cluster_members(
    label: Int[np.ndarray, " cameras"], clusters: int, size: int
) -> Int[np.ndarray, "{clusters} {size}"]:
    """The cameras of every cluster in order, then the number of cameras up to a row's `size`."""
    table = np.full((clusters, size), len(label), np.int32)
    order = np.argsort(label, kind="stable")
    counts = np.bincount(label, minlength=clusters)
    table[label[order], np.arange(len(label)) - np.repeat(np.cumsum(counts) - counts, counts)] = order
    return table


def shared_points(
    camera: Int[np.ndarray, " observations"], point: Int[np.ndarray, " observations"], cameras: int, points: int
) -> tuple[csr_matrix, Float[np.ndarray, " cameras"]]:
    """How many points each pair of cameras shares, [cameras, cameras] without its diagonal, and how many each sees."""
    kept = np.ones(len(point), bool)
    work = float(np.sum(np.bincount(point).astype(float) ** 2))
    if work > MAX_PRODUCTS:  # a sample of the points says as much
        kept = point % int(-(-work // MAX_PRODUCTS)) == 0
    seen = csr_matrix((np.ones(kept.sum(), np.float32), (camera[kept], point[kept])), shape=(cameras, points))
    few = cameras * points <= MOST_DENSE
    shared = csr_matrix(seen @ seen.T.toarray()) if few else (seen @ seen.T).tocsr()
    own = shared.diagonal().astype(float)
    shared.setdiag(0)
    shared.eliminate_zeros()
    return shared, own


def agglomerate(shared: csr_matrix, nodes: int, clusters: int) -> Int[np.ndarray, " nodes"]:
    """Labels from 0 for at most `clusters` groups of `nodes` nodes, given what each two share.

    In every round each group names the group with which it shares most, per product of their sizes; those who name each
    other merge. What nothing connects is thrown together at the end.
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
