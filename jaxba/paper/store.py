"""What a reproduction run has done, on the disk: one JSON object a line, found again by what was run.

`solves.jsonl` holds solves of single problems in the format of `jaxba-bench`; `plays.jsonl` holds policies on whole
sets of small scenes, a line per policy and seed. A killed run loses the line it was about to write.
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
    """A policy on every scene of a set. Lists have an entry per scene."""

    scenes: str
    """Name of the set."""

    method: str
    """Name of the policy."""

    seed: int
    """Of the training; 0 for rules."""

    iterations: tuple[int, ...]
    """Linear solves until the end."""

    converged: tuple[bool, ...]
    """Whether the stop rule ended it, and not the limit."""

    near: tuple[float, ...]
    """Linear solves until within 1e-3 of the best known cost; infinite (null in the file) if never."""

    end: tuple[float, ...]
    """Last accepted cost over the best known, less one."""

    first: tuple[tuple[float, ...], ...]
    """First lambdas of each solve."""

    seconds: float
    """For all scenes together, compilation included: no measure of speed."""


def play_to_json(play: Play) -> dict[str, Any]:
    """The object to write; infinity becomes null."""
    data = asdict(play)
    data["near"] = [x if math.isfinite(x) else None for x in play.near]
    data["end"] = [x if math.isfinite(x) else None for x in play.end]
    return data


def play_from_json(data: Mapping[str, Any]) -> Play:
    """The inverse of `play_to_json`.

    Raises:
        KeyError, TypeError: it is something else.
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
    """All lines of a run's folder. One process may write at a time."""

    def __init__(self, folder: Path) -> None:
        """Reads what is there.

        Raises:
            ProblemError: a file is damaged; one line that names it.
        """
        self.folder = folder
        path = folder / SOLVES
        self.solves: list[Record] = read_records(path) if path.is_file() else []
        self.plays = _read_plays(folder / PLAYS)

    def solve(self, problem: str, solver: str, repeat: int) -> Record | None:
        """The solve of a problem by a solver."""
        wanted = (problem, solver, repeat)
        return next((r for r in self.solves if (r.problem, r.solver, r.repeat) == wanted), None)

    def play(self, scenes: str, method: str, seed: int) -> Play | None:
        """A policy on a set of scenes."""
        wanted = (scenes, method, seed)
        return next((p for p in self.plays if (p.scenes, p.method, p.seed) == wanted), None)

    def add_solve(self, record: Record) -> None:
        """Appends a line, on the disk when this returns. Raises OSError."""
        append_record(self.folder / SOLVES, record)
        self.solves.append(record)

    def add_play(self, play: Play) -> None:
        """Appends a line, on the disk when this returns. Raises OSError."""
        line = json.dumps(play_to_json(play), allow_nan=False, separators=(",", ":")).encode() + b"\n"
        with (self.folder / PLAYS).open("ab") as file:
            file.write(line)
            file.flush()
            os.fsync(file.fileno())
        self.plays.append(play)

    def solves_of(self, problems: Sequence[str], solvers: Sequence[str]) -> list[Record]:
        """The solves of some problems by some solvers, in the order of those lists."""
        rank = lambda r: (problems.index(r.problem), solvers.index(r.solver), r.repeat)
        return sorted((r for r in self.solves if r.problem in problems and r.solver in solvers), key=rank)


def _read_plays(path: Path) -> list[Play]:
    if not path.is_file():
        return []
    *lines, rest = path.read_bytes().split(b"\n")
    if rest:  # what a kill left half-written
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
