"""Random partitions of the cameras into clusters, for methods that solve one cluster at a time (STBA, DeepLM).

A fixed number of partitions is drawn once per problem, with their index arrays, and iteration t uses number t modulo
that number. Random clusters then cost nothing during the iterations, and the solve is one compiled program.

A point that is seen from several clusters is a *shared point*. STBA splits it into *point replicas*, one per cluster,
each with the observations of that cluster.
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
from jaxba.structure.observation_order import ObservationOrder
from jaxba.structure.sum_trees import TREE_WIDTH, sum_tree
from jaxba.structure.track_buckets import Slots
from jaxba.typing import AnyArray, register_pytree

PARTITIONS = 16
"""Number of partitions of a problem, used cyclically."""

SEED = 0
"""Seed of the clusterings; the same problem always gets the same ones."""


@register_pytree
@dataclass(frozen=True)
class Partition:
    """One partition of the cameras, or several along a leading axis."""

    label: Int[AnyArray, "*t cameras"]
    """Cluster of each camera."""

    members: Int[AnyArray, "*t clusters size"]
    """Cameras of each cluster, in order; padded with the number of cameras."""

    blocks: Int[AnyArray, "*t clusters size size"]
    """Index in `PairLayout` of the block of two members, lower triangle; else that of the zero block, and one past it
    on the diagonal of the padding."""

    slot_replica: Int[AnyArray, "*t slots"]
    """Point replica of each slot; empty slots belong to the last replica, which has no observations."""

    levels: tuple[Int[AnyArray, "*t _ _"], ...]
    """Summation tree from slots to point replicas."""

    is_shared: Bool[AnyArray, "*t points"]
    """Whether a point, in layout order, is seen from several clusters."""

    def at(self, iteration: int | Int[Array, ""]) -> Partition:
        """The partition of an iteration, counted from 0."""
        count = self.label.shape[0]
        arrays = self if isinstance(iteration, int) else jax.tree.map(jnp.asarray, self)
        return jax.tree.map(lambda x: x[iteration % count], arrays)


def partition_layout(
    observations: ObservationOrder, slots: Slots, pairs: PairLayout, largest: int, count: int = PARTITIONS
) -> Partition:
    """Draws partitions of a problem.

    Args:
        observations: of the problem.
        slots: of the observations.
        pairs: pairs of the same problem, not banded.
        largest: largest number of cameras in a cluster.
        count: number of partitions; only one is drawn if all cameras fit in one cluster.
    """
    from jaxba.structure.louvain import camera_graph, clusterings  # SciPy: its import takes 0.2 s

    camera, point, cameras = observations.camera, observations.point, observations.num_cameras
    slot, slot_point, empty = slots.slot, slots.point, slots.empty
    graph = camera_graph(camera, point, cameras, len(observations.tracks))
    if cameras <= largest:
        labels = np.zeros((1, cameras), int)
    else:
        drawn = clusterings(graph, largest, np.random.default_rng(SEED))
        labels = np.stack(list(itertools.islice(drawn, count)))
    clusters = int(labels.max()) + 1
    sizes = np.stack([np.bincount(label, minlength=clusters) for label in labels])
    replicas = [_point_replicas(label[camera], point, clusters) for label in labels]
    most = max(len(counts) for _, counts in replicas) + 1
    trees, slot_replica, is_shared = [], [], []
    for which, counts in replicas:
        counts = np.append(counts, np.zeros(most - len(counts), int))
        order = np.argsort(which, kind="stable")
        trees.append(sum_tree(slot[order], counts, empty, TREE_WIDTH))
        slot_replica.append(np.full(len(slot_point), most - 1, np.int32))
        slot_replica[-1][slot] = which
        first = np.unique(which, return_index=True)[1]
        replicas_of_point = np.bincount(slot_point[slot[first]], minlength=int(slot_point.max()) + 1)
        is_shared.append(replicas_of_point > 1)
    tables = [cluster_members(label, clusters, int(sizes.max())) for label in labels]
    return Partition(
        label=labels.astype(np.int32),
        members=np.stack(tables),
        blocks=np.stack([_blocks(table, label, pairs) for table, label in zip(tables, labels, strict=True)]),
        slot_replica=np.stack(slot_replica),
        levels=_stack(trees, empty),
        is_shared=np.stack(is_shared),
    )


def _point_replicas(label: np.ndarray, point: np.ndarray, clusters: int) -> tuple[np.ndarray, np.ndarray]:
    """The replica of each observation, numbered by point and cluster, and the number of observations of each."""
    _, which, counts = np.unique(point.astype(np.int64) * clusters + label, return_inverse=True, return_counts=True)
    return which, counts


def _blocks(members: np.ndarray, label: np.ndarray, pairs: PairLayout) -> np.ndarray:
    """The array `Partition.blocks` of one clustering."""
    clusters, size = members.shape
    row, column = np.asarray(pairs.block_row)[:-1], np.asarray(pairs.block_column)[:-1]
    zero = len(row)
    position = np.zeros(len(label), int)
    cluster, rank = np.nonzero(members < len(label))
    position[members[cluster, rank]] = rank
    inside = np.flatnonzero(label[row] == label[column])
    table = np.full((clusters, size, size), zero, np.int32)
    table[label[row[inside]], position[row[inside]], position[column[inside]]] = inside
    cluster, rank = np.nonzero(members == len(label))
    table[cluster, rank, rank] = zero + 1
    return table


def _stack(trees: list[tuple[np.ndarray, ...]], empty: int) -> tuple[np.ndarray, ...]:
    """Stacks summation trees, padded to equal shapes: missing levels are identities, missing rows and columns empty."""
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
    """A level of a tree; past the last level an identity."""
    return tree[number] if number < len(tree) else np.arange(len(tree[-1]), dtype=np.int32)[:, None]
