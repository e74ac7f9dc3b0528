"""Cameras in clusters, points in pieces: the index arrays of methods that solve one cluster at a time.

A *partition* is one clustering of the cameras. What it does to the observations is listed once per problem for a number
of partitions, and iteration `t` takes number `t` modulo that number. So a random clustering costs nothing while
iterating, and the whole solve stays one compiled program.

A point whose observers lie in several clusters is a *separator*; its observations from one cluster are a *copy*.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Int

from jaxba.structure.camera_clusters import cluster_members
from jaxba.structure.covisibility import PairLayout
from jaxba.structure.louvain import camera_graph, clusterings
from jaxba.structure.sum_trees import TREE_WIDTH, sum_tree
from jaxba.typing import AnyArray, register_pytree

PARTITIONS = 16
"""Different partitions of a problem, used in turn."""

SEED = 0
"""Decides the clusterings: the same problem gets the same ones."""


@register_pytree
@dataclass(frozen=True)
class Partition:
    """One clustering, or several of them along a leading axis."""

    label: Int[AnyArray, "*t cameras"]
    """Cluster of each camera."""

    members: Int[AnyArray, "*t clusters size"]
    """Cameras of each cluster in order; the number of cameras in the padding."""

    blocks: Int[AnyArray, "*t clusters size size"]
    """Number in `PairLayout` of the block of two members, lower triangle; the zero block elsewhere, and one past it on
    the diagonal of the padding."""

    copy: Int[AnyArray, "*t slots"]
    """Copy that a slot belongs to; empty slots belong to the last copy, which is nobody's."""

    levels: tuple[Int[AnyArray, "*t _ _"], ...]
    """Tree from slots to copies."""

    separator: Bool[AnyArray, "*t points"]
    """Whether a point, in layout order, is seen from several clusters."""

    def at(self, turn: int | Int[Array, ""]) -> Partition:
        """The partition of an iteration, counted from 0."""
        count = self.label.shape[0]
        arrays = self if isinstance(turn, int) else jax.tree.map(jnp.asarray, self)
        return jax.tree.map(lambda x: x[turn % count], arrays)


def partition_layout(
    camera: Int[np.ndarray, " observations"],
    point: Int[np.ndarray, " observations"],
    slot: Int[np.ndarray, " observations"],
    cameras: int,
    points: int,
    slot_point: Int[np.ndarray, " slots"],
    empty: int,
    pairs: PairLayout,
    largest: int,
    count: int = PARTITIONS,
) -> Partition:
    """Draws partitions of a problem.

    Args:
        camera: of each observation, sorted by point, then by camera.
        point: of each observation.
        slot: of each observation.
        cameras: number of cameras.
        points: number of points.
        slot_point: column of the point of each slot.
        empty: a slot that holds no observation.
        pairs: of the same problem, not banded.
        largest: cameras of a cluster at most.
        count: partitions to draw; one where all cameras fit in a cluster.
    """
    graph = camera_graph(camera, point, cameras, points)
    if cameras <= largest:
        labels = np.zeros((1, cameras), int)
    else:
        drawn = clusterings(graph, largest, np.random.default_rng(SEED))
        labels = np.stack(list(itertools.islice(drawn, count)))
    clusters = int(labels.max()) + 1
    sizes = np.stack([np.bincount(label, minlength=clusters) for label in labels])
    copies = [_copies(label[camera], point, clusters) for label in labels]
    most = max(len(counts) for _, counts in copies) + 1
    trees, of_slot, separator = [], [], []
    for which, counts in copies:
        counts = np.append(counts, np.zeros(most - len(counts), int))
        order = np.argsort(which, kind="stable")
        trees.append(sum_tree(slot[order], counts, empty, TREE_WIDTH))
        of_slot.append(np.full(len(slot_point), most - 1, np.int32))
        of_slot[-1][slot] = which
        first = np.unique(which, return_index=True)[1]
        pieces = np.bincount(slot_point[slot[first]], minlength=int(slot_point.max()) + 1)
        separator.append(pieces > 1)
    tables = [cluster_members(label, clusters, int(sizes.max())) for label in labels]
    return Partition(
        label=labels.astype(np.int32),
        members=np.stack(tables),
        blocks=np.stack([_blocks(table, label, pairs) for table, label in zip(tables, labels, strict=True)]),
        copy=np.stack(of_slot),
        levels=_stack(trees, empty),
        separator=np.stack(separator),
    )


def _copies(label: np.ndarray, point: np.ndarray, clusters: int) -> tuple[np.ndarray, np.ndarray]:
    """The copy of each observation, numbered by point and cluster, and the observations of each copy."""
    _, which, counts = np.unique(point.astype(np.int64) * clusters + label, return_inverse=True, return_counts=True)
    return which, counts


def _blocks(members: np.ndarray, label: np.ndarray, pairs: PairLayout) -> np.ndarray:
    clusters, size = members.shape
    row, column = np.asarray(pairs.block_row)[:-1], np.asarray(pairs.block_column)[:-1]
    zero = len(row)
    place = np.zeros(len(label), int)
    cluster, rank = np.nonzero(members < len(label))
    place[members[cluster, rank]] = rank
    inside = np.flatnonzero(label[row] == label[column])
    table = np.full((clusters, size, size), zero, np.int32)
    table[label[row[inside]], place[row[inside]], place[column[inside]]] = inside
    cluster, rank = np.nonzero(members == len(label))
    table[cluster, rank, rank] = zero + 1
    return table


def _stack(trees: list[tuple[np.ndarray, ...]], empty: int) -> tuple[np.ndarray, ...]:
    """Trees of equal shapes: missing levels hand their rows on, missing rows and columns are empty."""
    depth = max(len(tree) for tree in trees)
    levels = []
    for number in range(depth):
        parts = [_level(tree, number) for tree in trees]
        rows, width = (max(part.shape[axis] for part in parts) for axis in (0, 1))
        table = []
        for tree, part in zip(trees, parts, strict=True):
            below = _level(tree, number - 1).shape[0] - 1 if number else empty
            padded = np.full((rows, width), below, np.int32)
            padded[: part.shape[0], : part.shape[1]] = part
            table.append(padded)
        levels.append(np.stack(table))
    return tuple(levels)


def _level(tree: tuple[np.ndarray, ...], number: int) -> np.ndarray:
    """A level of a tree; past its end the one that changes nothing."""
    return tree[number] if number < len(tree) else np.arange(len(tree[-1]), dtype=np.int32)[:, None]
