"""Seconds of an iteration and memory by the number of observations, from 30 thousand to 29 million.

    python -m benchmarks.growth [--sizes 30,100,300,1000,3000,9125,28988] [--devices 1] [--figure
    FILE.png] python -m benchmarks.growth --sizes 28988 --policy guarded --iterations 100 python -m
    benchmarks.growth --sizes 1000,3000,5000 --policy guarded --iterations 100 --ceres 5000

Random scenes with the proportions of BAL's Final-13682: 2,119 observations an image, 6.5 a point;
the largest has its counts. Each is a process of its own, solved with the implicit solver, by
default by the rule `ceres` for a few iterations; memory is its largest resident set. With
`JAXBA_CERES` Ceres' iterative mode solves those up to `--ceres`, too, with as many iterations.
`to_end_s` and `ceres_to_end_s` are seconds until the cost is within 1e-3 of the lower of both ends,
without set-up and compilation. Sizes are in thousands of observations."""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from benchmarks import peers

IMAGES, POINTS, OBSERVATIONS = 13_682, 4_456_117, 28_987_644  # Final-13682

ITERATIONS = 5
CERES_LIMIT_S = 3600
WITHIN = 1e-3  # of the lower end


def scene(observations: int) -> Any:
    """A random scene with so many observations."""
    import jaxba

    images, points = (round(count * observations / OBSERVATIONS) for count in (IMAGES, POINTS))
    images = max(10, images)
    return jaxba.random_scene(
        jaxba.SceneConfig(cameras=images, points=points, observations=observations), seed=0
    )


def measure(observations: int, args: argparse.Namespace) -> dict[str, Any]:
    """Sizes, seconds and gigabytes of one solve."""
    devices = args.devices
    import jax

    import jaxba

    problem = scene(observations)
    base = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    options = jaxba.SolveOptions(
        linear_solver="implicit",
        max_iterations=args.iterations,
        compilation="full",
        dtype=args.dtype,
        devices=devices if devices > 1 else None,
        tolerances=jaxba.Tolerances(**{"ftol": 0.0} if args.iterations == ITERATIONS else {}),
    )
    if devices > 1:
        jax.config.update("jax_num_cpu_devices", devices)
    costs = []
    times = []

    def note(record: jaxba.IterationRecord) -> None:
        costs.append(record.step.cost)
        times.append(record.time_s)

    started = time.perf_counter()
    found = jaxba.solve(
        problem, args.policy, options, callback=None if args.iterations == ITERATIONS else note
    )
    return {
        "observations": problem.num_observations,
        "images": problem.num_cameras,
        "points": problem.num_points,
        "setup_s": found.setup_s,
        "compile_s": found.compile_s,
        "all_s": time.perf_counter() - started,
        "iteration_s": found.total_s / found.iterations,
        "iterations": found.iterations,
        "ended": found.termination.reason,
        "cg_iterations": float(found.history.cg_iterations.mean()),
        "initial_cost": found.initial_cost,
        "final_cost": found.final_cost,
        "memory_gb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6,
        "problem_gb": base,
        "costs": costs,
        "times": times,
    }


def ceres(observations: int, iterations: int) -> peers.CeresRun | None:
    """A solve by Ceres' iterative mode; None without the program."""
    from jaxba.io import write_problem

    binary = peers.program()
    if binary is None:
        return None
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "problem.txt"
        write_problem(scene(observations), file)
        return peers.run(binary, file, "ITERATIVE_SCHUR", 2, iterations, CERES_LIMIT_S)


def main() -> None:
    """Prints a row for every size, and draws them."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--sizes", default="30,100,300,1000,3000,9125,28988")
    parser.add_argument("--devices", type=int, default=1)
    parser.add_argument("--policy", default="ceres")
    parser.add_argument("--iterations", type=int, default=ITERATIONS)
    parser.add_argument("--dtype", default="float64")
    parser.add_argument(
        "--ceres", type=float, default=1000, help="largest size that Ceres solves, too"
    )
    parser.add_argument("--figure")
    parser.add_argument("--one", type=int, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.one:
        print(json.dumps(measure(args.one, args)))
        return
    rows = []
    names = ("devices", "policy", "iterations", "dtype")
    passed = [word for name in names for word in (f"--{name}", str(getattr(args, name)))]
    for size in (min(OBSERVATIONS, round(1000 * float(size))) for size in args.sizes.split(",")):
        command = [sys.executable, "-m", "benchmarks.growth", "--one", str(size), *passed]
        row = json.loads(
            subprocess.run(command, check=True, capture_output=True, text=True).stdout.splitlines()[
                -1
            ]
        )
        peer = ceres(size, args.iterations) if size <= 1000 * args.ceres else None
        costs = row.pop("costs")
        times = row.pop("times")
        row["ceres_s"] = peer and peer.seconds_per_iteration
        if peer and costs:
            goal = (1 + WITHIN) * min(*costs, *peer.costs)
            row["to_end_s"] = next(
                (t for t, cost in zip(times, costs, strict=True) if cost <= goal), None
            )
            row |= {"ceres_to_end_s": peer.seconds_to(goal), "ceres_final_cost": peer.final_cost}
            row |= {"ceres_all_s": peer.total_s, "ceres_iterations": peer.iterations}
        rows.append(row)
        print(json.dumps(row), flush=True)
    if args.figure:
        _draw(rows, args.figure)


def _draw(rows: list[dict[str, Any]], path: str) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 4.2), layout="constrained")
    axes = figure.subplots()
    x = [row["observations"] for row in rows]
    axes.loglog(
        x, [row["iteration_s"] for row in rows], "o-", label="jaxba, implicit: seconds an iteration"
    )
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
