"""Which solver of the reduced camera system is fastest for a problem: a cost model with measured constants.

The constants were fitted on two x86-64 cores, float64 (`python -m benchmarks.choice --fit`). Only ratios
matter for the choice, and those move little between machines.
"""

from __future__ import annotations

import os
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from jaxba.problem.bundle_problem import CAMERA_SIZE, BundleProblem, ProblemError
from jaxba.problem.options import LinearSolver, LinearSolverChoice, StepOptions
from jaxba.structure.camera_ordering import camera_order, is_banded
from jaxba.structure.density import has_dense_shape, has_small_capacitance
from jaxba.structure.observation_order import ObservationOrder


class Work(NamedTuple):
    """Amounts of work of an iteration by kind, or the seconds that a unit of each takes (`SECONDS`)."""

    step: float = 0.0
    """One iteration, whatever its size."""

    observation: float = 0.0
    """What all solvers do beside the linear solve: an observation linearised, eliminated and its cost taken."""

    pair: float = 0.0
    """Forming the blocks: a pair of observations of one point."""

    dense_product: float = 0.0
    """A multiplication and addition where the system is formed as one dense product (structure/density.py)."""

    square: float = 0.0
    """The square of the unknowns of a dense factorisation: what is written, and what one core does."""

    cube: float = 0.0
    """The cube of the unknowns of a dense factorisation."""

    band: float = 0.0
    """Band factorisation: an unknown times the square of the band's unknowns."""

    block: float = 0.0
    """A product of conjugate gradients with the formed blocks: a block."""

    implicit: float = 0.0
    """A product without them: an observation."""

    coarse: float = 0.0
    """Forming the coarse system of the two-level preconditioner: an observation."""

    @property
    def seconds(self) -> float:
        """Time that these amounts take."""
        return sum(amount * each for amount, each in zip(self, SECONDS, strict=True))


SECONDS = Work(
    step=1.8e-4,
    observation=1.7e-7,
    pair=2.0e-8,
    dense_product=2.7e-11,
    square=4.8e-9,
    cube=2.7e-12,
    band=4.2e-11,
    block=1.1e-7,
    implicit=1.7e-8,
    coarse=6.6e-8,
)
"""Fitted to steps with three point iterations in float64 on two cores of an x86-64 processor with AVX-512:
`python -m benchmarks.choice --fit`."""

ASSUMED_PRODUCTS = 12
"""Conjugate gradient iterations assumed for one step with the two-level preconditioner, which takes 6 to 20 on the
problems at hand."""

INEXACT_ITERATIONS = 1.2
"""Iterations to convergence that truncated conjugate gradients take, relative to a factorisation: geometric mean over
bulani1, bulani2, bulani4 and the rules ceres, ceres+refine3 and learned, which range from 0.8 to 2.0."""

TIED_COPIES = 5
"""The reduced camera system, its mirror image, the tied one, that scaled, its factor."""

DENSE_COPIES = 4
"""The reduced camera system, its blocks' copy, its mirror image, its factor (linear/blocks.py, linear/cholesky.py)."""

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
    """Predicted seconds per iteration; infinite where memory would not do."""

    explicit: float
    sparse: float
    implicit: float


def work(
    problem: BundleProblem, products: float = ASSUMED_PRODUCTS, observations: ObservationOrder | None = None
) -> dict[str, Work]:
    """Work of one iteration with each linear solver that has the memory for it.

    Args:
        problem: gives the numbers of cameras, observations, pairs and co-visible blocks.
        products: of conjugate gradients, where they are used.
        observations: of the problem, where they are sorted already.
    """
    sorted_ = observations or ObservationOrder.of(problem)
    counts, observed = count_pairs(problem, sorted_), problem.num_observations
    every = Work(step=1.0, observation=observed)
    blocks = _bytes_of_blocks(counts)
    solvers = {"implicit": every._replace(coarse=observed, implicit=products * observed)}
    if blocks <= MAX_BYTES:
        solvers["sparse"] = every._replace(coarse=observed, block=products * counts.blocks, pair=counts.pairs)
    explicit, needed = _factoring(sorted_, counts, blocks)
    if needed <= MAX_BYTES:
        solvers["explicit"] = explicit._replace(step=1.0, observation=observed)
    return solvers


def _factoring(observations: ObservationOrder, counts: PairCounts, blocks: float) -> tuple[Work, float]:
    """Work of forming and factoring the system, and the bytes that it takes."""
    unknowns, band, points = 9.0 * observations.num_cameras, 9.0 * counts.reach, observations.num_observed_points
    if _is_dense(observations):
        if has_small_capacitance(points + 1, observations.num_cameras):
            side, inner = 3.0 * (points + 1), unknowns
        else:
            side, inner = unknowns, 3.0 * points
        forming = Work(dense_product=side**2 * inner, square=side**2, cube=side**3)
        return forming, 3 * 8 * side * inner
    forming = Work(pair=counts.pairs)
    if is_banded(observations.num_cameras, counts.reach):
        return forming._replace(band=unknowns * band**2), blocks + 3 * 8 * unknowns * band
    return forming._replace(square=unknowns**2, cube=unknowns**3), blocks + DENSE_COPIES * 8 * unknowns**2


def predict(problem: BundleProblem, observations: ObservationOrder | None = None) -> SolverCosts:
    """Costs of one iteration with each linear solver."""
    solvers = work(problem, observations=observations)
    return SolverCosts(*(solvers[name].seconds if name in solvers else np.inf for name in SolverCosts._fields))


def _is_dense(observations: ObservationOrder) -> bool:
    """Whether the explicit solver will form the system as one dense product, or a matrix of the points' size."""
    columns = observations.num_observed_points + 1
    if not has_dense_shape(observations.tracks, observations.num_cameras, columns):
        return False
    return not observations.num_repeated_pairs


class PairCounts(NamedTuple):
    """What the size of the reduced camera system follows from."""

    pairs: int  # pairs of observations of one point
    blocks: int  # pairs of cameras that share a point; a camera pairs with itself
    reach: int  # in the better order of cameras, the largest distance of two that share a point


def count_pairs(problem: BundleProblem, observations: ObservationOrder | None = None) -> PairCounts:
    """Counts pairs; blocks and reach are exact up to `MAX_COUNTED_PAIRS` pairs, else upper bounds."""
    observations = observations or ObservationOrder.of(problem)
    pairs, cameras, tracks = observations.num_pairs, observations.num_cameras, observations.tracks
    if pairs > MAX_COUNTED_PAIRS or cameras > MAX_COUNTED_CAMERAS:
        return PairCounts(pairs, min(pairs, cameras * (cameras + 1) // 2), cameras)
    camera, start = observations.camera, observations.start[:-1]
    shared = np.zeros((cameras, cameras), bool)
    for length in np.unique(tracks[tracks > 0]):
        first = start[tracks == length][:, None]
        row, column = np.tril_indices(length)
        shared[camera[first + row], camera[first + column]] = True
    rows, columns = np.nonzero(shared)
    return PairCounts(pairs, len(rows), camera_order(rows, columns, cameras)[1])


def choose(problem: BundleProblem, observations: ObservationOrder | None = None) -> LinearSolver:
    """The solver with the lowest predicted time to the end; a tie goes to the more exact one."""
    times = {
        name: time if name == "explicit" else INEXACT_ITERATIONS * time
        for name, time in predict(problem, observations)._asdict().items()
    }
    return min(times, key=lambda name: times[name])  # type: ignore[return-value]


def choose_linear_solver(
    problem: BundleProblem,
    options: StepOptions,
    asked: LinearSolverChoice,
    observations: ObservationOrder | None = None,
) -> StepOptions:
    """Options with the linear solver that was asked for.

    Args:
        problem: decides `auto`.
        options: of the step.
        asked: `auto` or a name. A method in the place of plain LM has its own solver and leaves no choice. Fixed
            intrinsics leave the explicit one.
        observations: of the problem, where they are sorted already.

    Raises:
        ValueError: a method, and a solver asked for by name.
        ProblemError: cameras share a lens, or some of it stays, and another than the explicit solver was asked for; or
            a factorisation would take more memory than there is.
    """
    if options.method is not None and asked != "auto":
        raise ValueError(f"linear solver {asked!r} is for plain LM steps; {options.method.name} has its own")
    if problem.lenses is not None and options.intrinsics == "free":
        if options.method is not None or asked not in ("auto", "explicit"):
            refused = asked if options.method is None else f"by {options.method.name}"
            raise ProblemError(f"shared or partly fixed lenses need plain LM, solved explicitly, not {refused}")
        asked = "explicit"
    if options.method is not None:
        return options
    if asked == "auto" and options.intrinsics == "free":
        return replace(options, linear_solver=choose(problem, observations))  # it looks at memory itself
    asked = "explicit" if asked == "auto" else asked
    if asked == "explicit":
        _check_memory(problem, observations)
    return replace(options, linear_solver=asked)


def _check_memory(problem: BundleProblem, observations: ObservationOrder | None) -> None:
    """Refuses what takes more memory to factor than the machine has. Shared lenses break bands and blocks."""
    try:
        there = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError, OSError):
        return
    shared = problem.lenses is not None and problem.lenses.shared
    copies = TIED_COPIES if shared else DENSE_COPIES
    needed = copies * 8.0 * (CAMERA_SIZE * problem.num_cameras) ** 2
    if not shared:
        observations = observations or ObservationOrder.of(problem)
        most = observations.num_pairs
        needed += _bytes_of_blocks(PairCounts(most, min(most, problem.num_cameras**2), 0))
        if needed > there:  # so it is without counting: there may be a band
            counts = count_pairs(problem, observations)
            needed = _factoring(observations, counts, _bytes_of_blocks(counts))[1]
    if needed > there:
        of, way = (" with shared lenses", "; with fixed intrinsics they may take less") if shared else ("", "")
        raise ProblemError(
            f"{problem.num_cameras} cameras{of} take some {needed / 1e9:.0f} GB to "
            f"solve by a factorisation, more than the {there / 1e9:.0f} GB of this machine{way}"
        )


def _bytes_of_blocks(counts: PairCounts) -> float:
    return counts.pairs * BYTES_PER_PAIR + counts.blocks * BYTES_PER_BLOCK
