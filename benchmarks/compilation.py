"""Time to compile the parts of a step and time to run them, at each level of optimisation.

    python -m benchmarks.compilation PROBLEM ... [--solver guarded] [--linear-solver auto]
    [--repeats 15] python -m benchmarks.compilation PROBLEM ... --whole

PROBLEM is a file or a random scene (`scene:random-150`), the solver one of `jaxba-bench`. The last
column shows after how many runs, times the observations of the problem and in millions, the faster
programs of a better level have repaid its longer compilation; the constants of
`jaxba/runtime/compilation.py` come from them. The levels are timed alternately in one process,
without a compilation cache, at the start of the problem with lambda 1e-4. `--whole` times calls of
`jaxba-solve FILE` alternately with `--compilation auto` and `full`."""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxba.bench.sources import sources
from jaxba.lm import step
from jaxba.problem.options import LinearSolverChoice
from jaxba.refinement.cameras import refine_cameras
from jaxba.refinement.candidates import first_search, has_repairs
from jaxba.runtime import process
from jaxba.runtime.compilation import OLDER_EMITTERS, Level, compiler_options
from jaxba.runtime.fusion import fast_compilation
from jaxba.solver.choose import choose_linear_solver
from jaxba.solver.methods import DEFAULT_METHOD
from jaxba.solver.names import parse_solver
from jaxba.solver.stepwise import try_candidate
from jaxba.structure.layout import build_layout

LONGEST = 10.0
"""Limit in seconds of all repeats of one program."""

LEVELS: tuple[Level, ...] = ("quick", "full")
"""Levels of optimisation, by increasing time of compilation and decreasing time of a run."""

REPAID = (("quick", "full"),)
"""Levels in the last column, the better one second."""

HEADING = (
    f"{'problem':28s} {'linear solver':13s} {'part':9s}"
    + "".join(f" {level + ': compile s':>17s} {'run ms':>8s}" for level in LEVELS)
    + "".join(f" {worse + '->' + better:>13s}" for worse, better in REPAID)
)


def measure(
    step: Any, arguments: tuple[Any, ...], level: Level, repeats: int
) -> tuple[float, float]:
    """Seconds of compilation including tracing, and median seconds of a run."""
    options: Any = compiler_options(level)
    started = time.perf_counter()
    with fast_compilation(OLDER_EMITTERS in options):
        lowered = jax.jit(step).lower(*arguments)
    compiled = lowered.compile(options)
    compile_s = time.perf_counter() - started
    jax.block_until_ready(compiled(*arguments))
    times: list[float] = []
    while len(times) < 3 or (len(times) < repeats and sum(times) < LONGEST):
        started = time.perf_counter()
        jax.block_until_ready(compiled(*arguments))
        times.append(time.perf_counter() - started)
    return compile_s, float(np.median(times))


def rows(
    location: str, solver: str, linear_solver: LinearSolverChoice, repeats: int
) -> Iterator[str]:
    """Lines of the table for the parts of a step on a problem."""
    source = sources([location])[0]
    problem = source.read()
    name = parse_solver(solver)
    policy, solve_options = name.build()
    choice = linear_solver if name.method == DEFAULT_METHOD else "auto"
    options = choose_linear_solver(problem, solve_options.step_options(policy), choice)
    with jax.enable_x64(name.dtype == "float64"):
        dtype = jnp.dtype(name.dtype)
        layout = jax.device_put(build_layout(problem, options))
        state = jax.jit(step.initial_state, static_argnums=(2, 3))(layout, problem, options, dtype)
        given = (layout, state, jnp.asarray(1e-4, dtype))

        def propose(la, s, d):
            return step.propose(la, s, d, options)

        # a separate program, not the one that is timed
        proposal = jax.jit(lambda *given: propose(*given))(*given)
        parts: dict[str, tuple[Any, tuple[Any, ...]]] = {
            "propose": (propose, given),
            "try_step": (
                lambda la, s, d, p: step.try_step(la, s, d, p, options),
                (*given, proposal),
            ),
        }
        if has_repairs(options):
            del parts["try_step"]
            search = first_search(state.cameras, state.points, state.cost, proposal.step)

            def candidate(la, s, p, *rest):
                return try_candidate(la, s, p, options, jnp.zeros((), dtype), *rest)

            parts["candidate"] = (candidate, (layout, state, proposal, search, state.cameras))
        if options.refinement.camera_rounds:

            def cameras(la, c, p):
                return refine_cameras(la, c, p, options)

            parts["cameras"] = (cameras, (layout, state.cameras, state.points))
        for part, (function, arguments) in parts.items():
            measured = {level: measure(function, arguments, level, repeats) for level in LEVELS}
            line = f"{source.name[:28]:28s} {options.solver_name:13s} {part:9s}"
            for compile_s, run_s in measured.values():
                line += f" {compile_s:17.2f} {1e3 * run_s:8.1f}"
            for worse, better in REPAID:
                longer = measured[better][0] - measured[worse][0]
                faster = 1e6 * (measured[worse][1] - measured[better][1]) / problem.num_observations
                line += f" {longer / faster if faster > 0 else np.inf:13.1f}"
            yield line


WHOLE = (
    f"{'problem':28s} {'auto: whole s':>13s} {'compile s':>9s} {'iter':>4s} {'full: whole s':>13s} "
    f"{'compile s':>9s} "
    f"{'iter':>4s} {'auto/full':>9s} {'ends differ':>11s}"
)


def whole(location: str) -> tuple[str, float]:
    """Calls of `jaxba-solve` with `--compilation auto` and `full` without a cache: the line of the
    table, and the ratio of their times."""
    cells = f"{Path(location).name[:28]:28s}"
    costs = []
    seconds = []
    with tempfile.TemporaryDirectory() as folder:
        for compilation in ("auto", "full"):
            log = Path(folder) / f"{compilation}.json"
            command = [sys.executable, "-c", "from jaxba.cli.solve import main; main()", location]
            command += ["--compilation", compilation, "--log", str(log)]
            started = time.perf_counter()
            subprocess.run(
                command, env={**os.environ, "JAXBA_CACHE": "off"}, check=True, capture_output=True
            )
            seconds.append(time.perf_counter() - started)
            record = json.loads(log.read_text())
            costs.append(record["final_cost"])
            cells += f" {seconds[-1]:13.2f} {record['compile_s']:9.2f} {record['iterations']:4d}"
    ratio = seconds[0] / seconds[1]
    return f"{cells} {ratio:9.2f} {abs(costs[0] / costs[1] - 1):11.1e}", ratio


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("problem", nargs="+")
    parser.add_argument("--solver", default="guarded")
    parser.add_argument("--linear-solver", default="auto")
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--whole", action="store_true", help="time calls of jaxba-solve")
    args = parser.parse_args()
    if args.whole:
        print(WHOLE)
        ratios = []
        for location in args.problem:
            line, ratio = whole(location)
            ratios.append(ratio)
            print(line, flush=True)
        print(f"geometric mean of auto/full {np.exp(np.mean(np.log(ratios))):.2f}")
        return
    process.keep_memory()
    print(HEADING)
    with process.single_blas_thread():
        for location in args.problem:
            for line in rows(location, args.solver, args.linear_solver, args.repeats):
                print(line, flush=True)
            process.release_programs()


if __name__ == "__main__":
    main()
