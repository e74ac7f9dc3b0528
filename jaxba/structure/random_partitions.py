"""Random partitions of the cameras into clusters, for the method STBA (methods/stba.py).

A fixed number of partitions is drawn once per problem, with their index arrays, and iteration t
uses number t modulo that number. Random clusters then cost nothing during the iterations, and the
solve is one compiled program.

A point that is seen from several clusters is a *shared point*. STBA splits it into *point
replicas*, one per cluster, each with the observations of that cluster."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Int

from jaxba.structure.camera_clusters import cluster_members
from jaxba.structure.covisibility import PairLayout
from jaxba.structure.observation_order import ObservationOrder
from jaxba.structure.sum_trees import TREE_WIDTH, Room, sum_tree
from jaxba.structure.track_buckets import Slots
from jaxba.typing import AnyArray, register_pytree

PARTITIONS = 16  # number of partitions of a problem, used cyclically
SEED = 0  # seed of the clusterings; the same problem always gets the same ones


@register_pytree
@dataclass(frozen=True)
class Partition:
    """One partition of the cameras, or several along a leading axis."""

    label: Int[AnyArray, "*t cameras"]  # cluster of each camera
    # cameras of each cluster, in order; padded with the number of cameras
    members: Int[AnyArray, "*t clusters size"]
    # index in `PairLayout` of the block of two members, lower triangle; else that of the zero
    # block, and one past it on the diagonal of the padding
    blocks: Int[AnyArray, "*t clusters size size"]
    # point replica of each slot; the last, without observations, of empty ones
    slot_replica: Int[AnyArray, "*t slots"]
    levels: tuple[Int[AnyArray, "*t _ _"], ...]  # summation tree from slots to point replicas

    def at(self, iteration: int | Int[Array, ""]) -> Partition:
        """The partition of an iteration, counted from 0."""
        count = self.label.shape[0]
        arrays = self if isinstance(iteration, int) else jax.tree.map(jnp.asarray, self)
        return jax.tree.map(lambda x: x[iteration % count], arrays)


def partition_layout(
    observations: ObservationOrder, slots: Slots, pairs: PairLayout, largest: int
) -> Partition:
    """Draws partitions of a problem into clusters of at most `largest` cameras; only one if all
    cameras fit in one cluster. The pairs are not banded."""
    from jaxba.structure.louvain import camera_graph, clusterings  # SciPy: its import takes 0.2 s

    camera = observations.camera
    point = observations.point
    cameras = observations.num_cameras
    labels = np.zeros((1, cameras), int)
    if cameras > largest:
        graph = camera_graph(camera, point, cameras, len(observations.tracks))
        drawn = clusterings(graph, largest, np.random.default_rng(SEED))
        labels = np.stack(list(itertools.islice(drawn, PARTITIONS)))
    clusters = int(labels.max()) + 1
    size = max(int(np.bincount(label).max()) for label in labels)
    tables = [cluster_members(label, clusters, size) for label in labels]
    # replicas of points are numbered by point and cluster
    keys = (point.astype(np.int64) * clusters + label[camera] for label in labels)
    replicas = [np.unique(key, return_inverse=True, return_counts=True)[1:] for key in keys]
    most = max(len(counts) for _, counts in replicas) + 1
    # for trees of equal shapes
    room = Room(len(camera), max(int(counts.max()) for _, counts in replicas))
    trees = []
    slot_replica = np.full((len(labels), len(slots.point)), most - 1, np.int32)
    for number, (which, counts) in enumerate(replicas):
        items = slots.slot[np.argsort(which, kind="stable")]
        trees.append(
            sum_tree(items, np.pad(counts, (0, most - len(counts))), slots.empty, TREE_WIDTH, room)
        )
        slot_replica[number, slots.slot] = which
    return Partition(
        label=labels.astype(np.int32),
        members=np.stack(tables),
        blocks=np.stack(
            [_blocks(table, label, pairs) for table, label in zip(tables, labels, strict=True)]
        ),
        slot_replica=slot_replica,
        levels=tuple(map(np.stack, zip(*trees, strict=True))),
    )


def _blocks(members: np.ndarray, label: np.ndarray, pairs: PairLayout) -> np.ndarray:
    """The array `Partition.blocks` of one clustering."""
    clusters, size = members.shape
    row = np.asarray(pairs.block_row)[:-1]
    column = np.asarray(pairs.block_column)[:-1]
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
