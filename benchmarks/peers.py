"""Runs a program that solves a BAL file with C++ Ceres.

The environment variable `JAXBA_CERES` names the program. Its arguments are `FILE --linear MODE
--threads N --max_iter K`. Its last line of output is a JSON object with `iterations`,
`initial_cost`, `final_cost`, `total_s` and the lists `costs` and `times` (seconds of each
iteration; the first entry is the start)."""

from __future__ import annotations

import json
import os
import subprocess
from dataclasses import dataclass
from pathlib import Path

MODES = ("DENSE_SCHUR", "SPARSE_SCHUR", "ITERATIVE_SCHUR")
"""Ceres' linear solvers for bundle adjustment; the iterative one uses the preconditioner
SCHUR_JACOBI."""

VARIABLE = "JAXBA_CERES"
"""Environment variable with the path of the program."""


@dataclass(frozen=True)
class CeresRun:
    """A solve by Ceres."""

    mode: str
    iterations: int
    initial_cost: float
    final_cost: float
    total_s: float
    costs: list[float]
    times: list[float]

    @property
    def seconds_per_iteration(self) -> float:
        """Total time over iterations, and so including Ceres' set-up."""
        return self.total_s / max(1, self.iterations)

    def seconds_to(self, cost: float) -> float:
        """Seconds until the cost is at most `cost`; infinity if that never happens."""
        elapsed = 0.0
        for value, seconds in zip(self.costs, self.times, strict=True):
            elapsed += seconds
            if value <= cost:
                return elapsed
        return float("inf")


def program() -> Path | None:
    """Path of the program; None if there is none."""
    name = os.environ.get(VARIABLE, "")
    return Path(name) if name and Path(name).is_file() else None


def run(
    binary: Path, file: Path, mode: str, threads: int, max_iterations: int, limit_s: float = 600
) -> CeresRun:
    """Solves an uncompressed BAL file with Ceres.

    Args:
        binary: the program.
        file: the problem.
        mode: one of `MODES`.
        threads: threads of Ceres.
        max_iterations: limit of iterations.
        limit_s: limit of the time in seconds, after which `subprocess.TimeoutExpired` is raised.
    """
    command = [
        str(binary),
        str(file),
        "--linear",
        mode,
        "--threads",
        str(threads),
        "--max_iter",
        str(max_iterations),
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=limit_s, check=True)
    data = json.loads(done.stdout.strip().splitlines()[-1].replace("nan", "NaN"))
    return CeresRun(
        mode,
        data["iterations"],
        data["initial_cost"],
        data["final_cost"],
        data["total_s"],
        data["costs"],
        data["times"],
    )
