"""Time and memory of reading and writing a BAL file, a given one or a random one.

    python benchmarks/io_speed.py problem.txt.bz2
    python benchmarks/io_speed.py --observations 10000000 --points 1500000 --cameras 10000 [--suffix .gz]

Each measurement runs in its own process, so that the peak memory is that of this measurement. `base` is the peak of a
process that only imports the package.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time

import numpy as np

from jaxba.io import read_problem, write_problem
from jaxba.problem.bundle_problem import BundleProblem


def synthetic(cameras: int, points: int, observations: int) -> BundleProblem:
    """A problem of random numbers with all digits, ordered by point as in a BAL file."""
    rng = np.random.default_rng(0)
    return BundleProblem.create(
        rng.normal(size=(cameras, 9)),
        rng.normal(size=(points, 3)),
        500 * rng.normal(size=(observations, 2)),
        rng.integers(0, cameras, observations),
        np.arange(observations) * points // observations,
    )


def measure(what: str, path: str, sizes: tuple[int, int, int]) -> None:
    """Runs one measurement in this process and prints its line."""
    problem = synthetic(*sizes) if what == "write" else None
    start = time.perf_counter()
    if what == "read":
        problem = read_problem(path)
    elif problem is not None:
        write_problem(problem, path)
    seconds = time.perf_counter() - start
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20  # Linux counts KiB
    count = 0 if problem is None else problem.num_observations
    rate = f"{count / seconds / 1e6:7.2f} M observations/s" if count else 25 * " "
    print(f"{what:6} {seconds:9.3f} s  {rate}  peak {peak:6.2f} GiB", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("path", nargs="?", help="file to read; default: write and read a random one")
    parser.add_argument("--cameras", type=int, default=1_000)
    parser.add_argument("--points", type=int, default=150_000)
    parser.add_argument("--observations", type=int, default=1_000_000)
    parser.add_argument("--suffix", default="", choices=["", ".bz2", ".gz", ".xz"])
    parser.add_argument("--measure", choices=["base", "read", "write"], help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    sizes = (arguments.cameras, arguments.points, arguments.observations)
    if arguments.measure:
        return measure(arguments.measure, arguments.path, sizes)
    with tempfile.TemporaryDirectory() as folder:
        path = arguments.path or os.path.join(folder, f"problem.txt{arguments.suffix}")
        for what in ("base", "read") if arguments.path else ("base", "write", "read"):
            options = [
                f"--{name}={size}" for name, size in zip(("cameras", "points", "observations"), sizes, strict=True)
            ]
            subprocess.run([sys.executable, __file__, path, *options, "--measure", what], check=True)
        print(f"file   {os.path.getsize(path) / 2**20:9.1f} MiB")


if __name__ == "__main__":
    main()
