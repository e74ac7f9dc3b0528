"""Speed of jaxba beside its peers, in one run.

    python -m benchmarks.suite [--only iteration,scenes,cold,tolerance,large,layout] [--solvers ...] [--repeats 3]
        [--gate] [--update-baseline]

Real problems come from the folder `JAXBA_DATA`; the C++ Ceres peer from `JAXBA_CERES` (benchmarks/README.md). What is
missing is left out, and said. Ratios are compared with benchmarks/baseline.json by `--gate`.
"""

from __future__ import annotations

import argparse
import dataclasses
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
"""Ratios of short runs on a shared machine vary by some 10%; see benchmarks/README.md."""

ITERATION_PROBLEMS = (
    "bal/problem-49-7776-pre.txt.bz2",
    "bal/problem-21-11315-pre.txt.bz2",
    "scene:random-150",
    "bal-converted/kitti00vo-250-24288-pre.txt.bz2",
    "scene:ladybug-1197",
)
ITERATIONS = 8
"""Iterations that are timed; later ones cost the same."""

TOLERANCE_SOLVERS = (
    "ceres+refine3",
    "nielsen+refine3",
    "ceres+embedded",
    "learned",
    "ceres+refine3@float32",
    "nielsen+refine3@float32",
    "learned@float32",
)
"""Hand-written policies with point iterations, and the one that ships; in float32 too, which is enough for 1e-3."""

ROUNDING = 2e-5
"""Relative error of a cost in float32, which may end a solve so far above its goal: a fiftieth of the tolerance."""

LEAST_SOLVES = 5
"""Solves that are timed to a tolerance; compiled once, they cost little."""

LARGE_SCENES = ("scene:random-150", "scene:ladybug-1197")
"""Random scenes larger than the real problems at hand; the second has the counts of a BAL file."""

SMALL_SCENES = ("scene:tiny", "scene:paper")
"""Scenes in which the fixed cost of a layout shows."""

LARGE_ITERATIONS = 30
"""Limit of Ceres' iterations on them. Under its rule our step took 17 to f*(1 + 1e-3) (docs/game-tried.md)."""

MANY_CAMERAS = 500
"""With more, Ceres' dense mode takes minutes an iteration and is left out."""

COLD_PROBLEM = "bal/problem-49-7776-pre.txt.bz2"


def locate(name: str) -> str | None:
    """A source's location, or None where the file is not at hand."""
    if name.startswith("scene:"):
        return name
    folder = os.environ.get("JAXBA_DATA", "")
    path = Path(folder) / name
    return str(path) if folder and path.is_file() else None


def real_problems() -> list[str]:
    """Every real problem at hand but the hand-cut miniatures, which end at rounding noise."""
    folder = Path(os.environ.get("JAXBA_DATA", ""))
    files = [*folder.glob("bal/problem-*.bz2"), *folder.glob("bal-converted/*.bz2")]
    return sorted(map(str, files)) if folder.name else []


def iteration_times(repeats: int, threads: int) -> Iterator[Metric]:
    """Seconds per LM iteration, jaxba's `auto` against the best of Ceres' modes."""
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
        ours, linear_solver = _our_iteration(problem, repeats)
        label = f"iteration/{source.name}"
        yield Metric(f"{label}/jaxba ({linear_solver})", ours, "s", "lower")
        process = _layout_seconds(problem, repeats)
        yield Metric(f"{label}/layout over an iteration", process / ours, "ratio", "lower", GATE_TOLERANCE, target=1.0)
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
        yield Metric(f"{label}/jaxba over ceres", ours / best, "ratio", "lower", GATE_TOLERANCE, target=0.5)


def layout_times(repeats: int) -> Iterator[Metric]:
    """Layout over an iteration on every real problem, and on the smallest built-in scenes."""
    from jaxba.bench.sources import sources

    for source in sources([*real_problems(), *SMALL_SCENES]):
        problem = source.read()
        ours, process = _our_iteration(problem, repeats)[0], _layout_seconds(problem, repeats)
        yield Metric(f"layout/{source.name}, over an iteration", process / ours, "ratio", "lower", GATE_TOLERANCE, 1.0)


def _modes(problem: BundleProblem) -> list[str]:
    return [mode for mode in peers.MODES if mode != "DENSE_SCHUR" or problem.num_cameras <= MANY_CAMERAS]


def _our_iteration(problem, repeats: int) -> tuple[float, str]:
    import jaxba

    times, solver = [], ""
    for _ in range(repeats):
        stamps = [0.0]
        solution = jaxba.solve(
            problem,
            "ceres",
            jaxba.SolveOptions(max_iterations=ITERATIONS, compilation="full"),
            callback=lambda record, stamps=stamps: stamps.append(record.time_s) and False,
        )
        solver = solution.linear_solver
        times += [after - before for before, after in itertools.pairwise(stamps)]
    return statistics.median(times), solver


def _layout_seconds(problem: BundleProblem, repeats: int) -> float:
    """Median time on the host to sort the observations for the solver that `auto` takes."""
    from jaxba import StepOptions
    from jaxba.solver.cost_model import choose_linear_solver
    from jaxba.structure.layout import layout_for

    options = choose_linear_solver(problem, StepOptions(), "auto")
    times = []
    for _ in range(max(repeats, 3)):
        started = time.perf_counter()
        layout_for(problem, options)
        times.append(time.perf_counter() - started)
    return statistics.median(times)


def time_to_tolerance(
    part: str, places: list[str], solvers: list[str], limit: int, repeats: int, threads: int
) -> Iterator[Metric]:
    """Time to f*(1 + 1e-3): rules with point iterations and the shipped policy against Ceres.

    f* is the lowest cost of all runs of the problem. Ours are timed as a library's user runs them: the whole loop as
    one program that ends at that cost. Ceres solves under its own rule, at most `limit` iterations, and its fastest
    mode counts, by its own clock.
    """
    from jaxba.bench.sources import sources
    from jaxba.io import write_problem

    binary = peers.program()
    if binary is None or not places:
        print(f"left out: {part} (needs JAXBA_CERES; for real problems JAXBA_DATA)", file=sys.stderr)
        return
    ratios: dict[str, list[float]] = {name: [] for name in solvers}
    for source in sources(places):
        problem = source.read()
        ends = [_solved(problem, name)[0] for name in solvers]
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "problem.txt"
            write_problem(problem, file)
            runs = [[peers.run(binary, file, m, threads, limit) for _ in range(repeats)] for m in _modes(problem)]
        best = min(ends + [run.final_cost for mode in runs for run in mode])
        goal = best * (1 + 1e-3)
        theirs = min(statistics.median(run.seconds_to(goal) for run in mode) for mode in runs)
        yield Metric(f"{part}/{source.name}/ceres best mode", theirs, "s", "lower")
        for name, end in zip(solvers, ends, strict=True):
            ours = _seconds_to(problem, name, goal, max(repeats, LEAST_SOLVES)) if end <= goal else math.inf
            yield Metric(f"{part}/{source.name}/jaxba {name}", ours, "s", "lower")
            if math.isfinite(ours) and math.isfinite(theirs):
                ratios[name].append(ours / max(theirs, 1e-6))
    for name, both in ratios.items():
        mean = math.exp(statistics.fmean(map(math.log, both))) if both else math.inf
        yield Metric(f"{part}/geometric mean, {name} over ceres", mean, "ratio", "lower", GATE_TOLERANCE, target=0.25)
        yield Metric(f"{part}/problems that {name} and ceres reached", len(both), "count", "higher")


def _solved(problem: BundleProblem, name: str, goal: float = -math.inf) -> tuple[float, float]:
    """Final cost, in float64 by NumPy, and seconds of a solve in one program that ends at the goal."""
    import jaxba
    from jaxba.problem import geometry
    from jaxba.solver.names import parse_solver

    solver = parse_solver(name)
    policy, options = solver.build()
    solution = jaxba.solve(
        problem,
        policy,
        dataclasses.replace(options, tolerances=jaxba.Tolerances(target=goal), compilation="full"),
    )
    return geometry.cost(solution.problem), solution.total_s


def _seconds_to(problem: BundleProblem, name: str, goal: float, repeats: int) -> float:
    """Median time of the compiled loop of a solver until its cost is at most `goal`."""
    solves = [_solved(problem, name, goal) for _ in range(repeats)]
    if max(cost for cost, _ in solves) > (1 + ROUNDING) * goal:
        print(f"{name} did not reach the goal again", file=sys.stderr)
        return math.inf
    return statistics.median(seconds for _, seconds in solves)


def scene_throughput(repeats: int) -> Iterator[Metric]:
    """LM environment steps a second on 10 x 10 scenes, all in one vmapped program."""
    import jax
    import jax.numpy as jnp

    import jaxba

    scenes = 256
    with jax.enable_x64(True):
        problems = [jaxba.random_scene(jaxba.like("paper"), seed) for seed in range(scenes)]
        options = jaxba.StepOptions()
        stack = lambda trees: jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees)
        layouts = [jaxba.build_layout(problem) for problem in problems]
        layout = stack(layouts)
        states = stack([jaxba.initial_state(one, p, options) for one, p in zip(layouts, problems, strict=True)])
        damping = jnp.full(scenes, 1e-3)
        step = jax.jit(jax.vmap(lambda la, s, d: jaxba.lm_step(la, s, d, options)))
        jax.block_until_ready(step(layout, states, damping))
        times = []
        for _ in range(10 * repeats):
            started = time.perf_counter()
            jax.block_until_ready(step(layout, states, damping))
            times.append(time.perf_counter() - started)
    yield Metric("scenes/10 x 10 steps", scenes / statistics.median(times), "1/s", "higher", target=20_000)


def cold_start() -> Iterator[Metric]:
    """Wall time of `jaxba-solve`, import and compilation included, without and with a warm cache, and optimised."""
    location = locate(COLD_PROBLEM)
    if location is None:
        print("left out: cold start (JAXBA_DATA)", file=sys.stderr)
        return
    with tempfile.TemporaryDirectory() as folder:
        environment = {**os.environ, "JAXBA_CACHE": folder}
        command = [sys.executable, "-c", "from jaxba.cli.solve import main; main()", location]
        runs = (("cold", 8.0, []), ("warm", 3.0, []), ("cold, full", None, ["--compilation", "full"]))
        measured = {}
        for name, target, more in runs:
            started = time.perf_counter()
            subprocess.run([*command, *more], env=environment, check=True, capture_output=True)
            measured[name] = time.perf_counter() - started
            yield Metric(f"start/jaxba-solve on ladybug-49, {name}", measured[name], "s", "lower", target=target)
        share = measured["cold"] / measured["cold, full"]
        yield Metric("start/cold over cold with full compilation", share, "ratio", "lower", GATE_TOLERANCE, target=1.0)


def main() -> int:
    """Runs the parts asked for; status 1 when the gate finds a regression."""
    parser = argparse.ArgumentParser(description="Speed of jaxba beside its peers.")
    parser.add_argument(
        "--only",
        default="iteration,scenes,cold,tolerance,large",
        help="comma-separated parts; layout, on all problems, only if named",
    )
    parser.add_argument("--solvers", default=",".join(TOLERANCE_SOLVERS), help="of the parts tolerance and large")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--gate", action="store_true", help="fail when a ratio is worse than the baseline")
    parser.add_argument("--update-baseline", action="store_true")
    parser.add_argument("--out", default="", help="write the metrics as JSON here")
    args = parser.parse_args()
    from jaxba.bench.run import machine, threads
    from jaxba.runtime import process

    process.keep_memory()
    solvers = args.solvers.split(",")
    parts = {
        "iteration": lambda: iteration_times(args.repeats, threads()),
        "layout": lambda: layout_times(args.repeats),
        "scenes": lambda: scene_throughput(args.repeats),
        "cold": cold_start,
        "tolerance": lambda: time_to_tolerance("tolerance", real_problems(), solvers, 100, args.repeats, threads()),
        "large": lambda: time_to_tolerance("large", list(LARGE_SCENES), solvers, LARGE_ITERATIONS, 1, threads()),
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
