"""Speed of jaxba compared with Ceres, in one run.

    python -m benchmarks.suite [--only iteration,scenes,cold,tolerance,large,layout] [--solvers ...]
    [--repeats 3]
        [--gate] [--update-baseline]

`JAXBA_DATA` names the folder of real problems, and `JAXBA_CERES` the program with C++ Ceres
(benchmarks/README.md). Parts whose data or program are missing are left out with a message.
`--gate` compares ratios with benchmarks/baseline.json."""

from __future__ import annotations

import argparse
import dataclasses
import functools
import itertools
import math
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from benchmarks import peers
from benchmarks.metrics import Metric, read_baseline, regressions, to_json, to_text, write_baseline

if TYPE_CHECKING:
    from jaxba.problem.bundle_problem import BundleProblem

HERE = Path(__file__).parent
BASELINE = HERE / "baseline.json"
GATE_TOLERANCE = 0.25
"""Relative change of a ratio that `--gate` accepts: ratios of short runs on a shared machine vary
by up to 15%."""

ITERATION_PROBLEMS = (
    "bal/problem-49-7776-pre.txt.bz2",
    "bal/problem-21-11315-pre.txt.bz2",
    "scene:random-150",
    "bal-converted/kitti00vo-250-24288-pre.txt.bz2",
    "scene:ladybug-1197",
)
ITERATIONS = 8
"""Number of iterations that are timed; later ones take the same time."""

TOLERANCE_SOLVERS = (
    "ceres+refine3",
    "nielsen+refine3",
    "ceres+embedded",
    "bold",
    "ceres+refine3@float32",
    "nielsen+refine3@float32",
    "bold@float32",
)
"""Rules with embedded iterations, and `bold`; some also in float32, which is accurate enough for
1e-3."""

ROUNDING = 2e-5
"""Relative error of a cost in float32, by which a solve may end above its target: a fiftieth of the
tolerance."""

MIN_SOLVES = 5
"""Smallest number of timed solves to a tolerance."""

LARGE_SCENES = ("scene:random-150", "scene:ladybug-1197")
"""Random scenes larger than the real problems; the second has the size of the BAL problem
Ladybug-1197."""

SMALL_SCENES = ("scene:tiny", "scene:paper")
"""Scenes so small that the fixed cost of a layout matters."""

LARGE_ITERATIONS = 30
"""Limit of Ceres' iterations on the large scenes. jaxba's step under Ceres' rule takes 17 to f*(1 +
1e-3)."""

MAX_DENSE_CAMERAS = 500
"""With more cameras, Ceres' dense mode takes minutes per iteration and is left out."""

COLD_PROBLEM = "bal/problem-49-7776-pre.txt.bz2"
"""Problem for the time of a first call."""


def locate(name: str) -> str | None:
    """Path of a problem, or the scene itself; None if the file does not exist."""
    if name.startswith("scene:"):
        return name
    folder = os.environ.get("JAXBA_DATA", "")
    path = Path(folder) / name
    return str(path) if folder and path.is_file() else None


def real_problems() -> list[str]:
    """Paths of the real problems in `JAXBA_DATA`, without the very small ones in other folders."""
    folder = Path(os.environ.get("JAXBA_DATA", ""))
    files = [*folder.glob("bal/problem-*.bz2"), *folder.glob("bal-converted/*.bz2")]
    return sorted(map(str, files)) if folder.name else []


def iteration_times(repeats: int, threads: int) -> Iterator[Metric]:
    """Seconds per LM iteration, of jaxba's linear solver `auto` and of Ceres' modes, and the ratio
    to the best mode."""
    from jaxba.bench.sources import sources
    from jaxba.io import write_problem

    binary = peers.program()
    for name in ITERATION_PROBLEMS:
        location = locate(name)
        if location is None:
            print(f"left out: {name} (JAXBA_DATA)", file=sys.stderr)
            continue
        source = sources([location])[0]
        problem = source.read()
        ours, linear_solver = iteration_seconds(problem, repeats)
        label = f"iteration/{source.name}"
        yield Metric(f"{label}/jaxba ({linear_solver})", ours, "s", "lower")
        ratio = _layout_seconds(problem, repeats) / ours
        yield Metric(
            f"{label}/layout over an iteration", ratio, "ratio", "lower", GATE_TOLERANCE, target=1.0
        )
        if binary is None:
            continue
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "problem.txt"
            write_problem(problem, file)
            theirs = {}
            for mode in _modes(problem):
                count = 1 if problem.num_observations > 200_000 else repeats
                runs = [peers.run(binary, file, mode, threads, ITERATIONS) for _ in range(count)]
                theirs[mode] = statistics.median(run.seconds_per_iteration for run in runs)
                yield Metric(f"{label}/ceres {mode}", theirs[mode], "s", "lower")
        best = min(theirs.values())
        yield Metric(
            f"{label}/jaxba over ceres", ours / best, "ratio", "lower", GATE_TOLERANCE, target=0.5
        )


def layout_times(repeats: int) -> Iterator[Metric]:
    """Time of the layout relative to an iteration, on every real problem and on the smallest random
    scenes."""
    from jaxba.bench.sources import sources

    for source in sources([*real_problems(), *SMALL_SCENES]):
        problem = source.read()
        ratio = _layout_seconds(problem, repeats) / iteration_seconds(problem, repeats)[0]
        yield Metric(
            f"layout/{source.name}, over an iteration", ratio, "ratio", "lower", GATE_TOLERANCE, 1.0
        )


def _modes(problem: BundleProblem) -> list[str]:
    return [
        mode
        for mode in peers.MODES
        if mode != "DENSE_SCHUR" or problem.num_cameras <= MAX_DENSE_CAMERAS
    ]


def iteration_seconds(
    problem: BundleProblem, repeats: int, method: str = "lm"
) -> tuple[float, str]:
    """Median seconds of an iteration under Ceres' rule without compilation, and the linear solver.

    Args:
        problem: the problem.
        repeats: number of solves with `ITERATIONS` iterations each.
        method: name of the method that computes the step.
    """
    import jaxba

    times = []
    solver = ""
    for _ in range(repeats):
        stamps = [0.0]
        solution = jaxba.solve(
            problem,
            "ceres",
            jaxba.SolveOptions(method=method, max_iterations=ITERATIONS, compilation="full"),
            callback=lambda record, stamps=stamps: stamps.append(record.time_s) and False,
        )
        solver = solution.linear_solver
        times += [after - before for before, after in itertools.pairwise(stamps)]
    return statistics.median(times), solver


def _layout_seconds(problem: BundleProblem, repeats: int) -> float:
    """Median seconds on the host to make the layout for the linear solver that `auto` chooses."""
    from jaxba import StepOptions
    from jaxba.solver.choose import choose_linear_solver
    from jaxba.structure.layout import build_layout

    options = choose_linear_solver(problem, StepOptions(), "auto")
    times = []
    for _ in range(max(repeats, 3)):
        started = time.perf_counter()
        build_layout(problem, options)
        times.append(time.perf_counter() - started)
    return statistics.median(times)


def time_to_tolerance(
    part: str, problems: list[str], solvers: list[str], limit: int, repeats: int, threads: int
) -> Iterator[Metric]:
    """Time to the cost f*(1 + 1e-3), of jaxba's solvers and of Ceres.

    f* is the lowest cost of all runs on the problem. jaxba is timed as one compiled program that
    ends at that cost. Ceres is timed under its own rule, with its own clock, in its fastest mode.

    Args:
        part: name of this part of the suite, for the metrics.
        problems: paths or random scenes.
        solvers: names of jaxba's solvers.
        limit: limit of Ceres' iterations.
        repeats: runs of Ceres in each mode.
        threads: threads of Ceres.
    """
    from jaxba.bench.sources import sources
    from jaxba.io import write_problem

    binary = peers.program()
    if binary is None or not problems:
        print(
            f"left out: {part} (needs JAXBA_CERES; for real problems JAXBA_DATA)", file=sys.stderr
        )
        return
    ratios: dict[str, list[float]] = {name: [] for name in solvers}
    for source in sources(problems):
        problem = source.read()
        final_costs = [_cost_and_seconds(problem, name)[0] for name in solvers]
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "problem.txt"
            write_problem(problem, file)
            runs = [
                [peers.run(binary, file, m, threads, limit) for _ in range(repeats)]
                for m in _modes(problem)
            ]
        best = min(final_costs + [run.final_cost for mode in runs for run in mode])
        target = best * (1 + 1e-3)
        theirs = min(statistics.median(run.seconds_to(target) for run in mode) for mode in runs)
        yield Metric(f"{part}/{source.name}/ceres best mode", theirs, "s", "lower")
        for name, cost in zip(solvers, final_costs, strict=True):
            ours = (
                _seconds_to(problem, name, target, max(repeats, MIN_SOLVES))
                if cost <= target
                else math.inf
            )
            yield Metric(f"{part}/{source.name}/jaxba {name}", ours, "s", "lower")
            if math.isfinite(ours) and math.isfinite(theirs):
                ratios[name].append(ours / max(theirs, 1e-6))
    for name, both in ratios.items():
        mean = math.exp(statistics.fmean(map(math.log, both))) if both else math.inf
        yield Metric(
            f"{part}/geometric mean, {name} over ceres",
            mean,
            "ratio",
            "lower",
            GATE_TOLERANCE,
            target=0.25,
        )
        yield Metric(f"{part}/problems that {name} and ceres reached", len(both), "count", "higher")


def _cost_and_seconds(
    problem: BundleProblem, name: str, target: float = 0.0
) -> tuple[float, float]:
    """Final cost, evaluated in float64, and seconds of a solve in one program that ends at the
    target cost."""
    import jaxba
    from jaxba.problem import geometry
    from jaxba.solver.names import parse_solver

    solver = parse_solver(name)
    policy, options = solver.build()
    solution = jaxba.solve(
        problem,
        policy,
        dataclasses.replace(
            options, tolerances=jaxba.Tolerances(target=target), compilation="full"
        ),
    )
    return geometry.cost(solution.problem), solution.total_s


def _seconds_to(problem: BundleProblem, name: str, target: float, repeats: int) -> float:
    """Median seconds of a solve in one program until its cost is at most `target`."""
    solves = [_cost_and_seconds(problem, name, target) for _ in range(repeats)]
    if max(cost for cost, _ in solves) > (1 + ROUNDING) * target:
        print(f"{name} did not reach the target again", file=sys.stderr)
        return math.inf
    return statistics.median(seconds for _, seconds in solves)


def scene_throughput(repeats: int, scenes: int = 256) -> Iterator[Metric]:
    """LM steps per second on scenes of 10 cameras and 10 points, all in one vmapped program: with
    free lenses, and as the game of the paper has them, with dense algebra and with conjugate
    gradients."""
    import jax
    import jax.numpy as jnp

    import jaxba
    from jaxba.training.config import load

    game = load("paper").step_options
    dense = dataclasses.replace(game, linear_solver="explicit")
    with jax.enable_x64(True):
        problems = [jaxba.random_scene(jaxba.scene_like("paper"), seed) for seed in range(scenes)]

        def stack(trees):
            return jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees)

        layouts = [jaxba.build_layout(problem) for problem in problems]
        layout = stack(layouts)
        damping = jnp.full(scenes, 1e-3)
        runs = {}
        for name, options in {
            "": jaxba.StepOptions(),
            ", the game's, dense": dense,
            ", the game's, cg": game,
        }.items():
            states = stack(
                [
                    jaxba.initial_state(one, p, options)
                    for one, p in zip(layouts, problems, strict=True)
                ]
            )
            step = jax.jit(jax.vmap(functools.partial(jaxba.lm_step, options=options)))
            runs[name] = functools.partial(step, layout, states, damping)
        times: dict[str, list[float]] = {name: [] for name in runs}
        for _ in range(1 + 10 * repeats):
            for name, run in runs.items():
                started = time.perf_counter()
                jax.block_until_ready(run())
                times[name].append(time.perf_counter() - started)
    for name, taken in times.items():
        speed = scenes / statistics.median(taken[1:])
        target = None if name else 20_000
        yield Metric(f"scenes/10 x 10 steps{name}", speed, "1/s", "higher", target=target)


def cold_start() -> Iterator[Metric]:
    """Wall time of a call of `jaxba-solve`: with an empty compilation cache, with a filled one, and
    with `--compilation full`."""
    location = locate(COLD_PROBLEM)
    if location is None:
        print("left out: cold start (JAXBA_DATA)", file=sys.stderr)
        return
    with tempfile.TemporaryDirectory() as folder:
        environment = {**os.environ, "JAXBA_CACHE": folder}
        command = [sys.executable, "-c", "from jaxba.cli.solve import main; main()", location]
        runs = (
            ("cold", 8.0, []),
            ("warm", 3.0, []),
            ("cold, full", None, ["--compilation", "full"]),
        )
        measured = {}
        for name, target, more in runs:
            started = time.perf_counter()
            subprocess.run([*command, *more], env=environment, check=True, capture_output=True)
            measured[name] = time.perf_counter() - started
            yield Metric(
                f"start/jaxba-solve on ladybug-49, {name}",
                measured[name],
                "s",
                "lower",
                target=target,
            )
        ratio = measured["cold"] / measured["cold, full"]
        yield Metric(
            "start/cold over cold with full compilation",
            ratio,
            "ratio",
            "lower",
            GATE_TOLERANCE,
            target=1.0,
        )


def main() -> int:
    """Runs the requested parts; returns 1 if the gate finds a regression."""
    parser = argparse.ArgumentParser(description="Speed of jaxba compared with Ceres.")
    parser.add_argument(
        "--only",
        default="iteration,scenes,cold,tolerance,large",
        help="comma-separated parts; also: layout, on all problems",
    )
    parser.add_argument(
        "--solvers",
        default=",".join(TOLERANCE_SOLVERS),
        help="solvers of the parts tolerance, large",
    )
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument(
        "--gate", action="store_true", help="fail if a ratio is worse than the baseline"
    )
    parser.add_argument("--update-baseline", action="store_true")
    parser.add_argument("--out", default="", help="output file of the metrics as JSON")
    args = parser.parse_args()
    from jaxba.bench.run import machine
    from jaxba.runtime import process
    from jaxba.runtime.process import threads

    process.keep_memory()
    solvers = args.solvers.split(",")
    parts = {
        "iteration": lambda: iteration_times(args.repeats, threads()),
        "layout": lambda: layout_times(args.repeats),
        "scenes": lambda: scene_throughput(args.repeats),
        "cold": cold_start,
        "tolerance": lambda: time_to_tolerance(
            "tolerance", real_problems(), solvers, 100, args.repeats, threads()
        ),
        "large": lambda: time_to_tolerance(
            "large", list(LARGE_SCENES), solvers, LARGE_ITERATIONS, 1, threads()
        ),
    }
    metrics = []
    for name in args.only.split(","):
        for metric in parts[name]():
            print(to_text([metric]).splitlines()[1], flush=True)
            metrics.append(metric)
    print(to_text(metrics))
    if args.out:
        Path(args.out).write_text(to_json(metrics, machine()))
    failures = regressions(metrics, read_baseline(BASELINE)) if args.gate else []
    for line in failures:
        print(f"worse than the baseline: {line}")
    if args.update_baseline:
        write_baseline(BASELINE, metrics)
    return 1 if failures else 0


if __name__ == "__main__":
    from jaxba.runtime.process import single_blas_thread

    with single_blas_thread():
        sys.exit(main())
