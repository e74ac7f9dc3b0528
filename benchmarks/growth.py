"""Seconds of an iteration and memory by the number of observations, from 30 thousand to 9 million.

    python -m benchmarks.growth [--sizes 30,100,300,1000,3000,9125] [--devices 1] [--figure FILE.png]

Random scenes with the proportions of BAL's Final-4585: 2,000 observations an image, 7 a point. Each is a process of its
own, solved by the rule `ceres` with the implicit solver for a few iterations; memory is its largest resident set. With
`JAXBA_CERES` Ceres' iterative mode solves the smaller ones, too. Sizes are in thousands of observations.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from benchmarks import peers

OBSERVATIONS_OF_IMAGE, OBSERVATIONS_OF_POINT = 1990, 6.9
"""Final-4585: 4,585 images, 1,324,582 points, 9,125,125 observations."""

ITERATIONS = 5
LARGEST_FOR_CERES = 1_000_000


def scene(observations: int) -> Any:
    """A random scene with so many observations."""
    import jaxba

    images = max(10, round(observations / OBSERVATIONS_OF_IMAGE))
    points = round(observations / OBSERVATIONS_OF_POINT)
    return jaxba.random_scene(jaxba.SceneConfig(cameras=images, points=points, observations=observations), seed=0)


def measure(observations: int, devices: int) -> dict[str, float]:
    """Sizes, seconds and gigabytes of one solve."""
    import jax

    import jaxba

    problem = scene(observations)
    base = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    options = jaxba.SolveOptions(
        linear_solver="implicit",
        max_iterations=ITERATIONS,
        compilation="full",
        devices=devices if devices > 1 else None,
        tolerances=jaxba.Tolerances(ftol=0.0),
    )
    if devices > 1:
        jax.config.update("jax_num_cpu_devices", devices)
    found = jaxba.solve(problem, "ceres", options)
    return {
        "observations": problem.num_observations,
        "images": problem.num_cameras,
        "points": problem.num_points,
        "setup_s": found.setup_s,
        "compile_s": found.compile_s,
        "iteration_s": found.total_s / found.iterations,
        "cg_iterations": float(found.history.cg_iterations.mean()),
        "cost_ratio": found.final_cost / found.initial_cost,
        "memory_gb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6,
        "problem_gb": base,
    }


def ceres(observations: int) -> float | None:
    """Seconds of an iteration of Ceres' iterative mode; None without the program."""
    from jaxba.io import write_problem

    binary = peers.program()
    if binary is None:
        return None
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "problem.txt"
        write_problem(scene(observations), file)
        return peers.run(binary, file, "ITERATIVE_SCHUR", 2, ITERATIONS).seconds_per_iteration


def main() -> None:
    """Prints a row for every size, and draws them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", default="30,100,300,1000,3000,9125")
    parser.add_argument("--devices", type=int, default=1)
    parser.add_argument("--figure")
    parser.add_argument("--one", type=int, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.one:
        print(json.dumps(measure(args.one, args.devices)))
        return
    rows = []
    for size in (1000 * int(size) for size in args.sizes.split(",")):
        command = [sys.executable, "-m", "benchmarks.growth", "--one", str(size), "--devices", str(args.devices)]
        row = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout.splitlines()[-1])
        row["ceres_s"] = ceres(size) if size <= LARGEST_FOR_CERES else None
        rows.append(row)
        print(json.dumps(row), flush=True)
    if args.figure:
        _draw(rows, args.figure)


def _draw(rows: list[dict[str, Any]], path: str) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 4.2), layout="constrained")
    axes = figure.subplots()
    x = [row["observations"] for row in rows]
    axes.loglog(x, [row["iteration_s"] for row in rows], "o-", label="jaxba, implicit: seconds an iteration")
    peer = [(row["observations"], row["ceres_s"]) for row in rows if row["ceres_s"]]
    if peer:
        axes.loglog(*zip(*peer, strict=True), "s--", label="C++ Ceres, iterative Schur")
    axes.loglog(x, [row["memory_gb"] for row in rows], "^:", label="jaxba: memory, GB")
    axes.set(xlabel="observations", ylabel="seconds, GB")
    axes.grid(alpha=0.3)
    axes.legend()
    figure.savefig(path, dpi=120)


if __name__ == "__main__":
    main()
