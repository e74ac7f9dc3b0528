"""Results of a reproduction run on disk, one JSON object per line.

`solves.jsonl` has solves of single problems in the format of `jaxba-bench`. `plays.jsonl` has runs of a policy on a
whole set of small scenes, a line for each policy and seed. A killed run loses at most the line that it was writing.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from jaxba.io import json_lines
from jaxba.solver.record import Record

T = TypeVar("T")

SOLVES, PLAYS = "solves.jsonl", "plays.jsonl"


@dataclass(frozen=True)
class Play:
    """Solves of all scenes of a set with one policy. Tuples have an entry for each scene."""

    scenes: str
    """Name of the set of scenes."""

    method: str
    """Name of the policy."""

    seed: int
    """Number of the training run, from 0; 0 for rules."""

    iterations: tuple[int, ...]
    """Linear solves."""

    converged: tuple[bool, ...]
    """Whether the solve converged before the limit of iterations."""

    near: tuple[float, ...]
    """Linear solves until the cost is within 1e-3 of the best known cost; infinite (null in the file) if never."""

    end: tuple[float, ...]
    """Final cost relative to the best known cost, minus 1."""

    first: tuple[tuple[float, ...], ...]
    """First lambdas of each solve."""

    seconds: float
    """Time for all scenes together, including compilation, and so not a measure of speed."""

    def __post_init__(self) -> None:
        for name in ("near", "end"):  # null in the file is read as NaN
            never = tuple(math.inf if math.isnan(x) else x for x in getattr(self, name))
            object.__setattr__(self, name, never)


class Store:
    """The results in the folder of a run. Only one process may write at a time."""

    def __init__(self, folder: Path) -> None:
        """Reads the existing results.

        Raises:
            ProblemError: a file is damaged; the message names the file and the line.
        """
        self.folder = folder
        self.solves = _read(folder / SOLVES, Record)
        self.plays = _read(folder / PLAYS, Play)

    def solve(self, problem: str, solver: str, repeat: int) -> Record | None:
        """The record of a solve, None if there is none."""
        wanted = (problem, solver, repeat)
        return next((r for r in self.solves if (r.problem, r.solver, r.repeat) == wanted), None)

    def play(self, scenes: str, method: str, seed: int) -> Play | None:
        """The play of a policy on a set of scenes, None if there is none."""
        wanted = (scenes, method, seed)
        return next((p for p in self.plays if (p.scenes, p.method, p.seed) == wanted), None)

    def add_solve(self, record: Record) -> None:
        """Appends a line to the file, followed by fsync. Raises OSError."""
        json_lines.append(self.folder / SOLVES, record)
        self.solves.append(record)

    def add_play(self, play: Play) -> None:
        """Appends a line to the file, followed by fsync. Raises OSError."""
        json_lines.append(self.folder / PLAYS, play)
        self.plays.append(play)

    def solves_of(self, problems: Sequence[str], solvers: Sequence[str]) -> list[Record]:
        """The solves of the given problems by the given solvers, in the order of these lists."""
        rank = lambda r: (problems.index(r.problem), solvers.index(r.solver), r.repeat)
        return sorted((r for r in self.solves if r.problem in problems and r.solver in solvers), key=rank)


def _read(path: Path, kind: type[T]) -> list[T]:
    return json_lines.read(path, kind) if path.is_file() else []
