"""The C++ Ceres peer: a program that reads a BAL file and prints one JSON line.

`JAXBA_CERES` names it. It takes `FILE --linear MODE --threads N --max_iter K` and prints a line with `iterations`,
`final_cost`, `total_s` and the lists `costs` and `times` (seconds of each iteration, the first being the start).
"""

from __future__ import annotations

import json
import os
import subprocess
from dataclasses import dataclass
from pathlib import Path

MODES = ("DENSE_SCHUR", "SPARSE_SCHUR", "ITERATIVE_SCHUR")
"""Ceres' linear solvers for bundle adjustment; the iterative one preconditions with SCHUR_JACOBI."""

VARIABLE = "JAXBA_CERES"
"""Environment variable with the path of the program."""


@dataclass(frozen=True)
class CeresRun:
    """One solve by Ceres."""

    mode: str
    iterations: int
    initial_cost: float
    final_cost: float
    total_s: float
    costs: list[float]
    times: list[float]

    @property
    def seconds_per_iteration(self) -> float:
        """Whole solve over iterations, so Ceres' own set-up is in it."""
        return self.total_s / max(1, self.iterations)

    def seconds_to(self, cost: float) -> float:
        """Time at which the cost was first at or below `cost`; infinity if never."""
        passed = 0.0
        for value, seconds in zip(self.costs, self.times, strict=True):
            passed += seconds
            if value <= cost:
                return passed
        return float("inf")


def program() -> Path | None:
    """The peer, where the machine has it."""
    name = os.environ.get(VARIABLE, "")
    return Path(name) if name and Path(name).is_file() else None


def run(binary: Path, file: Path, mode: str, threads: int, max_iterations: int, limit_s: float = 600) -> CeresRun:
    """Solves a plain BAL file under Ceres' own rule."""
    command = [str(binary), str(file), "--linear", mode, "--threads", str(threads), "--max_iter", str(max_iterations)]
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
