"""Array sizes rounded up to a coarse grid, so that similar problems share one compiled program.

A compiled program fits one set of array shapes. Without padding these follow from the data (buckets
by track length, summation trees, pairs), so that every problem compiles its own program, which
takes seconds where the solve may take a fraction of one. With padding all shapes follow from a
`Capacity`, five numbers on a grid, but for few problems with unusually long tracks or many small
blocks (`sum_trees.prefix_levels`). Which cameras share a lens and what is constant is data. Padding
contains no observations: it adds exact zeros to sums, and its cameras and points never change.

A tenth to a half of the slots are padding: from rounding, and in half-filled chunks. The grid is
coarse for small problems, where reading a program from disk takes as long as twenty iterations: of
the adjustments of a COLMAP mapper, which take three iterations each, 95 on 36 images of KITTI need
19 kinds of programs; 28 with two numbers of slots an octave, 54 with eight. An iteration takes 1.0
to 1.6 times as long as with the exact shape. Larger problems are not padded (`capacity_of`), since
their iterations take as long as compiling does. A problem with few points may lose more than
others: with padding it may have too many of them for Woodbury's identity (structure/density.py)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from jaxba.problem.bundle_problem import BundleProblem
from jaxba.problem.hold import every_lens
from jaxba.structure.observation_order import ObservationOrder
from jaxba.structure.sum_trees import Room

CAMERAS = (8, 32, 48, 64, 96, 128)  # longer sequences are better factored as bands
# of shared lenses; each takes as many products with the system as it has free numbers
LENSES = (0, 1, 4, 16, 64)
# slots per chunk. On five real problems 6 to 14% of such slots are empty; with three 11 to 28%
POINT_CHUNK = 2
# smallest number of slots. On Ladybug-49 a step takes 0.2 us per slot: these cost no time
MIN_OBSERVATIONS = 1024
# slots up to which powers of two suffice, where a step takes 5 ms; then four sizes an octave
COARSE_OBSERVATIONS = 1 << 14
# of the capacity, as few as suffice. Real problems have 0.2 to 0.6
POINTS_PER_CHUNK = (1 / 2, 1)
# or 2, 4, ... times as many. Windows of kitti00vo have 2.9 to 4.2; spare pairs cost little
PAIRS_PER_SLOT = 6
MAX_CAMERAS = CAMERAS[-1]  # most cameras of a padded problem
# most slots of a padded problem. On Ladybug-49 a step takes 0.4 us per slot
MAX_OBSERVATIONS = 1 << 17
# most pairs of a padded problem. Measured: 0.1 us per pair and step, twenty steps take two seconds
MAX_PAIRS = 1 << 20


@dataclass(frozen=True)
class Capacity:
    """Sizes of a padded layout. Equal capacities give equal shapes."""

    cameras: int
    points: int
    # number of slots in chunks of `POINT_CHUNK`, of which one chunk is always empty
    observations: int
    pairs: int  # number of pairs of observations of one point, an observation with itself included
    lenses: int = 0  # number of lenses that several cameras share
    # whether shapes follow from these numbers alone, with room for all that they may hold, unless a
    # camera sees a point twice. Else they are smaller where the problem is a usual one.
    fixed: bool = False

    def holds(self, observations: ObservationOrder) -> bool:
        """Whether the problem fits; its pairs are not counted."""
        counts = observations.num_cameras, len(observations.tracks), slots_for(observations.tracks)
        return all(
            n <= most
            for n, most in zip(counts, (self.cameras, self.points, self.observations), strict=True)
        )

    def __str__(self) -> str:
        return (
            f"{self.cameras} cameras, {self.points} points, {self.observations} observations, "
            f"{self.pairs} pairs"
        )


def capacity_of(
    problem: BundleProblem, observations: ObservationOrder | None = None
) -> Capacity | None:
    """The capacity of a problem: its sizes rounded up to the grid.

    Cameras are rounded up to `CAMERAS`, shared lenses to `LENSES`, slots to powers of two, or to
    four sizes an octave if there are many. Points and pairs get a fixed multiple of the slots, or
    the next larger one if that is not enough: rounding each on its own would give more programs.
    `observations` are the sorted ones of the problem, if they are known already. Returns None for
    problems with rigs or other residuals than those of pixels, with more than `MAX_CAMERAS` or
    `MAX_PAIRS` or than the last of `LENSES`, or with more observations or points than
    `MAX_OBSERVATIONS`."""
    observations = observations or ObservationOrder.of(problem)
    cameras = observations.num_cameras
    points = len(observations.tracks)
    if problem.rigs or problem.residuals or cameras > MAX_CAMERAS:
        return None
    needed = slots_for(observations.tracks)
    pairs = observations.num_listed_pairs
    shared_lenses = _num_shared_lenses(problem, observations)
    if needed > MAX_OBSERVATIONS or pairs > MAX_PAIRS or shared_lenses > LENSES[-1]:
        return None
    slots = _rounded_slots(needed)
    chunks = slots // POINT_CHUNK
    return Capacity(
        cameras=next(size for size in CAMERAS if size >= cameras),
        points=next(room for share in POINTS_PER_CHUNK if (room := int(share * chunks)) >= points),
        observations=slots,
        pairs=slots * PAIRS_PER_SLOT * _power(-(-pairs // (slots * PAIRS_PER_SLOT))),
        lenses=next(room for room in LENSES if room >= shared_lenses),
    )


def _num_shared_lenses(problem: BundleProblem, observations: ObservationOrder) -> int:
    """Number of lenses that several observed cameras share."""
    lens_of_camera = np.asarray(every_lens(problem).index)
    observed_cameras = np.unique(observations.camera)
    cameras_of_lens = np.bincount(lens_of_camera[observed_cameras])
    return int(np.count_nonzero(cameras_of_lens > 1))


def slots_for(tracks: Int[np.ndarray, " points"]) -> int:
    """Number of slots that points with these numbers of observations need.

    A point without observations gets a chunk, too, and one more is always empty."""
    return POINT_CHUNK * (1 + int(np.sum(np.maximum(1, -(-tracks // POINT_CHUNK)))))


def room_for(counts: Int[np.ndarray, " targets"], items: int, expected: int) -> Room:
    """Room of a summation tree in a layout with fixed capacity.

    A target has at most `expected` items unless a camera sees a point twice. If some target has
    more, the tree gets room for all items in one target, which takes one or two more levels.
    `counts` are numbers of items of each target, `items` is the capacity for those of all
    targets."""
    return Room(items, min(items, expected) if counts.max(initial=0) <= expected else items)


def padded_parameters(
    problem: BundleProblem, capacity: Capacity
) -> tuple[Float[np.ndarray, "cameras parameters"], Float[np.ndarray, "points 3"]]:
    """The problem's cameras and points, padded with zeros to the capacity."""

    def padded(rows, count):
        return np.pad(np.asarray(rows, np.float64), ((0, count - len(rows)), (0, 0)))

    return padded(problem.cameras, capacity.cameras), padded(problem.points, capacity.points)


def _rounded_slots(needed: int) -> int:
    """The number of slots of the grid at or above those that a problem needs."""
    power = _power(max(MIN_OBSERVATIONS, needed))
    # of sizes from half of the power up to it
    step = power if power <= COARSE_OBSERVATIONS else power // 8
    return max(MIN_OBSERVATIONS, -(-needed // step) * step)


def _power(count: int) -> int:
    """The power of two at or above a count."""
    return 1 << max(0, count - 1).bit_length()
