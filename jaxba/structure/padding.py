"""Array sizes rounded up to a coarse grid, so that similar problems share one compiled program.

A compiled program fits one set of array shapes. Without padding these follow from the data (buckets by track length,
summation trees, pairs), so that every problem compiles its own program, which takes seconds where the solve may take a
fraction of one. With padding all shapes follow from a `Capacity`, four numbers on a coarse grid. Padding contains no
observations: it adds exact zeros to sums, and its cameras and points never change.

Up to half of the slots are padding, which makes an iteration up to about twice as long. That pays while a solve is
faster than a compilation, so larger problems are not padded (`capacity_of`). A problem with few points loses more: with
padding it has too many of them for Woodbury's identity (structure/density.py).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Int

from jaxba.problem.bundle_problem import CAMERA_SIZE, POINT_SIZE, BundleProblem
from jaxba.problem.options import LinearSolverChoice, StepOptions
from jaxba.structure.observation_order import ObservationOrder
from jaxba.structure.sum_trees import Room

MIN_CAMERAS = 8
"""Smallest number of cameras."""

MIN_OBSERVATIONS = 1024
"""Smallest number of slots. Measured on Ladybug-49: a step takes 0.4 us per slot, so that this many cost no time."""

SLOTS_PER_POINT = 2
"""Slots per point in the capacity. Windows of real sequences have 3 to 5 observations per point; with room for more
points, their capacity nearly always follows from that of the observations, and a padding point costs little."""

PAIRS_PER_SLOT = 4
"""Pairs per slot in the capacity: windows of 20 cameras of the KITTI sequence kitti00vo have 3.4 per observation."""

MAX_CAMERAS = 128
"""Most cameras of a padded problem: a dense system of 1350 unknowns takes 11 ms to factor, and long sequences are
better factored as bands."""

MAX_OBSERVATIONS = 1 << 17
"""Most slots of a padded problem. Measured on Ladybug-49: a step takes 0.4 us per slot, twenty steps take a second."""

MAX_PAIRS = 1 << 20
"""Most pairs of a padded problem. Measured: a step takes 0.1 us per pair, twenty steps take two seconds."""


@dataclass(frozen=True)
class Capacity:
    """Sizes of a padded layout. Equal capacities give equal shapes."""

    cameras: int
    points: int
    observations: int
    """Number of slots, one more than the largest number of observations, since one slot is always empty."""

    pairs: int
    """Number of pairs of observations of one point, an observation with itself included."""

    def holds(self, problem: BundleProblem) -> bool:
        """Whether the problem fits; its pairs are not counted."""
        counts = problem.num_cameras, problem.num_points, problem.num_observations + 1
        return all(n <= most for n, most in zip(counts, (self.cameras, self.points, self.observations), strict=True))

    def __str__(self) -> str:
        return f"{self.cameras} cameras, {self.points} points, {self.observations} observations, {self.pairs} pairs"


def capacity_of(problem: BundleProblem, observations: ObservationOrder | None = None) -> Capacity | None:
    """The capacity of a problem: its sizes rounded up to the grid.

    Cameras are rounded up to 8, 12, 16, 24, ..., observations to a power of two. Points and pairs get a fixed multiple
    of the slots or, if that is not enough, the next power of two. Rounding each on its own gives more programs:
    measured on 20 windows of 20 cameras of kitti00vo, 5 different capacities instead of 2.

    Args:
        problem: the problem to pad.
        observations: its sorted observations, if they are known already.

    Returns:
        The capacity; None for problems with lenses (problem/intrinsics.py), with more than `MAX_CAMERAS` or
        `MAX_PAIRS`, or with more observations or points than `MAX_OBSERVATIONS`.
    """
    if problem.lenses is not None or problem.num_cameras > MAX_CAMERAS:
        return None
    if max(problem.num_points, problem.num_observations + 1) > MAX_OBSERVATIONS:
        return None
    observations = observations or ObservationOrder.of(problem)
    # if a camera sees a point twice, the pair is listed in both orders (covisibility.py)
    pairs = observations.num_pairs + observations.num_repeated_pairs
    if pairs > MAX_PAIRS:
        return None
    cameras = max(MIN_CAMERAS, _power(problem.num_cameras))
    between = max(MIN_CAMERAS, cameras * 3 // 4)
    slots = max(MIN_OBSERVATIONS, _power(problem.num_observations + 1))
    return Capacity(
        cameras=between if problem.num_cameras <= between else cameras,
        points=max(slots // SLOTS_PER_POINT, _power(problem.num_points)),
        observations=slots,
        pairs=max(slots * PAIRS_PER_SLOT, _power(pairs)),
    )


def room_for(counts: Int[np.ndarray, " targets"], items: int, expected: int) -> Room:
    """Room of a summation tree in a layout with fixed capacity.

    A target has at most `expected` items unless a camera sees a point twice. If some target has more, the tree gets
    room for all items in one target, which takes one or two more levels.

    Args:
        counts: number of items of each target.
        items: capacity for the items of all targets.
        expected: largest number of items of a target if no camera sees a point twice.
    """
    return Room(items, min(items, expected) if counts.max(initial=0) <= expected else items)


def with_padded_solver(
    capacity: Capacity | None, options: StepOptions, asked: LinearSolverChoice
) -> tuple[Capacity | None, LinearSolverChoice]:
    """Restricts padding to the explicit solver, which `auto` then means.

    The choice of `auto` depends on the exact sizes of a problem, so that problems of one capacity might get different
    programs. Up to the largest capacity the explicit solver is never slow.

    Args:
        capacity: of the problem; None if it is not padded.
        options: options of the step, with its method.
        asked: the requested linear solver.

    Returns:
        The capacity (None if another solver or a method is requested) and the linear solver to use.
    """
    if options.method is not None or asked not in ("auto", "explicit"):
        return None, asked
    return capacity, asked if capacity is None else "explicit"


def padded_parameters(problem: BundleProblem, capacity: Capacity) -> BundleProblem:
    """The problem's cameras and points, padded with zeros to the capacity, without observations."""
    cameras, points = np.zeros((capacity.cameras, CAMERA_SIZE)), np.zeros((capacity.points, POINT_SIZE))
    cameras[: problem.num_cameras], points[: problem.num_points] = problem.cameras, problem.points
    nothing = np.zeros(0, np.int32)
    return BundleProblem(cameras, points, np.zeros((0, 2)), nothing, nothing)


def _power(count: int) -> int:
    """The power of two at or above a count."""
    return 1 << max(0, count - 1).bit_length()
