"""Seconds of solves with fixed efforts: what a policy could gain that chooses the effort of each iteration.

    python -m benchmarks.efforts [PROBLEM ...] [--repeats 3]

An effort is a number of embedded point iterations, and repairs (backtracking, camera rounds, pattern moves) or none;
each is combined with policies for lambda. Every combination solves every problem several times, in turns, fully
compiled. Counted are the seconds until the cost is within tau of the best that any combination finds, the least of the
repeats. The tables: for each combination the geometric mean over the problems of its seconds relative to those of the
virtual best, where a failure counts as `FAILURE`; and for each problem the seconds of its best combination, of the best
one in all, and of `learned` with its own effort.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from jaxba.bench.sources import sources
from jaxba.damping import make_policy
from jaxba.damping.agent_config import AgentConfig
from jaxba.problem.bundle_problem import BundleProblem
from jaxba.problem.options import Refinement, StepOptions
from jaxba.runtime import process
from jaxba.solver.options import SolveOptions
from jaxba.solver.solve import solve

TOLERANCES = (1e-3, 1e-4)
"""tau of the cost that counts as reached."""

FAILURE = 10.0
"""Seconds of a failure, relative to the virtual best."""

POINTS = (0, 1, 3)
"""Numbers of embedded point iterations."""

SHIPPED = ("learned", 3, True)
"""The step and the policy that ship as `learned`."""


@dataclass(frozen=True)
class Arguments:
    """Options of the benchmark."""

    problems: Annotated[tuple[str, ...], tyro.conf.Positional] = ("scene:trafalgar-21", "scene:ladybug-49")
    """Files, folders or random scenes, as for jaxba-bench."""

    policies: tuple[str, ...] = ("learned", "bold", "ceres", "nielsen", "constant:1e-4", "constant:1e-6")
    """What chooses lambda."""

    repeats: int = 3
    """Solves of each combination."""

    max_iterations: int = 60
    """Limit of linear solves."""

    out: Path | None = None
    """File for all numbers, JSON."""


Combination = tuple[str, int, bool]
"""Policy, point iterations, repairs."""


def name_of(combination: Combination) -> str:
    """The combination in words."""
    policy, points, repairs = combination
    return f"{policy}, {points} point iterations, {'' if repairs else 'no '}repairs"


def step_of(points: int, repairs: bool) -> Refinement:
    """The embedded iterations of an effort: with repairs, all others of the shipped step."""
    if not repairs:
        return Refinement(points=points)
    return replace(AgentConfig().step_options(StepOptions()).refinement, points=points)


def trace(problem: BundleProblem, combination: Combination, max_iterations: int) -> list[tuple[float, float]]:
    """Seconds and cost after every iteration of a solve."""
    name, points, repairs = combination
    policy = make_policy(name)
    shipped = AgentConfig().step_options(StepOptions())
    options = SolveOptions(
        refinement=step_of(points, repairs),
        coordinates=shipped.coordinates,
        max_iterations=max_iterations,
        compilation="full",
    )
    found: list[tuple[float, float]] = []
    solve(problem, policy, options, callback=lambda record: found.append((record.time_s, float(record.step.cost))))
    return found


def seconds_to(found: Sequence[tuple[float, float]], target: float) -> float:
    """Seconds until the cost is at most the target; infinite if it never is."""
    return next((seconds for seconds, cost in found if cost <= target), np.inf)


def compare(problem: BundleProblem, combinations: Sequence[Combination], args: Arguments) -> tuple[np.ndarray, float]:
    """Seconds of each combination to each tolerance [combinations, tolerances], and the best cost."""
    traces: list[list] = [[] for _ in combinations]
    for _ in range(args.repeats):
        for found, combination in zip(traces, combinations, strict=True):
            found.append(trace(problem, combination, args.max_iterations))
    best = min(found[0][-1][1] for found in traces)
    seconds = [[min(seconds_to(one, best * (1 + tau)) for one in found) for tau in TOLERANCES] for found in traces]
    return np.array(seconds), best


def relative(seconds: np.ndarray) -> np.ndarray:
    """Seconds [problems, combinations] relative to the virtual best of each problem, failures as `FAILURE`."""
    return np.minimum(seconds / seconds.min(axis=1, keepdims=True), FAILURE)


def report(names: Sequence[str], combinations: Sequence[Combination], seconds: np.ndarray) -> None:
    """Prints the tables of seconds [problems, combinations, tolerances]."""
    for k, tau in enumerate(TOLERANCES):
        ratio = relative(seconds[:, :, k])
        mean = np.exp(np.log(ratio).mean(axis=0))
        fixed = int(np.argmin(mean))
        print(f"\nto {tau:g}: mean relative to the best of {len(combinations)} for each problem; failures")
        for i in np.argsort(mean):
            print(f"{mean[i]:6.2f} {int(np.isinf(seconds[:, i, k]).sum()):3}  {name_of(combinations[i])}")
        shipped = combinations.index(SHIPPED) if SHIPPED in combinations else fixed
        print(f"seconds: best, {name_of(combinations[fixed])}, {name_of(combinations[shipped])}")
        for p, name in enumerate(names):
            best = int(np.argmin(seconds[p, :, k]))
            numbers = " ".join(f"{seconds[p, i, k]:8.3f}" for i in (best, fixed, shipped))
            print(f"{name:36} {numbers}  {name_of(combinations[best])}")


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the benchmark."""
    args = tyro.cli(Arguments, args=argv)
    process.keep_memory()
    process.load_lapack()
    combinations = [(name, points, repairs) for repairs in (False, True) for points in POINTS for name in args.policies]
    found, names = [], []
    for source in sources(list(args.problems)):
        seconds, best = compare(source.read(), combinations, args)
        found.append(seconds)
        names.append(source.name)
        k = int(np.argmin(seconds[:, 0]))
        print(f"{source.name}: cost {best:.8g}, {seconds[k, 0]:.3f} s by {name_of(combinations[k])}", flush=True)
        process.release_programs()
    report(names, combinations, np.array(found))
    if args.out:
        contents = {"problems": names, "combinations": combinations, "seconds": np.array(found).tolist()}
        args.out.write_text(json.dumps(contents))
    return 0


if __name__ == "__main__":
    sys.exit(main())
