"""Choice of the linear solver, and refusal of what a method does not support or a machine cannot
factor.

The predicted time of an iteration is a sum of amounts of work (observations, pairs, cubes of
unknowns, ...) times measured seconds per unit. Only ratios matter for the choice, and they differ
little between machines."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from jaxba.lm.method import check_plain
from jaxba.problem.bundle_problem import CAMERA_SIZE, BundleProblem, ProblemError
from jaxba.problem.intrinsics import POSE_SIZE
from jaxba.problem.options import LinearSolver, LinearSolverChoice, StepOptions
from jaxba.problem.rigs import EXTRINSICS_SIZE
from jaxba.runtime import process
from jaxba.structure.camera_ordering import camera_order, is_banded
from jaxba.structure.density import has_small_capacitance, is_dense
from jaxba.structure.observation_order import ObservationOrder
from jaxba.structure.residual_slots import stands_for_rows

Work = dict[str, Any]
"""Amounts of work of an iteration, by the keys of `SECONDS`."""

SECONDS: Work = {
    "step": 1.8e-4,  # constant cost of an iteration
    "observation": 1.7e-7,  # observations that are linearised, eliminated and evaluated
    "pair": 2.0e-8,  # forming the blocks: pairs of observations of one point
    # forming the system as one dense product (structure/density.py): multiply-add operations
    "dense_product": 2.7e-11,
    "square": 4.8e-9,  # dense factorisation, memory traffic and single-core part: unknowns squared
    "cube": 2.7e-12,  # dense factorisation: unknowns cubed
    # band factorisation: unknowns times the square of the unknowns of the bandwidth
    "band": 4.2e-11,
    "block": 1.1e-7,  # products of conjugate gradients with formed blocks: blocks
    "implicit": 1.7e-8,  # products of conjugate gradients without forming the system: observations
    "coarse": 6.6e-8,  # forming the coarse system of the two-level preconditioner: observations
}
"""Seconds per unit of each kind of work. Fitted to steps with three point iterations in float64 on
two cores of an x86-64 processor with AVX-512: `python -m benchmarks.choice --fit`."""

ASSUMED_PRODUCTS = 12.0
"""Assumed conjugate gradient iterations of a step with the two-level preconditioner. Measured: 6 to
20 on real problems."""

INEXACT_ITERATIONS = 1.2
"""Iterations to convergence with truncated conjugate gradients, relative to a factorisation.
Measured: geometric mean over bulani1, bulani2, bulani4 and the policies ceres, ceres+refine3 and
learned, which range from 0.8 to 2.0."""

LEAST_GAIN = 2e-3
"""Seconds of an iteration that conjugate gradients must save. A whole solve saves less than it
takes to compile where they save less, and a factorisation takes the fewest iterations, however
priors and constants scale the system."""

DENSE_MATRICES = 4
"""Matrices of that size in memory for a dense factorisation: the system, a copy of its blocks, its
transpose, its factor."""

MAX_BYTES = 4e9  # largest memory of a solver that `auto` may choose

BYTES_PER_PAIR = 16.0  # index arrays with padding; the products are computed in batches
# numbers in memory per number of a block: its own, its partial sums and its sum
MATRICES_PER_BLOCK = 3
# most pairs for which blocks are counted, which takes less than a second
MAX_COUNTED_PAIRS = 20_000_000
# most cameras for which blocks are counted: the table takes a byte per pair of cameras
MAX_COUNTED_CAMERAS = 20_000


class PairCounts(NamedTuple):
    """Numbers that determine the size of the reduced camera system."""

    pairs: int  # pairs of observations of one point, an observation with itself included
    blocks: int  # pairs of cameras with common points, a camera with itself included
    bandwidth: int  # largest distance of two such cameras in the better ordering


def choose_linear_solver(
    problem: BundleProblem,
    options: StepOptions,
    asked: LinearSolverChoice,
    observations: ObservationOrder | None = None,
) -> StepOptions:
    """The step options with the linear solver that is asked for, `auto` or a name; methods have
    their own. `observations` are the sorted ones of the problem, if they are known already. Raises
    ProblemError: a method is asked for that does not support the problem; or a factorisation needs
    more memory than the machine has."""
    lenses = problem.lenses
    rigs = problem.rigs
    if options.method:
        shared = lenses is not None and lenses.shared and np.asarray(lenses.free).any()
        check_plain(
            options,
            ProblemError,
            rigs=rigs is not None,
            shared_lenses=bool(shared) and options.intrinsics == "free",
            residuals=bool(problem.residuals),
        )
        return options
    if asked == "auto":
        return replace(options, linear_solver=choose(problem, observations))
    if asked == "explicit":
        _check_memory(
            observations or ObservationOrder.of(problem), _width(problem), rigs is not None
        )
    return replace(options, linear_solver=asked)


def choose(problem: BundleProblem, observations: ObservationOrder | None = None) -> LinearSolver:
    """The linear solver with the lowest predicted time to convergence, a factorisation where
    another one gains little (`LEAST_GAIN`). Without pixels, as in a pose graph, it is a
    factorisation if memory allows: conjugate gradients take some 75 products a step there, and
    twice to six times the iterations (`python -m benchmarks.pose_graph --linear-solver implicit`).
    Arguments as for `work`."""
    predicted = predict(problem, observations)
    if problem.residuals and stands_for_rows(problem).all() and np.isfinite(predicted["explicit"]):
        return "explicit"

    def inexact(time):
        return max(INEXACT_ITERATIONS * time, time + LEAST_GAIN)

    times = {
        name: time if name == "explicit" else inexact(time) for name, time in predicted.items()
    }
    return min(times, key=lambda name: times[name])  # type: ignore[return-value]


def predict(
    problem: BundleProblem, observations: ObservationOrder | None = None
) -> dict[str, float]:
    """Predicted seconds of one iteration with each linear solver, infinite if it needs more than
    `MAX_BYTES`. Arguments as for `work`."""
    amounts = work(problem, observations=observations)
    return {
        n: seconds(amounts[n]) if n in amounts else np.inf
        for n in ("explicit", "sparse", "implicit")
    }


def seconds(amounts: Work) -> float:
    """Predicted time of amounts of work."""
    return sum(amount * SECONDS[kind] for kind, amount in amounts.items())


def work(
    problem: BundleProblem,
    products: float = ASSUMED_PRODUCTS,
    observations: ObservationOrder | None = None,
) -> dict[str, Work]:
    """Work of one iteration with each linear solver that needs at most `MAX_BYTES`. `products` is
    the number of products of conjugate gradients in a step; `observations` are the sorted ones of
    the problem, if they are known already."""
    order = observations or ObservationOrder.of(problem)
    width = _width(problem)
    counts = count_pairs(order)
    observed = len(order.order)
    every = {"step": 1.0, "observation": observed}
    solvers = {"implicit": implicit_work(observed, products)}
    if _bytes_of_blocks(counts, width) <= MAX_BYTES:
        solvers["sparse"] = every | {
            "coarse": observed,
            "block": products * counts.blocks,
            "pair": counts.pairs,
        }
    factoring, needed = _factoring(order, counts, width, problem.rigs is not None)
    if needed <= MAX_BYTES:
        solvers["explicit"] = every | factoring
    return solvers


def implicit_work(observed: int, products: float = ASSUMED_PRODUCTS) -> Work:
    """Work of one iteration of so many observations with `implicit`."""
    return {
        "step": 1.0,
        "observation": observed,
        "coarse": observed,
        "implicit": products * observed,
    }


def count_pairs(observations: ObservationOrder) -> PairCounts:
    """Counts pairs and blocks. Blocks and bandwidth are upper bounds for more than
    `MAX_COUNTED_PAIRS` pairs."""
    pairs = observations.num_pairs
    cameras = observations.num_cameras
    tracks = observations.moving_tracks
    if pairs > MAX_COUNTED_PAIRS or cameras > MAX_COUNTED_CAMERAS:
        return _most_pairs(observations)
    camera = observations.camera[observations.moves]
    start = np.cumsum(tracks) - tracks
    shared = np.zeros((cameras, cameras), bool)
    for length in np.unique(tracks[tracks > 0]):
        first = start[tracks == length][:, None]
        row, column = np.tril_indices(length)
        shared[camera[first + row], camera[first + column]] = True
    rows, columns = np.nonzero(shared)
    return PairCounts(pairs, len(rows), camera_order(rows, columns, cameras)[1])


def _most_pairs(observations: ObservationOrder) -> PairCounts:
    """Upper bounds of blocks and bandwidth."""
    pairs = observations.num_pairs
    cameras = observations.num_cameras
    return PairCounts(pairs, min(pairs, cameras * (cameras + 1) // 2), cameras)


def _factoring(
    observations: ObservationOrder, counts: PairCounts, width: int, rigs: bool
) -> tuple[Work, float]:
    """Work of forming and factoring the system, and the memory that it needs, bytes. `counts` are
    those of pairs and blocks, `width` is the number of unknowns of a camera. In `rigs` cameras move
    together, so that the system is dense."""
    unknowns = float(width * observations.num_cameras)
    band = float(width * counts.bandwidth)
    points = observations.num_observed_points
    cameras = observations.num_cameras
    if is_dense(observations, cameras, points + 1):
        side = unknowns
        inner = 3.0 * points
        if has_small_capacitance(points + 1, cameras):
            side = 3.0 * (points + 1)
            inner = unknowns
        return {
            "dense_product": side**2 * inner,
            "square": side**2,
            "cube": side**3,
        }, 3 * 8 * side * inner
    forming = {"pair": counts.pairs}
    blocks = _bytes_of_blocks(counts, width)
    if not rigs and is_banded(cameras, counts.bandwidth):
        return forming | {"band": unknowns * band**2}, blocks + 3 * 8 * unknowns * band
    return forming | {
        "square": unknowns**2,
        "cube": unknowns**3,
    }, blocks + DENSE_MATRICES * 8 * unknowns**2


def _bytes_of_blocks(counts: PairCounts, width: int) -> float:
    """Memory of the blocks and of the index arrays that form them."""
    return counts.pairs * BYTES_PER_PAIR + counts.blocks * MATRICES_PER_BLOCK * 8.0 * width**2


def _width(problem: BundleProblem) -> int:
    """Unknowns of a camera's block."""
    lenses = problem.lenses
    rigs = problem.rigs
    extrinsics = 0 if rigs is None or rigs.free is None else EXTRINSICS_SIZE
    own = (
        CAMERA_SIZE
        if lenses is None
        else POSE_SIZE + int(np.asarray(lenses.free).any(axis=0).sum())
    )
    return own + extrinsics + sum(problem.residuals.sizes)


def _check_memory(observations: ObservationOrder, width: int, rigs: bool) -> None:
    """Raises a `ProblemError` if a factorisation needs more memory than the machine has."""
    available = process.memory()
    most = _bytes_of_blocks(_most_pairs(observations), width)
    needed = most + DENSE_MATRICES * 8.0 * (width * observations.num_cameras) ** 2
    if needed > available:  # an upper bound: count blocks and look for a band
        needed = _factoring(observations, count_pairs(observations), width, rigs)[1]
    if needed > available:
        raise ProblemError(
            f"{observations.num_cameras} cameras take some {needed / 1e9:.0f} GB to "
            f"solve by a factorisation, more than the {available / 1e9:.0f} GB of this machine"
        )
