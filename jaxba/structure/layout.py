"""The layout of a problem: index arrays that turn its sparse sums into dense ones.

An *observation slot*, slot for short, is a position in the arrays over observations; it holds one
observation or is empty. Points with similar numbers of observations form a bucket; in a bucket, `n`
points with up to `t` observations each own a tile of `t x n` slots, so that the sum over the
observations of a point is a dense sum over `t` (structure/track_buckets.py). Sums over a camera, or
over a block of the reduced camera system, are *summation trees* (structure/sum_trees.py). Padding
of the index arrays refers to an empty slot, whose values are exactly zero.

The rows of the first level of the camera tree list the slots sorted by camera. The position of a
slot in this list is its *camera-sorted index*.

With a fixed capacity (structure/padding.py) there are no buckets. Slots form chunks of two, which
are summed densely; points are sorted by track length, so that those with an r-th chunk are the
first ones, and sums over points are sums over r of gathered chunks.

The state, the camera model and all arrays over observations are components-first: cameras are `[9,
cameras]`, points `[3, points]`, so that every component is a contiguous vector. Linear algebra and
a `BundleProblem` are items-first: steps, gradients and right-hand sides of the reduced camera
system are `[cameras, 9]`, its blocks `[cameras, 9, 9]`.

Everything is computed once per problem, on the host, with vectorised NumPy."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxba.problem.bundle_problem import BundleProblem
from jaxba.problem.options import ConjugateGradients, StepOptions
from jaxba.structure.agreement import ALONE, Agreement
from jaxba.structure.camera_clusters import ClusterLayout, cluster_layout
from jaxba.structure.covisibility import PairLayout, pair_layout
from jaxba.structure.density import is_dense
from jaxba.structure.observation_order import ObservationOrder
from jaxba.structure.padding import Capacity, room_for
from jaxba.structure.random_partitions import Partition, partition_layout
from jaxba.structure.residual_slots import ResidualSlots, residual_slots, stands_for_rows
from jaxba.structure.sum_trees import sorted_by, sum_tree, with_spare_row
from jaxba.structure.track_buckets import Bucket, bucket_slots, padded_slots
from jaxba.structure.unknowns import Unknowns, unknowns_of
from jaxba.typing import AnyArray, ArrayRecord, register_pytree

# observations per chunk of a camera. Their products are unrolled: it decides the program's size
CAMERA_CHUNK = 8


@register_pytree
@dataclass(frozen=True, eq=False, repr=False)
class Layout(ArrayRecord):
    """A problem's observations in slot order, with the index arrays of their sums. Its points are
    in *layout order*."""

    slot_camera: Int[AnyArray, " slots"]  # camera of each slot
    slot_point: Int[AnyArray, " slots"]  # point of each slot, in layout order
    slot_mask: Bool[AnyArray, " slots"]  # whether the slot holds an observation with pixels
    # whether it holds any, also one that stands for a row of a residual
    slot_used: Bool[AnyArray, " slots"]
    # index in the problem of the observation of each slot; out of range if empty
    observation: Int[AnyArray, " slots"]
    pixels: Float[AnyArray, "2 slots"]  # measured pixels; zero in empty slots
    whitening: Float[AnyArray, "2 2 slots"] | None  # `Sigma^(-1/2)` of each observation
    # index in the problem of each point in layout order; out of range for padding
    points: Int[AnyArray, " points"]
    # in a layout with fixed capacity the ranks of chunks that are added to the first one of each
    # point (`sum_trees.prefix_levels`); None for buckets
    point_levels: tuple[Int[AnyArray, "_ _"], ...] | None
    # summation tree from slots to cameras. The flattened first level sorts the slots by camera and
    # contains an empty one.
    camera_levels: tuple[Int[AnyArray, "_ _"], ...]
    # cameras with at least one observation; the others are not optimised
    camera_seen: Bool[AnyArray, " cameras"]
    # that form the reduced camera system; None if it is not formed from them
    pairs: PairLayout | None
    # slot of the observation of each point by each camera, an empty slot if there is none. Only
    # where the reduced camera system is formed as one dense matrix product.
    grid: Int[AnyArray, "points cameras"] | None
    # clusters of the two-level preconditioner; None if it is not used
    clusters: ClusterLayout | None
    # random ones of the cameras, along a leading axis; None if no method uses them
    partitions: Partition | None
    unknowns: Unknowns  # camera models, and what is shared or constant
    residuals: tuple[ResidualSlots, ...]  # of one's own, and the slots that their rows have
    # shape of each bucket; none with fixed capacity
    buckets: tuple[Bucket, ...] = field(metadata={"static": True})
    # axis of the mesh over which points are divided (structure/devices.py); none: all are here
    axes: tuple[str, ...] = field(default=(), metadata={"static": True})

    @property
    def num_slots(self) -> int:
        """Number of slots, including empty ones."""
        return self.slot_camera.shape[-1]

    @property
    def num_points(self) -> int:
        """Number of points in layout order, including padding."""
        return self.points.shape[-1]

    @property
    def num_cameras(self) -> int:
        """Number of cameras, observed or not."""
        return self.camera_seen.shape[-1]

    def part(self, name: str) -> Any:
        """Pairs, grid, clusters or partitions; a ValueError if the options that it was built for do
        not need them."""
        if getattr(self, name) is None:
            raise ValueError(f"this layout has no {name}: build it with the options of the step")
        return getattr(self, name)


NO_SYSTEM = StepOptions(
    linear_solver="implicit", conjugate_gradients=ConjugateGradients("schur-jacobi")
)
"""Options of a step whose layout has slots and their sums alone."""


def build_layout(
    problem: BundleProblem,
    options: StepOptions = StepOptions(),  # noqa: B008 - immutable
    capacity: Capacity | None = None,
    observations: ObservationOrder | None = None,
    *,
    grid: bool = True,
    agreement: Agreement = ALONE,
) -> Layout:
    """Assigns a problem's observations to slots and builds the index arrays of their sums. Raises
    ValueError: arguments that exclude each other, or a problem larger than the capacity.

    Returns a pytree of NumPy arrays. Without a capacity, its shapes follow from the sizes and track
    lengths of the problem. With one they follow from the capacity, from whether there is whitening,
    from whether the system is one dense product (`is_dense`), and from whether usual bounds hold:
    on tracks and blocks (`prefix_levels`), on half-filled chunks (`Capacity.usual_observations`),
    and on how often cameras see points twice (`room_for`).

    Args:
        problem: a checked problem, `in_frames` if it has rigs, `laid_out` if it has other residuals
            than those of pixels; host arrays.
        options: of the step: the layout has exactly the parts that it needs. If it forms the
            reduced camera system, it lists pairs of observations: `t (t + 1) / 2` of each point
            with t observations.
        capacity: fixed sizes to pad to. Only for a factored system, which is then dense even if it
            is a band.
        observations: the sorted observations of the problem, if they are known already.
        grid: whether a factored system may be formed as one dense matrix product instead of from
            pairs, where that is cheaper (structure/density.py).
        agreement: with the layouts of the other shards of a problem (solver/sharded.py)."""
    factor = options.factors_reduced_system
    pairs = options.forms_reduced_system
    if capacity is not None and not factor:
        raise ValueError("only layouts for a factored system are padded")
    observations = observations or ObservationOrder.of(problem)
    if capacity is not None and not capacity.holds(observations):
        raise ValueError(f"the problem is larger than the capacity: {capacity}")
    cameras = observations.num_cameras if capacity is None else capacity.cameras
    camera = observations.camera
    tracks = observations.tracks
    order = observations.order
    seen = np.bincount(camera, minlength=cameras)
    is_seen = agreement.total("seen", lambda: seen) > 0

    slots = (
        bucket_slots(tracks, agreement.within("buckets"))
        if capacity is None
        else padded_slots(tracks, capacity)
    )
    slot = slots.slot
    empty = slots.empty
    count = len(slots.point)

    def in_slots(values: np.ndarray, otherwise: Any = 0) -> np.ndarray:
        """Values of the sorted observations, which are their first axis, as the last axis of the
        slots."""
        found = np.full((*values.shape[1:], count), otherwise, values.dtype)
        found[..., slot] = np.moveaxis(values, 0, -1)
        return found

    def in_order(values):
        return in_slots(np.asarray(values, np.float64)[order])

    room = None if capacity is None else room_for(seen, capacity.observations, capacity.points)
    by_camera = sorted_by(camera, cameras)
    levels = sum_tree(slot[by_camera], seen, empty, CAMERA_CHUNK, room, agreement.within("cameras"))
    camera_levels = with_spare_row(levels, empty)
    unknowns = unknowns_of(
        problem,
        is_seen,
        slots.points,
        fixed=options.intrinsics == "fixed",
        agreement=agreement,
        capacity=capacity,
    )
    pair_lists = slot_grid = drawn_partitions = camera_clusters = None
    dense = pairs and factor and grid and is_dense(observations, cameras, len(slots.points))
    if agreement.size("listed pairs", int(not dense)) == 0:  # in all shards or none
        slot_grid = np.full((len(slots.points), cameras), empty, np.int32)
        slot_grid[slots.point[slot], camera] = slot
    elif pairs:
        slots_by_camera = camera_levels[0].ravel()
        sorted_index = np.zeros(count, np.int32)  # camera-sorted index of each slot
        sorted_index[slots_by_camera] = np.arange(len(slots_by_camera))
        moves = observations.moves
        pair_lists = pair_layout(
            camera[moves],
            sorted_index[slot[moves]],
            observations.moving_tracks,
            cameras,
            int(sorted_index[empty]),
            factor=factor,
            banded=not unknowns.merged,
            capacity=capacity,
            agreement=agreement.within("pairs"),
        )
    if options.cluster_cameras is not None and pair_lists is not None:
        drawn_partitions = partition_layout(
            observations, slots, pair_lists, options.cluster_cameras
        )
    if options.uses_camera_clusters:
        camera_clusters = cluster_layout(
            observations, slots, unknowns, agreement.within("clusters")
        )
    return Layout(
        slot_camera=in_slots(camera.astype(np.int32)),
        slot_point=slots.point,
        slot_mask=in_slots(~stands_for_rows(problem)[order]),
        slot_used=in_slots(np.ones(len(order), bool)),
        observation=in_slots(order.astype(np.int32), len(order)),
        pixels=in_order(problem.observations),
        whitening=None if problem.whitening is None else in_order(problem.whitening),
        points=slots.points,
        point_levels=slots.levels,
        camera_levels=camera_levels,
        camera_seen=is_seen,
        pairs=pair_lists,
        grid=slot_grid,
        clusters=camera_clusters,
        partitions=drawn_partitions,
        unknowns=unknowns,
        residuals=residual_slots(problem, slot, order, slots.points, agreement.within("residuals")),
        buckets=slots.buckets,
    )


def num_partitions(layout: Layout) -> int:
    """Number of partitions that iterations cycle through, and so of different steps from one state
    and lambda."""
    return 1 if layout.partitions is None else layout.partitions.label.shape[0]
