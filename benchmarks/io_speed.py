"""Time and memory of reading and writing a BAL file or a COLMAP model, a given one or a random one.

    python benchmarks/io_speed.py problem.txt.bz2 python benchmarks/io_speed.py --observations
    10000000 --points 1500000 --cameras 10000 [--suffix .gz]

The suffix `/` is that of a binary COLMAP model. Each measurement runs in its own process. MB/s are
of the files as they are on the disk; `beyond` is the largest resident memory above that of the
package and the problem's own arrays. Linux only."""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from jaxba.io import read_problem, write_problem
from jaxba.problem.bundle_problem import BundleProblem


def synthetic(cameras: int, points: int, observations: int) -> BundleProblem:
    """A problem of random numbers with all digits, ordered by point as in a BAL file."""
    rng = np.random.default_rng(0)
    return BundleProblem.create(
        np.hstack(
            [
                rng.normal(size=(cameras, 6)),
                rng.uniform(500, 1000, (cameras, 1)),
                rng.normal(size=(cameras, 2)),
            ]
        ),
        rng.normal(size=(points, 3)),
        500 * rng.normal(size=(observations, 2)),
        rng.integers(0, cameras, observations),
        np.arange(observations) * points // observations,
    )


def resident(field: str) -> int:
    """Bytes of a field of the process's status, such as `VmRSS`."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return 1024 * next(int(line.split()[1]) for line in lines if line.startswith(field))


def measure(what: str, path: str, sizes: tuple[int, int, int]) -> None:
    """Runs one measurement in this process and prints its line."""
    problem = synthetic(*sizes) if what == "write" else None
    Path("/proc/self/clear_refs").write_text("5")  # the peak counts from here
    before = resident("VmRSS")
    start = time.perf_counter()
    if problem is None:
        problem = read_problem(path)
    else:
        write_problem(problem, path)
    seconds = time.perf_counter() - start
    beyond = resident("VmHWM") - before
    names = ("cameras", "points", "observations", "camera_index", "point_index")
    own = sum(np.asarray(getattr(problem, name)).nbytes for name in names)
    beyond -= own if what == "read" else 0
    size = sum(
        file.stat().st_size for file in [Path(path), *Path(path).glob("*")] if file.is_file()
    )
    count = problem.num_observations
    print(
        f"{what:6}{seconds:9.3f} s{size / seconds / 1e6:7.0f} MB/s{count / seconds / 1e6:7.2f} M "
        "observations/s  "
        f"beyond: {beyond / 2**20:7.0f} MiB, {beyond / count:6.1f} bytes an observation of "
        f"{own / count:.1f}",
        flush=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "path", nargs="?", help="file or folder to read; default: write and read a random one"
    )
    parser.add_argument("--cameras", type=int, default=1_000)
    parser.add_argument("--points", type=int, default=150_000)
    parser.add_argument("--observations", type=int, default=1_000_000)
    parser.add_argument("--suffix", default="", choices=["", ".bz2", ".gz", ".xz", "/"])
    parser.add_argument("--measure", choices=["read", "write"], help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    sizes = (arguments.cameras, arguments.points, arguments.observations)
    if arguments.measure:
        return measure(arguments.measure, arguments.path, sizes)
    with tempfile.TemporaryDirectory() as folder:
        path = (
            arguments.path
            or f"{folder}/problem{'' if arguments.suffix == '/' else '.txt'}{arguments.suffix}"
        )
        for what in ("read",) if arguments.path else ("write", "read"):
            options = [
                f"--{name}={size}"
                for name, size in zip(("cameras", "points", "observations"), sizes, strict=True)
            ]
            subprocess.run(
                [sys.executable, __file__, path, *options, "--measure", what], check=True
            )


if __name__ == "__main__":
    main()
