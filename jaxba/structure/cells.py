"""Cells: the capacities to which many problems of different sizes are padded, so that they share
few programs.

They are chosen from the sizes of problems that were seen, as few or as many as make the predicted
time of compiling and solving the shortest."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxba.problem.bundle_problem import BundleProblem
from jaxba.structure.observation_order import ObservationOrder
from jaxba.structure.padding import MAX_CAMERAS, MAX_OBSERVATIONS, MAX_PAIRS, Capacity, slots_for

# sizes of cells are multiples of these, so that later problems fit
ROUNDED = np.array([1, 16, 64, 256])

FIXED_S = 5e-5
CUBE_S = 2.5e-11
EACH_S = np.array([1e-5, 7e-7, 2.7e-7, 6e-9])
"""Seconds of an iteration on one core: of any, for a cube of unknowns, and for each of `Sizes` that
is padding, on windows of 5 to 20 cameras, x86-64 with AVX-512. The work for the pairs that there
are is the same in every cell."""

ITERATIONS = 20  # iterations of a solve, as far as that matters for the number of cells
COMPILE_S = 8.0  # seconds in which one core traces and compiles the program of a cell


class Sizes(NamedTuple):
    """Sizes of a problem, or of a cell."""

    cameras: int
    points: int
    slots: int
    pairs: int
    # number of cameras that its cell must have, since not all that it holds can be padded; 0: any
    exactly: int

    @classmethod
    def of(cls, problem: BundleProblem) -> Sizes:
        """Those of a problem as it is laid out."""
        observations = ObservationOrder.of(problem)
        cameras = observations.num_cameras
        tracks = observations.tracks
        pairs = observations.num_listed_pairs
        slots = slots_for(tracks)
        general = problem.lenses or problem.rigs or problem.residuals
        return cls(cameras, len(tracks), slots, pairs, cameras if general else 0)

    @property
    def too_large(self) -> bool:
        """Whether it has no place in a cell."""
        return self.cameras > MAX_CAMERAS or self.slots > MAX_OBSERVATIONS or self.pairs > MAX_PAIRS

    @property
    def capacity(self) -> Capacity:
        """That of a cell."""
        return Capacity(self.cameras, self.points, self.slots, self.pairs, fixed=True)

    def fits(self, cell: Sizes) -> bool:
        """Whether a problem of these sizes can be padded to a cell."""
        within = all(own <= room for own, room in zip(self[:4], cell[:4], strict=True))
        return self.exactly == cell.exactly and within


def work(sizes: Int[np.ndarray, "n 4"]) -> Float[np.ndarray, " n"]:
    """Predicted seconds of an iteration, for rows of sizes."""
    return FIXED_S + np.asarray(sizes, float) @ EACH_S + CUBE_S * (9.0 * sizes[:, 0]) ** 3


def choose_cells(seen: Iterable[Sizes], times: float) -> list[Sizes]:
    """Cells for problems of such sizes, of which `times` as many are to come."""
    kinds: dict[int, list[Sizes]] = {}
    for one in (sizes for sizes in seen if not sizes.too_large):
        kinds.setdefault(one.exactly, []).append(one)
    return [cell for each in kinds.values() for cell in _cells_of_kind(each, times)]


def _cells_of_kind(seen: Sequence[Sizes], times: float) -> list[Sizes]:
    """Dynamic programming over problems sorted by work: a cell holds neighbours."""
    rows = -(-np.array([one[:4] for one in seen]) // ROUNDED) * ROUNDED
    rows, counts = np.unique(rows, axis=0, return_counts=True)
    order = np.argsort(work(rows), kind="stable")
    rows = rows[order]
    counts = counts[order] * times * ITERATIONS
    number = len(rows)
    before = np.concatenate([[0], np.cumsum(counts)])
    # of one cell, by the first of its rows and the one after them
    price = np.full((number + 1, number + 1), np.inf)
    for first in range(number):
        price[first, first + 1 :] = work(np.maximum.accumulate(rows[first:])) * (
            before[first + 1 :] - before[first]
        )
    best = price[0]
    cuts = []
    saved = np.inf
    while True:
        with_one_more = best[:, None] + price
        saved = best[-1] - with_one_more[:, -1].min()
        if saved <= COMPILE_S:
            break
        cuts.append(with_one_more.argmin(axis=0))
        best = with_one_more.min(axis=0)
    ends = [number]
    for cut in reversed(cuts):
        ends.append(int(cut[ends[-1]]))
    cells = (rows[first:last].max(axis=0) for first, last in itertools.pairwise(sorted({0, *ends})))
    return [Sizes._make([*cell.tolist(), seen[0].exactly]) for cell in cells]


NO_CELL = Sizes(0, 0, 0, 0, 0)  # of problems that fit none


def cell_for(sizes: Sizes, cells: Sequence[Sizes]) -> Sizes:
    """The cell in which a problem is the least work, or `NO_CELL`."""
    fitting = [cell for cell in cells if sizes.fits(cell)]
    return min(fitting, key=lambda cell: float(work(np.array([cell[:4]]))[0]), default=NO_CELL)
