"""Whole calls of `jaxba-solve` on small problems, each in a new process: what a person waits for.

    python -m benchmarks.start [PROBLEM ...] [--repeats 5] [--python PATH] [--out FILE]

PROBLEM is a file or a folder of a COLMAP model below `JAXBA_DATA`. Calls are timed with an empty
cache of compiled programs (cold), again with what the first has stored and another process has
compiled after it (warm), and then on another problem of about the same size: the same one without
3% of its points, or for the long sequence of KITTI another window of 40 cameras. Reading and
writing count. Beside them stand pycolmap's bundle adjustment of a COLMAP model, which reads and
writes it too, and C++ Ceres on a BAL file (`JAXBA_CERES`) in the faster of its direct modes.
`empty` is a process that runs an empty program of JAX. `--python` repeats all of it with a second
interpreter, for another version of JAX. Seconds are medians."""

from __future__ import annotations

import argparse
import fcntl
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import peers
from benchmarks.metrics import Metric, to_json
from benchmarks.padding import windows
from jaxba import BundleProblem, read_problem, write_bal
from jaxba.bench.run import machine
from jaxba.runtime.background import LOCK
from jaxba.runtime.process import threads
from jaxba.runtime.program_cache import VARIABLE as CACHE_VARIABLE
from jaxba.solver.options import MAX_ITERATIONS

ROOT = Path(__file__).resolve().parent.parent

PROBLEMS = (
    "bal-converted/balbianello-5-544-pre.txt.bz2",
    "bal-converted/sba-9-559-pre.txt.bz2",
    "colmap/yding",
    "colmap/bulani7",
    "colmap/ranjith",
    "bal-converted/sba-54-5207-pre.txt.bz2",
    "bal/problem-49-7776-pre.txt.bz2",
    "bal/problem-21-11315-pre.txt.bz2",
    "bal-converted/kitti00vo-250-24288-pre.txt.bz2",
    "bal-converted/kittistereo00s-77-15638-pre.txt.bz2",
)
"""Problems of 1,400 to 60,000 observations; of the sequence of 250 cameras only windows are
solved."""

WINDOW = 40
LONGEST = 100
"""Cameras of a window, and the number of cameras from which on a problem is a sequence of which
windows are solved."""

LEFT_OUT = 0.03
"""Share of the points that the other problem lacks."""

COLD = (2.5, 4.0)
WARM = (1.2, 2.0)
"""Targets: seconds, or times those of an empty program, whichever is more."""

EMPTY = "import jax; jax.jit(lambda x: x)(1.0)"
SOLVE = "from jaxba.cli.solve import main; main()"
PYCOLMAP = (
    "import sys, pycolmap; model = pycolmap.Reconstruction(sys.argv[1]); "
    "pycolmap.bundle_adjustment(model); model.write(sys.argv[2])"
)


def fewer_points(problem: BundleProblem) -> BundleProblem:
    """The problem without some points, chosen at random."""
    kept = np.random.default_rng(0).random(problem.num_points) >= LEFT_OUT
    camera = np.asarray(problem.camera_index)
    point = np.asarray(problem.point_index)
    seen = kept[point]
    return problem.replace(
        points=problem.points[kept],
        observations=problem.observations[seen],
        camera_index=camera[seen],
        point_index=(np.cumsum(kept) - 1)[point[seen]].astype(np.int32),
    )


def two_problems(source: Path, folder: Path) -> tuple[Path, Path]:
    """Writes a problem and another one of about its size, or only the other, into a folder; the
    paths of both."""
    other = folder / "other.txt"
    if source.is_dir():
        import pycolmap

        model: Any = pycolmap.Reconstruction(str(source))
        points = sorted(model.points3D)
        for point in np.random.default_rng(0).choice(
            points, int(LEFT_OUT * len(points)), replace=False
        ):
            model.delete_point3D(int(point))
        other = folder / "other"
        other.mkdir()
        model.write(str(other))
        return source, other
    problem = read_problem(source)
    first = folder / "first.txt"
    pair = (
        (problem, fewer_points(problem))
        if problem.num_cameras < LONGEST
        else windows(problem, 2, WINDOW)
    )
    for each, path in zip(pair, (first, other), strict=True):
        write_bal(each, path)
    return first, other


def seconds(python: str, code: str, *arguments: Path, cache: str = "off") -> float:
    """Wall time of a process."""
    environment = {
        name: value for name, value in os.environ.items() if name != "JAX_COMPILATION_CACHE_DIR"
    }
    environment |= {
        CACHE_VARIABLE: cache,
        "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]),
    }
    started = time.perf_counter()
    command = [python, "-c", code, *map(str, arguments)]
    done = subprocess.run(command, env=environment, cwd="/", capture_output=True, text=True)
    elapsed = time.perf_counter() - started
    if done.returncode:
        raise RuntimeError(f"{python} {code} {arguments}: {done.stderr[-1000:]}")
    return elapsed


def settle(cache: Path) -> None:
    """Waits until no process compiles programs for later calls into a cache."""
    time.sleep(2)  # until it has begun
    for lock in cache.rglob(LOCK):
        with lock.open("w") as file:
            fcntl.flock(file, fcntl.LOCK_EX)


def calls(python: str, first: Path, other: Path, folder: Path) -> dict[str, float]:
    """Seconds of one call of each kind."""
    target = folder / ("solved" if first.is_dir() else "solved.txt")
    output = (Path("--output"), target)
    with tempfile.TemporaryDirectory() as cache:
        found = {"empty": seconds(python, EMPTY)}
        for name in ("cold", "warm"):
            found[name] = seconds(python, SOLVE, first, *output, cache=cache)
            settle(Path(cache))
        found["other"] = seconds(python, SOLVE, other, *output, cache=cache)
    if first.is_dir():
        if find_spec("pycolmap"):
            target = folder / "adjusted"
            target.mkdir(exist_ok=True)
            found["pycolmap"] = seconds(sys.executable, PYCOLMAP, first, target)
    elif binary := peers.program():
        times = []
        for mode in ("DENSE_SCHUR", "SPARSE_SCHUR"):
            started = time.perf_counter()
            peers.run(binary, first, mode, threads(), MAX_ITERATIONS)
            times.append(time.perf_counter() - started)
        found["ceres"] = min(times)
    return found


def metrics_of(python: str, sources: list[Path], repeats: int) -> Iterator[Metric]:
    """Medians of all calls with an interpreter, with their targets, and of the empty program
    last."""
    measured: dict[str, list[dict[str, float]]] = {}
    for source in sources:
        with tempfile.TemporaryDirectory() as name:
            first, other = two_problems(source, Path(name))
            label = f"{source.name.split('-pre')[0]} ({read_problem(first).num_observations} obs)"
            for _ in range(repeats):
                measured.setdefault(label, []).append(calls(python, first, other, Path(name)))
                line = ", ".join(
                    f"{kind} {value:.2f}" for kind, value in measured[label][-1].items()
                )
                print(f"{label}: {line}", file=sys.stderr, flush=True)
    empty = statistics.median(run["empty"] for runs in measured.values() for run in runs)
    targets = {
        kind: max(least, times * empty) for kind, (least, times) in (("cold", COLD), ("warm", WARM))
    }
    for label, runs in measured.items():
        for kind in runs[0]:
            if kind != "empty":
                value = statistics.median(run[kind] for run in runs)
                yield Metric(
                    f"{python}/{label}/{kind}", value, "s", "lower", target=targets.get(kind)
                )
    yield Metric(f"{python}/empty", empty, "s", "lower")


def to_markdown(metrics: list[Metric]) -> str:
    """The metrics of one interpreter as a table in Markdown."""
    kinds = ("cold", "warm", "other", "pycolmap", "ceres")
    rows: dict[str, dict[str, str]] = {}
    for metric in metrics[:-1]:
        _, label, kind = metric.key.rsplit("/", 2)
        mark = {None: "", True: " met", False: " missed"}[metric.met]
        rows.setdefault(label, {})[kind] = f"{metric.value:.2f}{mark}"
    lines = [f"| problem | {' | '.join(kinds)} |", "| --- |" + " ---: |" * len(kinds)]
    lines += [
        f"| {label} | {' | '.join(row.get(kind, '') for kind in kinds)} |"
        for label, row in rows.items()
    ]
    targets = [
        f"{kind} at most {next(m.target for m in metrics if m.key.endswith('/' + kind)):.2f}"
        for kind in kinds[:2]
    ]
    return "\n".join(
        [*lines, "", f"Empty program {metrics[-1].value:.2f} s. Targets, s: {', '.join(targets)}."]
    )


def main() -> None:
    """Prints a table for each interpreter."""
    parser = argparse.ArgumentParser(description="Whole calls of jaxba-solve in new processes.")
    parser.add_argument("problem", nargs="*", help="paths below JAXBA_DATA")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--python", help="a second interpreter, with another JAX")
    parser.add_argument("--out", help="output file of the metrics as JSON")
    args = parser.parse_args()
    data = Path(os.environ.get("JAXBA_DATA", "")).resolve()
    metrics = []
    for name in args.problem or PROBLEMS:
        if not (data / name).exists():
            parser.error(f"{name} is not below JAXBA_DATA")
    other = os.path.abspath(args.python) if args.python else None  # calls run in the root folder
    for python in filter(None, (sys.executable, other)):
        found = list(
            metrics_of(python, [data / name for name in args.problem or PROBLEMS], args.repeats)
        )
        versions = subprocess.run(
            [
                python,
                "-c",
                "import jax, platform; print('Python', platform.python_version(), 'JAX', "
                "jax.__version__)",
            ],
            capture_output=True,
            text=True,
        )
        print(f"\n{versions.stdout.strip()}\n\n{to_markdown(found)}")
        metrics += found
    if args.out:
        Path(args.out).write_text(to_json(metrics, machine()))


if __name__ == "__main__":
    main()
