"""Results of a reproduction run on disk, one JSON object per line.

`solves.jsonl` has solves of single problems in the format of `jaxba-bench`. `plays.jsonl` has runs of a policy on a
whole set of small scenes, a line for each policy and seed. A killed run loses at most the line that it was writing.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from jaxba.bench.records import Record, append_record, read_records
from jaxba.problem.bundle_problem import ProblemError

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


def play_to_json(play: Play) -> dict[str, Any]:
    """The JSON object of a play; infinity becomes null."""
    data = asdict(play)
    data["near"] = [x if math.isfinite(x) else None for x in play.near]
    data["end"] = [x if math.isfinite(x) else None for x in play.end]
    return data


def play_from_json(data: Mapping[str, Any]) -> Play:
    """The inverse of `play_to_json`.

    Raises:
        KeyError, TypeError: the object has another form.
    """
    numbers = lambda name: tuple(math.inf if x is None else float(x) for x in data[name])
    return Play(
        scenes=str(data["scenes"]),
        method=str(data["method"]),
        seed=int(data["seed"]),
        iterations=tuple(int(x) for x in data["iterations"]),
        converged=tuple(bool(x) for x in data["converged"]),
        near=numbers("near"),
        end=numbers("end"),
        first=tuple(tuple(float(x) for x in row) for row in data["first"]),
        seconds=float(data["seconds"]),
    )


class Store:
    """The results in the folder of a run. Only one process may write at a time."""

    def __init__(self, folder: Path) -> None:
        """Reads the existing results.

        Raises:
            ProblemError: a file is damaged; the message names the file and the line.
        """
        self.folder = folder
        path = folder / SOLVES
        self.solves: list[Record] = read_records(path) if path.is_file() else []
        self.plays = _read_plays(folder / PLAYS)

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
        append_record(self.folder / SOLVES, record)
        self.solves.append(record)

    def add_play(self, play: Play) -> None:
        """Appends a line to the file, followed by fsync. Raises OSError."""
        line = json.dumps(play_to_json(play), allow_nan=False, separators=(",", ":")).encode() + b"\n"
        with (self.folder / PLAYS).open("ab") as file:
            file.write(line)
            file.flush()
            os.fsync(file.fileno())
        self.plays.append(play)

    def solves_of(self, problems: Sequence[str], solvers: Sequence[str]) -> list[Record]:
        """The solves of the given problems by the given solvers, in the order of these lists."""
        rank = lambda r: (problems.index(r.problem), solvers.index(r.solver), r.repeat)
        return sorted((r for r in self.solves if r.problem in problems and r.solver in solvers), key=rank)


def _read_plays(path: Path) -> list[Play]:
    if not path.is_file():
        return []
    *lines, rest = path.read_bytes().split(b"\n")
    if rest:  # an incomplete line of a killed run
        with path.open("r+b") as file:
            file.truncate(path.stat().st_size - len(rest))
    plays = []
    for number, line in enumerate(lines, start=1):
        if not line.strip():
            continue
        try:
            plays.append(play_from_json(json.loads(line)))
        except (ValueError, KeyError, TypeError) as error:
            raise ProblemError(f"{path}, line {number}: not a line of this program ({type(error).__name__})") from None
    return plays
