"""Static index arrays that turn a problem's sparse sums into dense ones.

A *slot* holds one observation. Points are put in buckets by track length, in tiles of `n`; a tile of points with
up to `t` observations owns `t x n` slots, so the sum over a point's observations is a dense sum over
`t`. Sums over a camera, or over a block of the reduced camera system, are trees: rows are gathered in
chunks of fixed width that belong to one target, summed densely, and the partial sums again, until one row
a target is left. Nothing is ever scattered. Padding points at a slot without observation, whose values are
exactly zero. Where sizes are padded (structure/padding.py) there are no buckets, and sums over points are trees too.

Everything is made once per problem on the host with vectorised NumPy.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxba.problem.bundle_problem import BundleProblem
from jaxba.problem.options import StepOptions
from jaxba.structure.camera_clusters import ClusterLayout, cluster_layout
from jaxba.structure.covisibility import PairLayout, pair_layout
from jaxba.structure.density import is_dense
from jaxba.structure.observation_order import ObservationOrder
from jaxba.structure.padding import Capacity, room_for
from jaxba.structure.random_partitions import Partition, partition_layout
from jaxba.structure.shared_intrinsics import LensTies, lens_ties
from jaxba.structure.sum_trees import sorted_by, sum_tree, with_spare_row
from jaxba.structure.track_buckets import Bucket, bucket_slots, padded_slots
from jaxba.typing import AnyArray, register_pytree

CAMERA_CHUNK = 8
"""Observations multiplied at once for a camera; the products are written out term by term, so it is a program size."""


@register_pytree
@dataclass(frozen=True)
class Layout:
    """A problem's observations in slot order, and how to sum them."""

    slot_camera: Int[AnyArray, " slots"]
    slot_point: Int[AnyArray, " slots"]
    """Column of the point in layout order."""

    slot_mask: Bool[AnyArray, " slots"]
    """Whether the slot holds an observation."""

    pixels: Float[AnyArray, "2 slots"]
    """Measured pixels; zero in empty slots."""

    whitening: Float[AnyArray, "2 2 slots"] | None
    """`Sigma^(-1/2)` of each observation."""

    bucket_points: tuple[Int[AnyArray, " _"], ...]
    """Problem index of the points of each bucket; padding repeats an index out of range."""

    point_levels: tuple[Int[AnyArray, "_ _"], ...] | None
    """Tree from slots to points where sizes are padded (structure/padding.py); buckets are summed as they stand."""

    camera_levels: tuple[Int[AnyArray, "_ _"], ...]
    """Tree from slots to cameras. The rows of its first level, one after the other, are the *order of the cameras*; an
    empty slot is among them."""

    camera_seen: Bool[AnyArray, " cameras"]
    """Cameras with at least one observation; the others never move."""

    pairs: PairLayout | None
    """None where the reduced camera system is never formed."""

    grid: Int[AnyArray, "points cameras"] | None
    """Slot of each point's view by each camera, an empty one elsewhere: where the reduced camera system is one product
    of dense matrices."""

    clusters: ClusterLayout | None
    """None where nothing asks for a coarse system."""

    partitions: Partition | None
    """Random clusterings, one behind the other; None where no method asks for them."""

    lenses: LensTies | None
    """None where every camera has a lens of its own, all of it free."""

    buckets: tuple[Bucket, ...] = field(metadata={"static": True})
    """Empty where sizes are padded."""

    @property
    def num_slots(self) -> int:
        """Slots, empty ones included."""
        return self.slot_camera.shape[-1]

    @property
    def num_points(self) -> int:
        """Points in layout order, padding included."""
        return sum(members.shape[-1] for members in self.bucket_points)

    @property
    def num_cameras(self) -> int:
        """Cameras, observed or not."""
        return self.camera_seen.shape[-1]


def build_layout(
    problem: BundleProblem,
    *,
    pairs: bool = True,
    factor: bool = True,
    clusters: bool = False,
    grid: bool = True,
    partitions: int | None = None,
    capacity: Capacity | None = None,
    lenses: bool = True,
    observations: ObservationOrder | None = None,
) -> Layout:
    """Sorts a problem's observations into slots.

    Args:
        problem: a checked problem; host arrays.
        pairs: whether to list the pairs that form the explicit reduced camera system. Their number is
            the sum of t (t + 1) / 2 over track lengths t.
        factor: whether that system will be factored, which takes a table of its blocks, dense or banded.
        clusters: whether to group cameras for the two-level preconditioner.
        grid: whether a factored system may be formed as one dense product, where nearly all cameras see nearly all
            points; pairs are not listed then.
        partitions: cameras of a cluster at most, to draw random partitions of the cameras; needs pairs.
        capacity: pads all sizes, for a system that is factored: no clusters, no partitions. Where the system is a band,
            it is factored dense all the same.
        lenses: whether the problem's lenses count; not where intrinsics are fixed.
        observations: of the problem, where they are sorted already.

    Returns:
        A pytree of NumPy arrays; shapes depend on the problem only through sizes and track lengths. Those of a padded
        layout follow from the capacity and whether there is whitening, whether the system is one dense product
        (`is_dense`) and whether a camera sees points twice so often that a tree needs more levels (`room_for`).

    Raises:
        ValueError: parts that do not go together, or a problem larger than the capacity.
    """
    if capacity is not None and (clusters or partitions is not None or not factor):
        raise ValueError("only layouts for a factored system are padded: no clusters, no partitions, factor=True")
    if capacity is not None and not capacity.holds(problem):
        raise ValueError(f"the problem is larger than the capacity: {capacity}")
    cameras = problem.num_cameras if capacity is None else capacity.cameras
    observations = observations or ObservationOrder.of(problem)
    camera, point, tracks = observations.camera, observations.point, observations.tracks
    order, start = observations.order, observations.start
    seen = np.bincount(camera, minlength=cameras)

    made = bucket_slots(tracks) if capacity is None else padded_slots(tracks, point, capacity)
    slot, slot_point, empty = made.slot, made.point, made.empty
    slots = len(slot_point)
    mask = np.zeros(slots, bool)
    mask[slot] = True
    slot_camera = np.zeros(slots, np.int32)
    slot_camera[slot] = camera
    pixels = np.zeros((2, slots))
    pixels[:, slot] = np.asarray(problem.observations)[order].T
    whitening = None
    if problem.whitening is not None:
        whitening = np.zeros((2, 2, slots))
        whitening[:, :, slot] = np.moveaxis(np.asarray(problem.whitening)[order], 0, -1)
    room = None if capacity is None else room_for(seen, capacity.observations, capacity.points)
    by_camera = sorted_by(camera, cameras)
    camera_levels = with_spare_row(sum_tree(slot[by_camera], seen, empty, CAMERA_CHUNK, room), empty)
    table = None
    columns = sum(map(len, made.members))
    if pairs and factor and grid and is_dense(camera, point, tracks, cameras, columns):
        table = np.full((columns, cameras), empty, np.int32)
        table[slot_point[slot], camera] = slot
    listed = None
    ties = lens_ties(problem.lenses, seen > 0) if lenses and problem.lenses is not None else None
    if pairs and table is None:
        banded = ties is None or not ties.shared  # a shared lens couples cameras that have no point in common
        ordered = camera_levels[0].ravel()
        place = np.zeros(slots, np.int32)
        place[ordered] = np.arange(len(ordered))
        spare = int(place[empty])
        listed = pair_layout(
            camera, place[slot], tracks, start, cameras, spare, factor=factor, banded=banded, capacity=capacity
        )
    drawn = None
    if partitions is not None:
        if listed is None:
            raise ValueError("partitions need pairs that are listed: pairs=True, factor=False")
        drawn = partition_layout(
            camera, point, slot, cameras, len(tracks), slot_point, empty, listed, largest=partitions
        )
    return Layout(
        slot_camera=slot_camera,
        slot_point=slot_point,
        slot_mask=mask,
        pixels=pixels,
        whitening=whitening,
        bucket_points=made.members,
        point_levels=made.levels,
        camera_levels=camera_levels,
        camera_seen=seen > 0,
        pairs=listed,
        grid=table,
        clusters=cluster_layout(camera, point, slot, cameras, len(tracks), slot_point, empty) if clusters else None,
        partitions=drawn,
        lenses=ties,
        buckets=made.buckets,
    )


def layout_for(
    problem: BundleProblem,
    options: StepOptions,
    capacity: Capacity | None = None,
    observations: ObservationOrder | None = None,
) -> Layout:
    """The layout that a step with these options needs, and nothing more; padded where there is a capacity."""
    return build_layout(
        problem,
        pairs=options.forms_reduced_system,
        factor=options.factors_reduced_system,
        clusters=options.uses_camera_clusters,
        partitions=options.cluster_cameras,
        capacity=capacity,
        lenses=options.intrinsics == "free",
        observations=observations,
    )


def turns_of(layout: Layout) -> int:
    """Different steps that one state and lambda lead to: as many as there are partitions, which take turns."""
    return 1 if layout.partitions is None else layout.partitions.label.shape[0]


def partition_of(layout: Layout) -> Partition:
    """The partitions of a layout that has them."""
    if layout.partitions is None:
        raise ValueError("this layout has no partitions: build it with partitions=, the cameras of a cluster at most")
    return layout.partitions
