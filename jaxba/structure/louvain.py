"""Random clusterings of the camera graph, by a randomised Louvain method.

Cameras are nodes. The weight of an edge is the number of points that both cameras see over the
number that either sees. As in Louvain's method, nodes join the community of a neighbour pass by
pass, but each chooses at random, with a softmax over the gains in modularity. Edges that the
previous clustering cut are contracted first, so that they are likely to be inside a cluster this
time.

Source: Zhou et al. 2020, "Stochastic Bundle Adjustment for Efficient and Scalable 3D
Reconstruction", section 3.3, and the authors' code. Here all nodes of a pass choose before any of
them moves, so that choosing takes a few array operations; in the original each node sees the moves
before its own."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from jaxtyping import Int
from scipy.sparse import csr_matrix

from jaxba.structure.agglomeration import shared_points

# inverse temperature of the softmax; larger is greedier. Source: the authors' code.
TEMPERATURE = 10.0
# most passes of one clustering. Each about halves the number of communities; 5 to 8 are usual.
MAX_PASSES = 30


def camera_graph(
    camera: Int[np.ndarray, " observations"],
    point: Int[np.ndarray, " observations"],
    cameras: int,
    points: int,
) -> csr_matrix:
    """Edge weights `|P_i and P_j| / |P_i or P_j|` for the sets P_i of points that camera i sees,
    [cameras, cameras].

    For a large problem they are estimated from a sample of the points
    (`agglomeration.shared_points`)."""
    shared, seen = shared_points(camera, point, cameras, points)
    edges = shared.tocoo()
    weight = edges.data / (seen[edges.row] + seen[edges.col] - edges.data)
    return csr_matrix((weight.astype(float), (edges.row, edges.col)), shape=(cameras, cameras))


def clusterings(
    graph: csr_matrix, largest: int, rng: np.random.Generator
) -> Iterator[Int[np.ndarray, " cameras"]]:
    """An endless sequence of clusterings: the cluster of every camera, numbered from 0. The graph
    has symmetric edge weights without a diagonal; `largest` is the largest number of cameras in a
    cluster."""
    label = cluster(graph, largest, None, None)  # the greedy Louvain method
    while True:
        label = cluster(graph, largest, label, rng)
        yield label


def cluster(
    graph: csr_matrix,
    largest: int,
    previous: Int[np.ndarray, " cameras"] | None,
    rng: np.random.Generator | None,
) -> Int[np.ndarray, " cameras"]:
    """One clustering: the cluster of every camera, numbered from 0. Arguments as for `clusterings`;
    the cut edges of the previous clustering are contracted first (None: no such preference), and
    without `rng` choices are greedy."""
    nodes = len(graph.indptr) - 1
    edges = graph.nnz / 2
    degree = np.asarray(graph.sum(axis=1)).ravel()
    total = max(float(degree.sum()), np.finfo(float).tiny)
    label = np.arange(nodes)
    weight = graph
    size = np.ones(nodes, int)
    if previous is not None and largest > 1:
        label, weight, degree, size = _collapse(
            _matching(graph, previous), label, weight, degree, size
        )
    for _ in range(MAX_PASSES):
        factor = (len(size) + weight.nnz / 2) / max(nodes + edges, 1)
        into = _pass(weight, degree, size, total, TEMPERATURE * factor, largest, rng)
        if np.array_equal(into, np.arange(len(into))):
            break
        label, weight, degree, size = _collapse(into, label, weight, degree, size)
    # cameras without edges are put together into as few clusters as possible
    alone = np.diff(graph.indptr) == 0
    label = np.where(alone, nodes + np.cumsum(alone) // max(largest, 1), label)
    return np.unique(label, return_inverse=True)[1]


def _matching(graph: csr_matrix, label: np.ndarray) -> np.ndarray:
    """Greedy matching of the edges cut by a clustering, heaviest first: the node that every node is
    merged into."""
    edges = graph.tocoo()
    cut = np.flatnonzero((edges.row < edges.col) & (label[edges.row] != label[edges.col]))
    cut = cut[np.argsort(-np.asarray(edges.data, float)[cut], kind="stable")]
    into = list(range(len(label)))
    free = [True] * len(label)
    for one, other in zip(edges.row[cut].tolist(), edges.col[cut].tolist(), strict=True):
        if free[one] and free[other]:
            free[one] = free[other] = False
            into[other] = one
    return np.array(into, int)


def _pass(
    weight: csr_matrix,
    degree: np.ndarray,
    size: np.ndarray,
    total: float,
    sharpness: float,
    largest: int,
    rng: np.random.Generator | None,
) -> np.ndarray:
    """One pass: the community that every node joins, as the index of the node that founded it.

    Nodes choose by the gain in modularity: the weight of the edge minus its expectation from the
    degrees."""
    nodes = len(size)
    row = np.repeat(np.arange(nodes), np.diff(weight.indptr))
    column = weight.indices
    gain = sharpness * (weight.data - degree[column] * degree[row] / total)
    stay = np.zeros(nodes)
    if rng is not None:  # Gumbel-max trick: the argmax is a sample of the softmax
        gain = gain + rng.gumbel(size=len(gain))
        stay = rng.gumbel(size=nodes)
    gain[size[row] + size[column] > largest] = -np.inf
    choosing = np.flatnonzero(np.diff(weight.indptr) > 0)
    if not len(choosing):
        return np.arange(nodes)
    best = np.maximum.reduceat(gain, weight.indptr[choosing])
    is_best = np.flatnonzero(gain == np.repeat(best, np.diff(weight.indptr)[choosing]))
    first = is_best[np.unique(row[is_best], return_index=True)[1]]
    moving = best > stay[choosing]
    into = list(range(nodes))
    members = size.tolist()
    joined = [False] * nodes
    sizes = size.tolist()
    for node, target in zip(choosing[moving].tolist(), column[first][moving].tolist(), strict=True):
        # a node that others have joined stays, and a node that has left its community cannot be
        # joined
        if joined[node] or into[target] != target or members[target] + sizes[node] > largest:
            continue
        into[node], joined[target] = target, True
        members[target] += sizes[node]
    return np.array(into, int)


def _collapse(
    into: np.ndarray, label: np.ndarray, weight: csr_matrix, degree: np.ndarray, size: np.ndarray
) -> tuple[np.ndarray, csr_matrix, np.ndarray, np.ndarray]:
    """Contracts every community to one node."""
    kept, new = np.unique(into, return_inverse=True)
    merge = csr_matrix(
        (np.ones(len(into)), (np.arange(len(into)), new)), shape=(len(into), len(kept))
    )
    edges = (merge.T @ weight @ merge).tocoo()
    cut = edges.row != edges.col
    weight = csr_matrix((edges.data[cut], (edges.row[cut], edges.col[cut])), shape=edges.shape)

    def count(x):
        return np.bincount(new, weights=x, minlength=len(kept))

    return new[label], weight, count(degree), count(size).astype(int)
