"""The graph of cameras with common points as a sparse matrix, and its agglomerative clustering."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components

# cameras times points up to which a sparse-dense product counts in half the time
MAX_DENSE_ENTRIES = 1 << 20
# most pairs of observations that are counted to find common points; a second's work
MAX_PRODUCTS = 2e7


def shared_points(
    camera: Int[np.ndarray, " observations"],
    point: Int[np.ndarray, " observations"],
    cameras: int,
    points: int,
) -> tuple[csr_matrix, Float[np.ndarray, " cameras"]]:
    """Number of common points of each pair of cameras, without the diagonal, and number of points
    of each camera."""
    kept = np.ones(len(point), bool)
    work = float(np.sum(np.bincount(point).astype(float) ** 2))
    if work > MAX_PRODUCTS:  # a sample of the points is enough
        kept = point % int(-(-work // MAX_PRODUCTS)) == 0
    seen = csr_matrix(
        (np.ones(kept.sum(), np.float32), (camera[kept], point[kept])), shape=(cameras, points)
    )
    few = cameras * points <= MAX_DENSE_ENTRIES
    shared = csr_matrix(seen @ seen.T.toarray()) if few else (seen @ seen.T).tocsr()
    own = shared.diagonal().astype(float)
    shared.setdiag(0)
    shared.eliminate_zeros()
    return shared, own


def agglomerate(shared: csr_matrix, nodes: int, clusters: int) -> Int[np.ndarray, " nodes"]:
    """Agglomerative clustering of a graph.

    In every round each group picks the group with the largest weight between them, divided by the
    product of their sizes, and mutual picks are merged. Groups without common edges are merged
    arbitrarily at the end. `shared` are symmetric edge weights without a diagonal, [nodes, nodes],
    and `clusters` is the largest number of groups. Returns the label of each node, numbered from
    0."""
    label = np.arange(nodes)
    size = np.ones(nodes)
    weight = shared
    while (groups := len(size)) > clusters:
        degree = np.diff(weight.indptr)
        column = weight.indices
        row = np.repeat(np.arange(groups), degree)
        best = np.full(groups, -1)
        strength = np.zeros(groups)
        if len(row):
            affinity = weight.data / (size[row] * size[column])
            begin = weight.indptr[:-1][degree > 0]
            strength[degree > 0] = np.maximum.reduceat(affinity, begin)
            best[degree > 0] = np.minimum.reduceat(
                np.where(affinity == strength[row], column, groups), begin
            )
        pair = np.flatnonzero(best >= 0)
        pair = pair[(best[best[pair]] == pair) & (pair < best[pair])]
        if not len(pair):
            label = label * clusters // groups
            break
        pair = pair[np.argsort(-strength[pair], kind="stable")][: groups - clusters]
        into = np.arange(groups)
        into[best[pair]] = pair
        kept, new = np.unique(into, return_inverse=True)
        row = new[row]
        column = new[column]
        between = row != column
        weight = csr_matrix(
            (weight.data[between], (row[between], column[between])), shape=(len(kept), len(kept))
        )
        size = np.bincount(new, size)
        label = new[label]
    return np.unique(label, return_inverse=True)[1]


def joined(
    label: Int[np.ndarray, " nodes"], index: Int[np.ndarray, " nodes"]
) -> Int[np.ndarray, " clusters"]:
    """A name for each cluster, the same for those with nodes of one index, also by way of others: a
    change of all nodes of a name is one of whole indices."""
    has = csr_matrix((np.ones(len(label)), (label, index)))
    return connected_components(has @ has.T, directed=False)[1]
