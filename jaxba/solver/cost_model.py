"""Predicted time and memory of an iteration with each solver of the reduced camera system, from measured constants.

The time of an iteration is a sum of amounts of work (observations, pairs, cubes of unknowns, ...) times fitted seconds
per unit. Only ratios matter for the choice, and they differ little between machines.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from jaxba.problem.bundle_problem import CAMERA_SIZE, BundleProblem
from jaxba.problem.intrinsics import POSE_SIZE
from jaxba.problem.rigs import EXTRINSICS_SIZE
from jaxba.structure.camera_ordering import camera_order, is_banded
from jaxba.structure.density import has_small_capacitance, is_dense
from jaxba.structure.observation_order import ObservationOrder


class Work(NamedTuple):
    """Amounts of work of an iteration by kind, or seconds per unit of each kind (`SECONDS`)."""

    step: float = 0.0
    """Constant cost of an iteration."""

    observation: float = 0.0
    """Work outside the linear solve: observations that are linearised, eliminated and evaluated."""

    pair: float = 0.0
    """Forming the blocks: pairs of observations of one point."""

    dense_product: float = 0.0
    """Forming the system as one dense matrix product (structure/density.py): multiply-add operations."""

    square: float = 0.0
    """Dense factorisation, memory traffic and single-core part: unknowns squared."""

    cube: float = 0.0
    """Dense factorisation: unknowns cubed."""

    band: float = 0.0
    """Band factorisation: unknowns times the square of the unknowns of the bandwidth."""

    block: float = 0.0
    """Products of conjugate gradients with formed blocks: blocks."""

    implicit: float = 0.0
    """Products of conjugate gradients without forming the system: observations."""

    coarse: float = 0.0
    """Forming the coarse system of the two-level preconditioner: observations."""

    @property
    def seconds(self) -> float:
        """Predicted time of these amounts."""
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
"""Assumed conjugate gradient iterations of a step with the two-level preconditioner. Measured: 6 to 20 on real
problems."""

INEXACT_ITERATIONS = 1.2
"""Iterations to convergence with truncated conjugate gradients, relative to a factorisation. Measured: geometric mean
over bulani1, bulani2, bulani4 and the policies ceres, ceres+refine3 and learned, which range from 0.8 to 2.0."""

DENSE_MATRICES = 4
"""Matrices of that size in memory for a dense factorisation: the system, a copy of its blocks, its transpose, its
factor."""

MAX_BYTES = 4e9
"""Largest memory of a solver that `auto` may choose."""

BYTES_PER_OBSERVATION = 1100.0
"""Device memory of one implicit step in float64: arguments, results and temporaries; half of it in float32. Measured:
1,072 on a scene of the size of Ladybug-1197."""

BYTES_PER_PAIR = 16.0
"""Index arrays with padding; the products are computed in batches."""

MATRICES_PER_BLOCK = 3
"""Numbers in memory per number of a block: its own, its partial sums and its sum."""

MAX_COUNTED_PAIRS = 20_000_000
"""Most pairs for which blocks are counted, which takes less than a second."""

MAX_COUNTED_CAMERAS = 20_000
"""Most cameras for which blocks are counted: the table takes a byte per pair of cameras."""


class SolverCosts(NamedTuple):
    """Predicted seconds per iteration; infinite if a solver needs more than `MAX_BYTES`."""

    explicit: float
    sparse: float
    implicit: float


def work(
    problem: BundleProblem, products: float = ASSUMED_PRODUCTS, observations: ObservationOrder | None = None
) -> dict[str, Work]:
    """Work of one iteration with each linear solver that needs at most `MAX_BYTES`.

    Args:
        problem: determines the numbers of cameras, observations, pairs and co-visible blocks.
        products: number of products of conjugate gradients in a step.
        observations: the sorted observations of the problem, if they are known already.
    """
    order = observations or ObservationOrder.of(problem)
    counts, observed = count_pairs(problem, order), problem.num_observations
    every = Work(step=1.0, observation=observed)
    blocks = _bytes_of_blocks(counts, _width(problem))
    solvers = {"implicit": every._replace(coarse=observed, implicit=products * observed)}
    if blocks <= MAX_BYTES:
        solvers["sparse"] = every._replace(coarse=observed, block=products * counts.blocks, pair=counts.pairs)
    explicit, needed = _factoring(order, counts, blocks, _width(problem), problem.rigs is not None)
    if needed <= MAX_BYTES:
        solvers["explicit"] = explicit._replace(step=1.0, observation=observed)
    return solvers


def _factoring(
    observations: ObservationOrder, counts: PairCounts, blocks: float, width: int, rigs: bool
) -> tuple[Work, float]:
    """Work of forming and factoring the system, and the memory that it needs, bytes.

    Args:
        observations: sorted observations of the problem.
        counts: pairs and blocks.
        blocks: memory of the blocks, bytes.
        width: unknowns of a camera.
        rigs: whether cameras move together, so that the system is dense.
    """
    unknowns, band = float(width * observations.num_cameras), float(width * counts.bandwidth)
    points = observations.num_observed_points
    if _is_dense(observations):
        if has_small_capacitance(points + 1, observations.num_cameras):
            side, inner = 3.0 * (points + 1), unknowns
        else:
            side, inner = unknowns, 3.0 * points
        forming = Work(dense_product=side**2 * inner, square=side**2, cube=side**3)
        return forming, 3 * 8 * side * inner
    forming = Work(pair=counts.pairs)
    if not rigs and is_banded(observations.num_cameras, counts.bandwidth):
        return forming._replace(band=unknowns * band**2), blocks + 3 * 8 * unknowns * band
    return forming._replace(square=unknowns**2, cube=unknowns**3), blocks + DENSE_MATRICES * 8 * unknowns**2


def predict(problem: BundleProblem, observations: ObservationOrder | None = None) -> SolverCosts:
    """Predicted time of one iteration with each linear solver. Arguments as for `work`."""
    solvers = work(problem, observations=observations)
    return SolverCosts(*(solvers[name].seconds if name in solvers else np.inf for name in SolverCosts._fields))


def _is_dense(observations: ObservationOrder) -> bool:
    """Whether the explicit solver forms the system as one dense product, or uses Woodbury's identity."""
    return is_dense(observations, observations.num_cameras, observations.num_observed_points + 1)


class PairCounts(NamedTuple):
    """Numbers that determine the size of the reduced camera system."""

    pairs: int  # pairs of observations of one point, an observation with itself included
    blocks: int  # pairs of cameras with common points, a camera with itself included
    bandwidth: int  # largest distance of two such cameras in the better ordering


def count_pairs(problem: BundleProblem, observations: ObservationOrder | None = None) -> PairCounts:
    """Counts pairs and blocks. Blocks and bandwidth are upper bounds for more than `MAX_COUNTED_PAIRS` pairs."""
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


def _bytes_of_blocks(counts: PairCounts, width: int) -> float:
    """Memory of the blocks and of the index arrays that form them."""
    return counts.pairs * BYTES_PER_PAIR + counts.blocks * MATRICES_PER_BLOCK * 8.0 * width**2


def _width(problem: BundleProblem) -> int:
    """Unknowns of a camera's block."""
    lenses, rigs = problem.lenses, problem.rigs
    extrinsics = 0 if rigs is None or rigs.free is None else EXTRINSICS_SIZE
    own = CAMERA_SIZE if lenses is None else POSE_SIZE + int(np.asarray(lenses.free).any(axis=0).sum())
    return own + extrinsics


def most_bytes(problem: BundleProblem, observations: ObservationOrder) -> float:
    """Upper bound of the memory of a factorisation."""
    width, most = _width(problem), observations.num_pairs
    blocks = _bytes_of_blocks(PairCounts(most, min(most, problem.num_cameras**2), 0), width)
    return DENSE_MATRICES * 8.0 * (width * problem.num_cameras) ** 2 + blocks


def factoring_bytes(problem: BundleProblem, observations: ObservationOrder) -> float:
    """Memory of a factorisation."""
    width, counts = _width(problem), count_pairs(problem, observations)
    return _factoring(observations, counts, _bytes_of_blocks(counts, width), width, problem.rigs is not None)[1]
