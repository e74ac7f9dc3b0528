"""An LM step on a GPU: phases, floating point types, several devices, throughput of small scenes
and of training, memory.

    python -m benchmarks.gpu [--problems scene:ladybug-1197,...] [--out benchmarks/gpu/results.json]
    [--any-device]

Without a GPU it prints a message and measures nothing, unless `--any-device` is given.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

import jaxba
from benchmarks import sac
from benchmarks.phases import HEADING, bandwidth, measure, timed
from jaxba.bench.sources import sources
from jaxba.problem.options import Refinement, StepOptions
from jaxba.solver.choose import choose
from jaxba.solver.options import SolveOptions
from jaxba.structure.layout import build_layout
from jaxba.training.sac import SacConfig

PROBLEMS = "scene:ladybug-49,scene:random-150,scene:ladybug-1197,scene:venice-1778"
"""Random scenes, which need no files on the machine with the GPU."""

BATCHES = (256, 4096, 16384)
"""Numbers of small scenes in a batch."""

ENVIRONMENTS = (64, 512, 4096)
"""Numbers of environments of a training."""


def steps(problem: jaxba.BundleProblem, iterations: int) -> Iterator[dict[str, Any]]:
    """Seconds per iteration of complete solves, for each floating point type, without and with
    point iterations."""
    for dtype in ("float64", "mixed", "float32"):
        for refine in (0, 3):
            options = SolveOptions(
                refinement=Refinement(points=refine),
                dtype=dtype,
                max_iterations=iterations,
                compilation="full",
            )

            def run(options=options):
                return jaxba.solve(problem, "ceres", options)

            first = run()
            second = run()
            yield {
                "dtype": dtype,
                "refine": refine,
                "solver": second.linear_solver,
                "compile_s": first.compile_s,
                "setup_s": second.setup_s,
                "seconds_per_iteration": second.total_s / second.iterations,
                "cost": second.final_cost,
                "cg": float(second.history.cg_iterations.mean()),
            }


def divided(problem: jaxba.BundleProblem, iterations: int) -> Iterator[dict[str, Any]]:
    """Seconds per iteration with points divided among 1, 2, 4, ... of the devices, by the implicit
    solver."""
    count = 1
    while count <= len(jax.devices()):
        options = SolveOptions(
            linear_solver="implicit",
            devices=count,
            max_iterations=iterations,
            compilation="full",
            pad=False,
        )
        jaxba.solve(problem, "ceres", options)
        found = jaxba.solve(problem, "ceres", options)
        seconds = found.total_s / found.iterations
        yield {
            "devices": count,
            "seconds_per_iteration": seconds,
            "cost": found.final_cost,
            "setup_s": found.setup_s,
        }
        count *= 2


def training_throughput(envs: int) -> dict[str, float]:
    """Environment steps and gradient updates per second of SAC's compiled loop on so many
    pendulums."""
    measure = sac.ours(SacConfig(), envs, 512)
    samples = [measure() for _ in range(3)]
    updates = statistics.median(sample.updates / sample.wall_s for sample in samples)
    return {"updates_per_s": updates, "steps_per_s": updates * envs}


def scene_throughput(count: int, dtype: Any) -> float:
    """LM steps per second on `count` scenes of 10 cameras and 10 points in one program."""
    options = StepOptions()
    problems = [
        jaxba.random_scene(jaxba.scene_like("paper"), seed) for seed in range(min(count, 256))
    ]
    layouts = [jaxba.build_layout(problem) for problem in problems]
    states = [
        jaxba.initial_state(la, p, options, dtype) for la, p in zip(layouts, problems, strict=True)
    ]

    def tile(x):
        return jnp.tile(x, (-(-count // len(problems)),) + (1,) * (x.ndim - 1))[:count]

    def stack(trees):
        return jax.tree.map(lambda *leaves: tile(jnp.stack(leaves)), *trees)

    def step(la, s, d):
        return jaxba.lm_step(la, s, d, options)

    damping = jnp.full(count, 1e-3, dtype)
    _, _, median, _ = timed(jax.vmap(step), stack(layouts), stack(states), damping, repeats=10)
    return count / median


def peak_bytes() -> int | None:
    """Peak memory in use so far; None if the device does not report it."""
    stats = jax.devices()[0].memory_stats()
    return None if stats is None else int(stats.get("peak_bytes_in_use", 0))


def main() -> int:
    """Prints and writes the results; returns 3 without a GPU."""
    parser = argparse.ArgumentParser(description="An LM step on a GPU.")
    parser.add_argument("--problems", default=PROBLEMS)
    parser.add_argument("--batches", default=",".join(map(str, BATCHES)))
    parser.add_argument("--repeats", type=int, default=20)
    parser.add_argument("--iterations", type=int, default=10)
    parser.add_argument("--out", default="")
    parser.add_argument(
        "--any-device", action="store_true", help="run on the default device of JAX"
    )
    args = parser.parse_args()
    device = jax.devices()[0]
    if device.platform != "gpu" and not args.any_device:
        print(f"no GPU: JAX has only {device.device_kind!r}; nothing was measured", file=sys.stderr)
        return 3
    jax.config.update("jax_enable_x64", True)
    results: dict[str, Any] = {
        "device": device.device_kind,
        "jax": jax.__version__,
        "problems": {},
        "scenes": {},
    }
    rate = bandwidth()
    results["copy_bytes_per_s"] = rate
    print(f"{device.device_kind}, copy bandwidth {rate / 1e9:.0f} GB/s")
    for source in sources(args.problems.split(",")):
        problem = source.read()
        print(
            f"\n{source.name}: {problem.num_cameras} cameras, {problem.num_observations} "
            f"observations\n{HEADING}"
        )
        options = StepOptions(linear_solver=choose(problem), refinement=Refinement(points=3))
        started = time.perf_counter()
        layout = jax.device_put(build_layout(problem, options))
        entry: dict[str, Any] = {
            "solver": options.linear_solver,
            "layout_s": time.perf_counter() - started,
        }
        entry["phases"] = []
        for phase in measure(layout, problem, options, rate, args.repeats):
            print(phase, flush=True)
            entry["phases"].append(phase._asdict())
        entry["steps"] = []
        for step in steps(problem, args.iterations):
            print(step, flush=True)
            entry["steps"].append(step)
        entry["divided"] = []
        for row in divided(problem, args.iterations):
            print(row, flush=True)
            entry["divided"].append(row)
        entry["peak_bytes"] = peak_bytes()
        results["problems"][source.name] = entry
    for count in map(int, args.batches.split(",")):
        for dtype in (jnp.float64, jnp.float32):
            rates = [scene_throughput(count, dtype) for _ in range(3)]
            name = f"{count} x {jnp.dtype(dtype).name}"
            results["scenes"][name] = statistics.median(rates)
            print(f"scenes 10 x 10, {name}: {results['scenes'][name]:.0f} steps/s", flush=True)
    results["training"] = {}
    for envs in ENVIRONMENTS:
        results["training"][str(envs)] = training_throughput(envs)
        print(f"training, {envs} environments: {results['training'][str(envs)]}", flush=True)
    if args.out:
        Path(args.out).write_text(json.dumps(results, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
