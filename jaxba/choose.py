"""Which solver of the reduced camera system is fastest for a problem: a cost model with measured constants.

The constants were fitted on two x86-64 cores, float64 (benchmarks/phases.py measures what they stand for). Only ratios
matter for the choice, and those move little between machines.
"""

from __future__ import annotations

import os
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from jaxba.density import has_small_capacitance
from jaxba.options import REDUCED_SOLVERS, LinearSolver, StepOptions
from jaxba.ordering import camera_order, is_banded
from jaxba.problem import CAMERA_SIZE, BundleProblem, ProblemError

SECONDS_PER_PAIR = 1e-7
"""Forming the blocks, per pair of observations of one point: 6e-8 on small problems, 1e-7 with 2.5 million pairs."""

SECONDS_PER_BLOCK = 6e-8
"""One product with the formed blocks, per block."""

SECONDS_PER_OBSERVATION = 4e-8
"""One implicit product, per observation."""

COARSE_SECONDS_PER_OBSERVATION = 2e-7
"""Forming the coarse system of the two-level preconditioner, per observation."""

SECONDS_PER_CUBE = 4.5e-12
"""Dense Cholesky factorisation, per cube of the number of unknowns."""

SECONDS_PER_PRODUCT = 1.2e-11
"""A multiplication and addition in a dense product: 170 GFLOP/s (docs/optimisations.md)."""

SECONDS_PER_BAND = 3.3e-11
"""Band factorisation, per unknown times the square of the band's unknowns."""

ASSUMED_PRODUCTS = 12
"""Conjugate gradient iterations assumed for one step with the two-level preconditioner, which takes 6 to 20 on the
problems at hand."""

SHARED_SECONDS_PER_OBSERVATION = 2e-7
"""What all solvers do beside the linear solve, per observation: 6.5 ms on bulani1 with its 36 k observations."""

INEXACT_ITERATIONS = 1.2
"""Iterations to convergence that truncated conjugate gradients take, relative to a factorisation: geometric mean over
bulani1, bulani2, bulani4 and the rules ceres, ceres+refine3 and learned, which range from 0.8 to 2.0."""

TIED_COPIES = 5
"""The reduced camera system, its mirror image, the tied one, that scaled, its factor (ties.py, dense.py)."""

MAX_BYTES = 4e9
"""A solver that would need more memory than this is not chosen."""

BYTES_PER_OBSERVATION = 1100.0
"""Device memory of one implicit step in float64: arguments, results and temporaries. Half of it in float32. A scene of
Ladybug-1197's size takes 1,072 (tests/test_memory.py, docs/performance.md)."""

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
    counts = count_pairs(problem)
    unknowns, band = 9.0 * problem.num_cameras, 9.0 * counts.reach
    forming = counts.pairs * SECONDS_PER_PAIR
    formed_bytes = counts.pairs * BYTES_PER_PAIR + counts.blocks * BYTES_PER_BLOCK
    if is_banded(problem.num_cameras, counts.reach):
        factoring, factor_bytes = SECONDS_PER_BAND * unknowns * band**2, 3 * 8 * unknowns * band
    else:
        factoring, factor_bytes = SECONDS_PER_CUBE * unknowns**3, 4 * 8 * unknowns**2
    if _few_points_once_each(problem):
        coordinates = 3.0 * (_observed_points(problem) + 1)
        forming, factoring = unknowns * coordinates**2 * SECONDS_PER_PRODUCT, SECONDS_PER_CUBE * coordinates**3
        formed_bytes, factor_bytes = 0.0, 3 * 8 * unknowns * coordinates
    coarse = COARSE_SECONDS_PER_OBSERVATION * problem.num_observations
    return SolverCosts(
        explicit=_within(formed_bytes + factor_bytes, forming + factoring),
        sparse=_within(formed_bytes, forming + coarse + ASSUMED_PRODUCTS * SECONDS_PER_BLOCK * counts.blocks),
        implicit=coarse + ASSUMED_PRODUCTS * SECONDS_PER_OBSERVATION * problem.num_observations,
    )


def _observed_points(problem: BundleProblem) -> int:
    return int(np.count_nonzero(np.bincount(problem.point_index, minlength=1)))


def _few_points_once_each(problem: BundleProblem) -> bool:
    """Whether the explicit solver will factor a matrix of the points' size (`density.is_dense`)."""
    point, cameras = np.asarray(problem.point_index, np.int64), problem.num_cameras
    if not has_small_capacitance(_observed_points(problem) + 1, cameras):
        return False
    return len(np.unique(point * cameras + problem.camera_index)) == len(point)


class PairCounts(NamedTuple):
    """What the size of the reduced camera system follows from."""

    pairs: int  # pairs of observations of one point
    blocks: int  # pairs of cameras that share a point; a camera pairs with itself
    reach: int  # in the better order of cameras, the largest distance of two that share a point


def count_pairs(problem: BundleProblem) -> PairCounts:
    """Counts pairs; blocks and reach are exact up to `MAX_COUNTED_PAIRS` pairs, else upper bounds."""
    point, cameras = np.asarray(problem.point_index), problem.num_cameras
    tracks = np.bincount(point, minlength=problem.num_points)
    pairs = int(np.sum(tracks * (tracks + 1) // 2))
    if pairs > MAX_COUNTED_PAIRS or cameras > MAX_COUNTED_CAMERAS:
        return PairCounts(pairs, min(pairs, cameras * (cameras + 1) // 2), cameras)
    order = np.argsort(point.astype(np.int64) * cameras + problem.camera_index, kind="stable")
    camera = np.asarray(problem.camera_index)[order]
    start = np.cumsum(tracks) - tracks
    shared = np.zeros((cameras, cameras), bool)
    for length in np.unique(tracks[tracks > 0]):
        first = start[tracks == length][:, None]
        row, column = np.tril_indices(length)
        shared[camera[first + row], camera[first + column]] = True
    rows, columns = np.nonzero(shared)
    return PairCounts(pairs, len(rows), camera_order(rows, columns, cameras)[1])


def choose(problem: BundleProblem) -> LinearSolver:
    """The solver with the lowest predicted time to the end; a tie goes to the more exact one."""
    shared = SHARED_SECONDS_PER_OBSERVATION * problem.num_observations
    costs = predict(problem)
    times = {name: shared + seconds for name, seconds in costs._asdict().items()}
    times = {name: time * (1 if name == "explicit" else INEXACT_ITERATIONS) for name, time in times.items()}
    return min(times, key=lambda name: times[name])  # type: ignore[return-value]


def choose_linear_solver(problem: BundleProblem, options: StepOptions, linear_solver: str | None) -> StepOptions:
    """Options with the linear solver that was asked for.

    Args:
        problem: decides `auto`.
        options: of the step.
        linear_solver: a name, `auto`, or None to keep what the options say. A method that is a linear solver itself
            (methods.py) has no choice to make: `auto` keeps it. Fixed intrinsics leave the explicit one.

    Raises:
        ValueError: such a method, and another solver asked for by name.
        ProblemError: cameras share a lens, or some of it stays, and it is not the explicit solver that was asked for.
    """
    if problem.lenses is not None and options.intrinsics == "free":
        wanted = options.linear_solver if linear_solver is None else linear_solver
        if options.linear_solver not in REDUCED_SOLVERS or wanted not in ("auto", "explicit"):
            refused = wanted if options.linear_solver in REDUCED_SOLVERS else options.linear_solver
            raise ProblemError(f"shared or partly fixed lenses need plain LM, solved explicitly, not {refused}")
        if problem.lenses.shared:
            _check_memory(problem.num_cameras)
        return replace(options, linear_solver="explicit")
    if linear_solver is None or linear_solver == options.linear_solver:
        return options
    if options.linear_solver not in REDUCED_SOLVERS:
        if linear_solver == "auto":
            return options
        raise ValueError(f"linear solver {linear_solver!r} is for plain LM steps; this method has its own")
    if linear_solver == "auto":
        linear_solver = choose(problem) if options.intrinsics == "free" else "explicit"
    return replace(options, linear_solver=linear_solver)


def _check_memory(cameras: int) -> None:
    """Refuses what shared lenses would need more memory for than the machine has: they break bands and blocks."""
    needed = TIED_COPIES * 8.0 * (CAMERA_SIZE * cameras) ** 2
    try:
        there = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError, OSError):
        return
    if needed > there:
        raise ProblemError(
            f"{cameras} cameras with shared lenses take some {needed / 1e9:.0f} GB to solve, more than the "
            f"{there / 1e9:.0f} GB of this machine; with fixed intrinsics they may take less"
        )


def _within(size: float, seconds: float) -> float:
    return seconds if size <= MAX_BYTES else float("inf")
