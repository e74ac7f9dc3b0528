"""Clusters of cameras that see the same points, for the coarse system of the two-level
preconditioner.

Agglomerative clustering: pairs of clusters with many common points for their size are merged, many
pairs at a time, until few enough clusters are left. The coarse system is formed like the reduced
camera system, with clusters in place of cameras: a *coarse slot* stands for all observations of one
point by one cluster."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Int

from jaxba.structure.agreement import Agreement
from jaxba.structure.covisibility import PairLayout, pair_layout
from jaxba.structure.observation_order import ObservationOrder
from jaxba.structure.sharing import Sharing
from jaxba.structure.sum_trees import fitting_width, sorted_by, sum_tree
from jaxba.structure.track_buckets import Slots
from jaxba.structure.unknowns import Unknowns
from jaxba.typing import AnyArray, register_pytree

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

# or more, for at most `most_clusters`: as many iterations as with 4, down to half of those with 16
CLUSTER_CAMERAS = 8
FEW_CLUSTERS = 128  # that there may be in any case; 1280 coarse unknowns
# cube of coarse unknowns for each observation whose factorisation takes as long as two products
COARSE_WORK = 5e3


@register_pytree
@dataclass(frozen=True)
class ClusterLayout:
    """The cluster of each camera, and the index arrays that form the coarse system."""

    label: Int[AnyArray, " cameras"]  # cluster of each camera
    # cameras of a cluster; the number of cameras in the padding
    members: Int[AnyArray, "clusters size"]
    # summation tree from slots to coarse slots, of which the last is empty
    levels: tuple[Int[AnyArray, "_ _"], ...]
    # point of each coarse slot, in layout order; arbitrary for the empty one
    point: Int[AnyArray, " coarse"]
    # pairs of coarse slots of one point, which form the blocks of the coarse system
    pairs: PairLayout
    # clusters that have unknowns in common, for each of `Unknowns.parts`; they change as one
    ties: tuple[Sharing, ...]


def cluster_layout(
    observations: ObservationOrder, slots: Slots, unknowns: Unknowns, agreement: Agreement
) -> ClusterLayout:
    """Clusters the cameras and lists the pairs of clusters with common points.

    Clusters have whole frames. They are split by shared lenses, unless that makes more than twice
    `most_clusters`. The other shards of a problem (`agreement`) have the same clusters."""
    from jaxba.structure.agglomeration import shared_points  # SciPy: its import takes 0.2 s

    camera = observations.camera
    point = observations.point
    points = len(observations.tracks)
    frame = np.asarray(unknowns.poses.index)
    frames = unknowns.poses.distinct
    shared = agreement.total(
        "shared points", lambda: shared_points(frame[camera], point, frames, points)[0]
    )
    most = most_clusters(agreement.total("observations", lambda: len(camera)))
    label, ties = agreement.once(
        "labels", lambda: _labels(shared, unknowns, observations.num_cameras, most)
    )
    clusters = int(label.max()) + 1
    order = sorted_by(label[camera], clusters)
    order = order[sorted_by(point[order], points)]
    keys = point[order].astype(np.int64) * clusters + label[camera[order]]
    first = np.flatnonzero(np.diff(keys, prepend=-1))
    keys, counts = keys[first], np.diff(first, append=len(keys))
    seen_by = np.bincount(keys // clusters, minlength=points)
    coarse = np.arange(len(keys))
    count = agreement.size("coarse", len(keys))
    width = agreement.size("width", fitting_width(counts))
    counts = np.append(counts, np.zeros(count + 1 - len(keys), counts.dtype))
    first_slots = np.append(slots.slot[order][first], np.full(count + 1 - len(keys), slots.empty))
    keyed = (keys % clusters, coarse, seen_by, clusters, count)
    return ClusterLayout(
        label=label.astype(np.int32),
        members=cluster_members(label, clusters, int(np.bincount(label).max())),
        levels=sum_tree(
            slots.slot[order], counts, slots.empty, width, agreement=agreement.within("slots")
        ),
        point=slots.point[first_slots],
        pairs=pair_layout(*keyed, factor=True, banded=False, agreement=agreement.within("pairs")),
        ties=ties,
    )


def most_clusters(observations: int) -> int:
    """The largest number of clusters of a problem. Measured with 6,000 cameras and 1.3 million
    observations: the last steps take 75 conjugate gradient iterations with 128 clusters, 20 with
    400, 11 with 750."""
    unknowns = (COARSE_WORK * observations) ** (1 / 3)
    return max(FEW_CLUSTERS, round(unknowns / 10))  # of BAL's lenses: SIMILARITY + 3


def _labels(
    shared: csr_matrix, unknowns: Unknowns, cameras: int, most: int
) -> tuple[Int[np.ndarray, " cameras"], tuple[Sharing, ...]]:
    """The cluster of each camera, and which clusters have unknowns in common."""
    from jaxba.structure.agglomeration import agglomerate, joined

    lenses = unknowns.lenses
    num_clusters = max(1, min(most, cameras // CLUSTER_CAMERAS))
    label = agglomerate(shared, unknowns.poses.distinct, num_clusters)[
        np.asarray(unknowns.poses.index)
    ]
    of_lens = np.where(np.isin(lenses.index, lenses.owners), lenses.index, cameras)
    parts, split = np.unique(label * (cameras + 1) + of_lens, return_inverse=True)
    label = split if len(parts) <= 2 * most else label
    return label, tuple(
        Sharing.of(joined(label, np.asarray(sharing.index))) for sharing, _ in unknowns.parts
    )


def cluster_members(
    label: Int[np.ndarray, " cameras"], clusters: int, size: int
) -> Int[np.ndarray, "{clusters} {size}"]:
    """The cameras of every cluster in order; rows are padded to `size` with the number of
    cameras."""
    table = np.full((clusters, size), len(label), np.int32)
    order = np.argsort(label, kind="stable")
    counts = np.bincount(label, minlength=clusters)
    table[label[order], np.arange(len(label)) - np.repeat(np.cumsum(counts) - counts, counts)] = (
        order
    )
    return table
