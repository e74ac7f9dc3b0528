"""Random clusterings of the camera graph, a new one every iteration.

Cameras are nodes, and the weight of an edge is the share of points that both cameras see among those that either sees.
A clustering grows as in Louvain's method, but a node picks the community it joins at random, the better ones more
likely, and edges that the clustering before cut are likely to be kept this time.

Source: Zhou et al. 2020, "Stochastic Bundle Adjustment for Efficient and Scalable 3D Reconstruction", section 3.3, and
the authors' code. Here all nodes choose at once and then move one after the other, so that choosing is a few array
operations; the original lets each node see the moves before its own.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from jaxtyping import Int
from scipy.sparse import csr_matrix

from jaxba.structure.camera_clusters import shared_points

TEMPERATURE = 10.0
"""Inverse temperature of the choice; larger is greedier. Source: the authors' code."""

MAX_PASSES = 30
"""Passes of one clustering; each halves the number of communities or nearly so, and 5 to 8 are usual."""


def camera_graph(
    camera: Int[np.ndarray, " observations"], point: Int[np.ndarray, " observations"], cameras: int, points: int
) -> csr_matrix:
    """Weights `|P_i and P_j| / |P_i or P_j|` of the pairs of cameras that share points, [cameras, cameras].

    Of a large problem a sample of the points is counted (`clusters.shared_points`).
    """
    shared, seen = shared_points(camera, point, cameras, points)
    edges = shared.tocoo()
    weight = edges.data / (seen[edges.row] + seen[edges.col] - edges.data)
    return csr_matrix((weight.astype(float), (edges.row, edges.col)), shape=(cameras, cameras))


def clusterings(graph: csr_matrix, largest: int, rng: np.random.Generator) -> Iterator[Int[np.ndarray, " cameras"]]:
    """Clusterings without end: labels from 0 for every camera.

    Args:
        graph: symmetric weights without a diagonal.
        largest: cameras of a cluster at most.
        rng: decides all of them.
    """
    label = cluster(graph, largest, None, None)  # Louvain's own, greedy
    while True:
        label = cluster(graph, largest, label, rng)
        yield label


def cluster(
    graph: csr_matrix,
    largest: int,
    previous: Int[np.ndarray, " cameras"] | None,
    rng: np.random.Generator | None,
) -> Int[np.ndarray, " cameras"]:
    """One clustering.

    Args:
        graph: symmetric weights without a diagonal.
        largest: cameras of a cluster at most.
        previous: the clustering before, whose cut edges are joined first; None for no such preference.
        rng: for a random choice; None for the best one.
    """
    nodes, edges = len(graph.indptr) - 1, graph.nnz / 2
    degree = np.asarray(graph.sum(axis=1)).ravel()
    total = max(float(degree.sum()), np.finfo(float).tiny)
    label, weight, size = np.arange(nodes), graph, np.ones(nodes, int)
    if previous is not None and largest > 1:
        label, weight, degree, size = _collapse(_matching(graph, previous), label, weight, degree, size)
    for _ in range(MAX_PASSES):
        factor = (len(size) + weight.nnz / 2) / max(nodes + edges, 1)
        into = _pass(weight, degree, size, total, TEMPERATURE * factor, largest, rng)
        if np.array_equal(into, np.arange(len(into))):
            break
        label, weight, degree, size = _collapse(into, label, weight, degree, size)
    # cameras that share points with nobody need no cluster each
    alone = np.diff(graph.indptr) == 0
    label = np.where(alone, nodes + np.cumsum(alone) // max(largest, 1), label)
    return np.unique(label, return_inverse=True)[1]


def _matching(graph: csr_matrix, label: np.ndarray) -> np.ndarray:
    """Pairs of cameras whose edge was cut, the heaviest edges first, each camera once."""
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
    """The community that every node joins, by the number of the node it started from.

    The gain in modularity decides: the weight towards a neighbour less what the degrees alone would let expect.
    """
    nodes = len(size)
    row, column = np.repeat(np.arange(nodes), np.diff(weight.indptr)), weight.indices
    gain = sharpness * (weight.data - degree[column] * degree[row] / total)
    stay = np.zeros(nodes)
    if rng is not None:  # the largest of Gumbel-perturbed logits is a draw from their softmax
        gain, stay = gain + rng.gumbel(size=len(gain)), rng.gumbel(size=nodes)
    gain[size[row] + size[column] > largest] = -np.inf
    choosing = np.flatnonzero(np.diff(weight.indptr) > 0)
    if not len(choosing):
        return np.arange(nodes)
    best = np.maximum.reduceat(gain, weight.indptr[choosing])
    is_best = np.flatnonzero(gain == np.repeat(best, np.diff(weight.indptr)[choosing]))
    first = is_best[np.unique(row[is_best], return_index=True)[1]]
    moving = best > stay[choosing]
    into, members, joined = list(range(nodes)), size.tolist(), [False] * nodes
    sizes = size.tolist()
    for node, target in zip(choosing[moving].tolist(), column[first][moving].tolist(), strict=True):
        # a node that others have joined stays, and nobody joins where the node itself has left
        if joined[node] or into[target] != target or members[target] + sizes[node] > largest:
            continue
        into[node], joined[target] = target, True
        members[target] += sizes[node]
    return np.array(into, int)


def _collapse(
    into: np.ndarray, label: np.ndarray, weight: csr_matrix, degree: np.ndarray, size: np.ndarray
) -> tuple[np.ndarray, csr_matrix, np.ndarray, np.ndarray]:
    """Makes every community one node."""
    kept, new = np.unique(into, return_inverse=True)
    merge = csr_matrix((np.ones(len(into)), (np.arange(len(into)), new)), shape=(len(into), len(kept)))
    edges = (merge.T @ weight @ merge).tocoo()
    cut = edges.row != edges.col
    weight = csr_matrix((edges.data[cut], (edges.row[cut], edges.col[cut])), shape=edges.shape)
    count = lambda x: np.bincount(new, weights=x, minlength=len(kept))
    return new[label], weight, count(degree), count(size).astype(int)
