"""Which solver of the reduced camera system is fastest for a problem: a cost model with measured constants.

The constants were fitted on two x86-64 cores, float64 (benchmarks/phases.py measures what they stand for). Only ratios
matter for the choice, and those move little between machines.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from jaxba.options import LinearSolver
from jaxba.problem import BundleProblem

SECONDS_PER_PAIR = 7e-8
"""Forming the blocks, per pair of observations of one point."""

SECONDS_PER_BLOCK = 6e-8
"""One product with the formed blocks, per block."""

SECONDS_PER_OBSERVATION = 4.5e-8
"""One implicit product, per observation."""

SECONDS_PER_CUBE = 6e-12
"""Cholesky factorisation, per cube of the number of unknowns."""

CAUTIOUS_PRODUCTS = 250
"""Conjugate gradient iterations assumed for one step. Photo collections take 10 to 60, but a long sequence of frames
takes hundreds (kitti00vo: 420 on average), so that in doubt the system is factored."""

MAX_BYTES = 4e9
"""A solver that would need more memory than this is not chosen."""

BYTES_PER_PAIR = 16.0
"""Index and padding; the products themselves are made in batches."""

BYTES_PER_BLOCK = 3 * 81 * 8.0
"""A block, its chunks and their sums."""


MAX_COUNTED_PAIRS = 20_000_000
"""Up to this many pairs the blocks are counted, which takes under a second."""

MAX_COUNTED_CAMERAS = 20_000
"""The table of camera pairs takes a byte each."""


class SolverCosts(NamedTuple):
    """Predicted seconds per iteration of what the solvers do not share; infinite where memory would not do."""

    explicit: float
    sparse: float
    implicit: float


def predict(problem: BundleProblem) -> SolverCosts:
    """Costs from the numbers of cameras, observations, pairs and co-visible blocks."""
    pairs, blocks = count_pairs(problem)
    unknowns = 9.0 * problem.num_cameras
    forming = pairs * SECONDS_PER_PAIR
    formed_bytes = pairs * BYTES_PER_PAIR + blocks * BYTES_PER_BLOCK
    return SolverCosts(
        explicit=_within(formed_bytes + 4 * 8 * unknowns**2, forming + SECONDS_PER_CUBE * unknowns**3),
        sparse=_within(formed_bytes, forming + CAUTIOUS_PRODUCTS * SECONDS_PER_BLOCK * blocks),
        implicit=CAUTIOUS_PRODUCTS * SECONDS_PER_OBSERVATION * problem.num_observations,
    )


def count_pairs(problem: BundleProblem) -> tuple[int, int]:
    """Pairs of observations of one point, and pairs of cameras that share a point; a camera pairs with itself.

    The second number is exact up to `MAX_COUNTED_PAIRS` pairs, else the upper bound that the first one gives.
    """
    point, cameras = np.asarray(problem.point_index), problem.num_cameras
    tracks = np.bincount(point, minlength=problem.num_points)
    pairs = int(np.sum(tracks * (tracks + 1) // 2))
    if pairs > MAX_COUNTED_PAIRS or cameras > MAX_COUNTED_CAMERAS:
        return pairs, min(pairs, cameras * (cameras + 1) // 2)
    order = np.argsort(point.astype(np.int64) * cameras + problem.camera_index, kind="stable")
    camera = np.asarray(problem.camera_index)[order]
    start = np.cumsum(tracks) - tracks
    shared = np.zeros((cameras, cameras), bool)
    for length in np.unique(tracks[tracks > 0]):
        first = start[tracks == length][:, None]
        row, column = np.tril_indices(length)
        shared[camera[first + row], camera[first + column]] = True
    return pairs, int(shared.sum())


def choose(problem: BundleProblem) -> LinearSolver:
    """The solver with the lowest predicted cost; a tie goes to the more exact one."""
    costs = predict(problem)._asdict()
    return min(costs, key=lambda name: costs[name])  # type: ignore[return-value]


def _within(size: float, seconds: float) -> float:
    return seconds if size <= MAX_BYTES else float("inf")
