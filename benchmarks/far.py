"""More real problems than there are files: windows of long ones, and starts that are far away.

    python -m benchmarks.far [--solvers learned,ceres+embedded,ceres] [--seeds 2]

Fifteen problems are few: two valleys among them move a mean by a tenth. Here are windows of neighbouring cameras of
three sequences, and the others perturbed by the scale of their cameras and points (a start at hundreds to thousands of
times the best cost). All with the explicit solver and sizes rounded up, so that programs are shared. Iterations to 1e-3
of the lowest cost of the run, to convergence (a failure counts as 100), and how many end more than 1e-4 and 1e-3 above
that cost. Solvers are named as in `jaxba-bench`.
"""

from __future__ import annotations

import argparse
import statistics
from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import jax
import numpy as np

from benchmarks.padding import windows
from benchmarks.suite import real_problems
from jaxba import DampingPolicy, normalize, perturb, solve
from jaxba.bench.sources import sources
from jaxba.problem.bundle_problem import BundleProblem
from jaxba.problem.preprocess import drop_invalid
from jaxba.runtime import process
from jaxba.solver.names import parse_solver
from jaxba.solver.options import MAX_ITERATIONS, SolveOptions

WINDOWS = (("kitti00vo", 14, 16), ("kittistereo00s", 6, 16), ("bulani1", 6, 14))
"""A part of a problem's name, how many windows it is cut into, and how many cameras a window has."""

ROTATION, TRANSLATION, POINT = 0.01, 1.0, 1.0
"""Perturbation: radians, and shares of the scale of a normalised problem (`jaxba.perturb`)."""


class Case(NamedTuple):
    """A problem and the group it is counted in."""

    group: str
    name: str
    problem: BundleProblem


def cases(seeds: int) -> Iterator[Case]:
    """Windows first, then perturbed problems."""
    for source in sources(real_problems()):
        problem = source.read()
        for part, count, cameras in WINDOWS:
            if part in source.name:
                for number, window in enumerate(windows(problem, count, cameras)):
                    yield Case(f"windows of {part}", f"{part} {number}", window)
    for source in sources(real_problems()):
        if "kitti" in source.name:
            continue
        problem = normalize(source.read())
        for seed in range(seeds):
            far = perturb(problem, seed, rotation_sigma=ROTATION, translation_sigma=TRANSLATION, point_sigma=POINT)
            yield Case("perturbed", f"{source.name} {seed}", drop_invalid(far))


def main() -> None:
    """Prints a Markdown row for every problem, then one for every group."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--solvers", default="learned,ceres+embedded,ceres")
    parser.add_argument("--seeds", type=int, default=2, help="of the perturbed problems")
    args = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    process.keep_memory()
    solvers = {str(name): name.build() for name in map(parse_solver, args.solvers.split(","))}
    print("| problem |", " | ".join(solvers), "|")
    print("| --- |", " --- |" * len(solvers))
    groups: dict[str, list[list[Run]]] = {}
    for case in cases(args.seeds):
        runs = [run(case.problem, *made) for made in solvers.values()]
        best = min(each.costs[-1] for each in runs)
        groups.setdefault(case.group, []).append(runs)
        cells = (f"{each.to(best)} / {each.converged}, {each.costs[-1] / best - 1:.0e}" for each in runs)
        print(f"| {case.name} |", " | ".join(cells), "|", flush=True)
    groups["all"] = [runs for group in groups.values() for runs in group]
    for group, rows in groups.items():
        cells = []
        for column in zip(*rows, strict=True):
            bests = [min(each.costs[-1] for each in row) for row in rows]
            mean = lambda counts: f"{statistics.geometric_mean(counts):.2f}"
            reached = mean([each.to(best) for each, best in zip(column, bests, strict=True)])
            above = [each.costs[-1] / best - 1 for each, best in zip(column, bests, strict=True)]
            ends = ", ".join(str(sum(gap > limit for gap in above)) for limit in (1e-4, 1e-3))
            cells.append(f"{reached} / {mean([each.converged for each in column])} ({ends})")
        print(f"| {len(rows)} {group} |", " | ".join(cells), "|")


class Run(NamedTuple):
    """A solve."""

    costs: np.ndarray  # after each iteration, the start first
    converged: int  # iterations to convergence

    def to(self, best: float) -> int:
        """Iterations to 1e-3 of a cost, at least one."""
        near = self.costs <= best * (1 + 1e-3)
        return max(1, int(np.argmax(near))) if near[-1] else MAX_ITERATIONS


def run(problem: BundleProblem, policy: DampingPolicy, options: SolveOptions) -> Run:
    """One solve with the explicit solver."""
    found = solve(problem, policy, replace(options, linear_solver="explicit", pad=True, compilation="full"))
    costs = np.append(found.initial_cost, found.history.cost)
    return Run(costs, found.iterations if found.termination.converged else MAX_ITERATIONS)


if __name__ == "__main__":
    main()
