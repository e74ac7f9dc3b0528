"""What parts of an iteration cost beside its linear solve, and how well that predicts the seconds of whole solves.

    python -m benchmarks.prices [PROBLEM ...] [--repeats 15]

For each problem, in milliseconds, medians: the plain step without its candidate (`propose`), a candidate, one embedded
point iteration, and a camera round. Then the seconds of whole solves: those that the parts and the counted work
(`StepInfo`) predict over those measured; the same by the cost model (`solver/cost_model.py`), whose seconds are of
another machine: over their geometric mean. Last the fit for the cost model: seconds of each part as a constant and a
share for each observation.
"""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from scipy.optimize import nnls

from jaxba.bench.sources import sources
from jaxba.lm.records import StepInfo
from jaxba.lm.step import propose, try_step
from jaxba.problem.bundle_problem import BundleProblem
from jaxba.problem.options import Refinement, StepOptions
from jaxba.refinement.cameras import refine_cameras
from jaxba.runtime import process
from jaxba.runtime.numerics import numerics
from jaxba.solver.names import parse_solver
from jaxba.solver.prepare import prepare
from jaxba.solver.solve import solve

POINTS = 3
"""Point iterations of the candidate that is compared with a plain one."""

SOLVERS = ("ceres", "ceres+refine1", "ceres+refine3", "ceres+embedded", "learned")
"""Solves to predict."""


@dataclass(frozen=True)
class Arguments:
    """Options of the benchmark."""

    problems: Annotated[tuple[str, ...], tyro.conf.Positional] = ("scene:trafalgar-21", "scene:ladybug-49")
    """Files, folders or random scenes, as for jaxba-bench."""

    repeats: int = 15
    """Runs of each part."""


@dataclass(frozen=True)
class Parts:
    """Seconds of the parts of an iteration."""

    propose: float
    candidate: float
    point_iteration: float
    camera_round: float

    def predict(self, step: StepInfo) -> float:
        """Seconds of an iteration by the work that its record counts. Each repair evaluates a candidate."""
        return float(
            self.propose
            + self.candidate * (1 + step.repairs)
            + self.point_iteration * step.point_iterations
            + self.camera_round * step.camera_rounds
        )


def parts_of(problem: BundleProblem, repeats: int) -> Parts:
    """Times the parts in turns, each a compiled program."""
    prepared = prepare(problem, "ceres", replace(parse_solver("ceres").build()[1], compilation="full", pad=False))
    layout, state, options = prepared.layout, prepared.state, prepared.options
    damping = jnp.asarray(1e-4)
    with numerics(np.dtype("float64")):
        with_points = replace(options, refinement=Refinement(points=POINTS))
        proposal = jax.jit(propose, static_argnames="options")(layout, state, damping, options=options)
        trying = jax.jit(try_step, static_argnames="options")
        attempt: Callable[[StepOptions], Callable[[], Any]] = lambda options: (
            lambda: trying(layout, state, damping, proposal, options=options)
        )
        proposing = jax.jit(propose, static_argnames="options")
        rounds = jax.jit(refine_cameras, static_argnames="options")
        programs: list[Callable[[], Any]] = [
            lambda: proposing(layout, state, damping, options=options),
            attempt(options),
            attempt(with_points),
            lambda: rounds(layout, state.cameras, state.points, options=with_points),
        ]
        times: list[list[float]] = [[] for _ in programs]
        for repeat in range(repeats + 1):
            for program, taken in zip(programs, times, strict=True):
                started = time.perf_counter()
                jax.block_until_ready(program())
                if repeat:
                    taken.append(time.perf_counter() - started)
    linear, plain, refined, cameras = map(statistics.median, times)
    return Parts(linear, plain, max(refined - plain, 0.0) / POINTS, cameras)


def solves(problem: BundleProblem, parts: Parts) -> dict[str, tuple[float, float]]:
    """Seconds of whole solves, measured and predicted."""
    found = {}
    for name in SOLVERS:
        policy, options = parse_solver(name).build()
        options = replace(options, compilation="full", max_iterations=30)
        runs = []
        for _ in range(3):
            steps: list[Any] = []
            solve(problem, policy, options, callback=steps.append)
            runs.append((steps[-1].time_s, sum(parts.predict(one.step) for one in steps)))
        found[name] = min(runs)
    return found


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the benchmark."""
    args = tyro.cli(Arguments, args=argv)
    process.keep_memory()
    process.load_lapack()
    rows, ratios = [], []
    print("problem, observations: propose, candidate, point iteration, camera round in ms; predicted over measured")
    for source in sources(list(args.problems)):
        problem = source.read()
        parts = parts_of(problem, args.repeats)
        rows.append((problem.num_observations, parts))
        by_solver = {name: predicted / seconds for name, (seconds, predicted) in solves(problem, parts).items()}
        ratios += by_solver.values()
        times = " ".join(f"{1e3 * x:7.3f}" for x in vars(parts).values())
        shown = ", ".join(f"{name} {ratio:.2f}" for name, ratio in by_solver.items())
        print(f"{source.name:36} {problem.num_observations:7} {times}  {shown}", flush=True)
        process.release_programs()
    print(f"predicted over measured: {np.exp(np.log(ratios).mean()):.2f}, {min(ratios):.2f} to {max(ratios):.2f}")
    for name in ("candidate", "point_iteration", "camera_round"):
        seconds = np.array([max(getattr(parts, name), 1e-6) for _, parts in rows])
        share = np.exp(np.mean(np.log(seconds / [parts.propose + parts.candidate for _, parts in rows])))
        amounts = np.array([(1.0, count) for count, _ in rows])
        (constant, each), _ = nnls(amounts / seconds[:, None], np.ones(len(rows)))  # least relative squares
        errors = amounts @ (constant, each) / seconds
        spread = f"fit over measured {errors.min():.2f} to {errors.max():.2f}"
        print(f"{name}: {constant:.1e} s and {each:.2e} s an observation, {spread}; {share:.3f} of a plain step")
    return 0


if __name__ == "__main__":
    sys.exit(main())
