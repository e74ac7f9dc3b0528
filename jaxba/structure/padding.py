"""Sizes rounded up to a grid, so that similar problems share one compiled program.

A program fits one set of array shapes. Without padding those follow from the data (buckets by track length, trees,
pairs), so that every problem compiles its own, in seconds, where solving it may take a fraction of one. Padded shapes
follow from a `Capacity` alone, four numbers on a coarse grid. Padding holds no observations: it adds exact zeros to
sums, and its cameras and points never move.

Up to half of the slots are waste, which makes an iteration up to twice as long or a little more. That is a good bargain
while a solve is quicker than a compilation, so larger problems are left as they are (`capacity_of`). Few points lose
more: with their padding they are too many for a matrix of their own size (`structure/density.py`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Int

from jaxba.problem.bundle_problem import CAMERA_SIZE, POINT_SIZE, BundleProblem
from jaxba.problem.options import LinearSolverChoice, StepOptions
from jaxba.structure.observation_order import ObservationOrder
from jaxba.structure.sum_trees import Room

LEAST_CAMERAS = 8
"""Smallest number of cameras."""

LEAST_OBSERVATIONS = 1024
"""Smallest number of slots: a step takes 0.4 us each (Ladybug-49), so that rounding these up costs no time."""

LEAST_TRACK = 2
"""There is room for a point in so many slots at least. Windows of real sequences have 3 to 5 observations a point, but
so points nearly always follow from observations, and a padding point costs little."""

LEAST_PAIRS = 4
"""Pairs per slot for which there is room anyway: 20 cameras of kitti00vo have 3.4 per observation."""

MAX_CAMERAS = 128
"""More cameras are not padded: a dense system of 1350 unknowns takes 11 ms to factor, and long sequences are
better factored as bands."""

MAX_OBSERVATIONS = 1 << 17
"""More slots are not padded: a step takes 0.4 us each (Ladybug-49), so that twenty take a second."""

MAX_PAIRS = 1 << 20
"""More pairs are not padded: a step took 0.1 us each, so that twenty took two seconds."""


@dataclass(frozen=True)
class Capacity:
    """What a padded layout has room for. Equal capacities mean equal shapes."""

    cameras: int
    points: int
    observations: int
    """Slots; one more than there can be observations, since one is always empty."""

    pairs: int
    """Pairs of observations of one point, each with itself included."""

    def holds(self, problem: BundleProblem) -> bool:
        """Whether there is room for the problem; its pairs are not counted."""
        counts = problem.num_cameras, problem.num_points, problem.num_observations + 1
        return all(n <= most for n, most in zip(counts, (self.cameras, self.points, self.observations), strict=True))

    def __str__(self) -> str:
        return f"{self.cameras} cameras, {self.points} points, {self.observations} observations, {self.pairs} pairs"


def capacity_of(problem: BundleProblem, observations: ObservationOrder | None = None) -> Capacity | None:
    """The grid cell of a problem.

    Cameras are rounded up to 8, 12, 16, 24, ..., observations to a power of two. Points and pairs mostly follow from
    that; where they do not, they are rounded up to powers of two themselves. Free numbers cut a sequence into more
    cells: 20 windows of 20 cameras of kitti00vo fall into 2 of them, with free points and pairs into 5.

    Returns:
        None for problems with lenses (problem/intrinsics.py), or with more than `MAX_CAMERAS`, `MAX_OBSERVATIONS`
        (points count too) or `MAX_PAIRS`.
    """
    if problem.lenses is not None or problem.num_cameras > MAX_CAMERAS:
        return None
    if max(problem.num_points, problem.num_observations + 1) > MAX_OBSERVATIONS:
        return None
    observations = observations or ObservationOrder.of(problem)
    # of a camera that sees a point twice both orders are listed (covisibility.py)
    pairs = observations.num_pairs + observations.num_repeated_pairs
    if pairs > MAX_PAIRS:
        return None
    cameras = max(LEAST_CAMERAS, _power(problem.num_cameras))
    between = max(LEAST_CAMERAS, cameras * 3 // 4)
    slots = max(LEAST_OBSERVATIONS, _power(problem.num_observations + 1))
    return Capacity(
        cameras=between if problem.num_cameras <= between else cameras,
        points=max(slots // LEAST_TRACK, _power(problem.num_points)),
        observations=slots,
        pairs=max(slots * LEAST_PAIRS, _power(pairs)),
    )


def room_for(counts: Int[np.ndarray, " targets"], items: int, expected: int) -> Room:
    """Room of a tree whose targets have at most as many items as there are cameras, or points, to give them.

    More come where a camera sees a point twice. Such a tree is made for the worst, with one or two levels more.

    Args:
        counts: items of each target.
        items: capacity for all of them.
        expected: most items of a target where no camera sees a point twice.
    """
    return Room(items, min(items, expected) if counts.max(initial=0) <= expected else items)


def with_padded_solver(
    capacity: Capacity | None, options: StepOptions, asked: LinearSolverChoice
) -> tuple[Capacity | None, LinearSolverChoice]:
    """Padding is for the explicit solver alone, and wherever there is a choice it takes that.

    `auto` chooses by counts of the very problem, so that neighbours in one cell might get different programs. Up to the
    largest capacity the explicit solver is never slow.

    Args:
        capacity: of the problem, None where it is not padded.
        options: of the step, with its method.
        asked: the linear solver that was asked for.

    Returns:
        The capacity, None where another solver was asked for, and the linear solver to ask for.
    """
    if options.method is not None or asked not in ("auto", "explicit"):
        return None, asked
    return capacity, asked if capacity is None else "explicit"


def padded_parameters(problem: BundleProblem, capacity: Capacity) -> BundleProblem:
    """The problem's cameras and points, then zeros up to the capacity; without observations, which the layout has."""
    cameras, points = np.zeros((capacity.cameras, CAMERA_SIZE)), np.zeros((capacity.points, POINT_SIZE))
    cameras[: problem.num_cameras], points[: problem.num_points] = problem.cameras, problem.points
    nothing = np.zeros(0, np.int32)
    return BundleProblem(cameras, points, np.zeros((0, 2)), nothing, nothing)


def _power(count: int) -> int:
    """The power of two at or above a count."""
    return 1 << max(0, count - 1).bit_length()
