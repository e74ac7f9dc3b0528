"""Iterations on more problems than there are files: windows of long sequences, and distant starts.

    python -m benchmarks.far [--solvers learned,ceres+embedded,ceres] [--seeds 2]

Means over the few real problems change by a tenth if two of them converge to other local minima. This benchmark has
windows of neighbouring cameras of three sequences, and the other problems with large perturbations of cameras and
points (initial costs of hundreds to thousands of times the best cost). All use the explicit solver and padded sizes, so
that they share compiled programs. The tables show the iterations until the cost is within 1e-3 of the lowest cost, the
iterations to convergence (100 for a failure), and how many solves end more than 1e-4 and 1e-3 above that cost. Solvers
are named as in `jaxba-bench`.
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
"""Part of the name of a problem, number of its windows, and number of cameras of a window."""

ROTATION, TRANSLATION, POINT = 0.01, 1.0, 1.0
"""Standard deviations of the perturbation: radians, and relative to the scale of a normalised problem
(`jaxba.perturb`)."""


class Case(NamedTuple):
    """A problem and its group in the means."""

    group: str
    name: str
    problem: BundleProblem


def cases(seeds: int) -> Iterator[Case]:
    """The windows, then the perturbed problems, each with `seeds` random seeds."""
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
    """Prints a Markdown row for each problem, then one for each group."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--solvers", default="learned,ceres+embedded,ceres")
    parser.add_argument("--seeds", type=int, default=2, help="perturbations of each problem")
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
    """Result of a solve."""

    costs: np.ndarray  # at the start and after each iteration, pixels squared
    converged: int  # iterations to convergence

    def to(self, best: float) -> int:
        """Iterations until the cost is within 1e-3 of `best`, at least 1; `MAX_ITERATIONS` if that never happens."""
        near = self.costs <= best * (1 + 1e-3)
        return max(1, int(np.argmax(near))) if near[-1] else MAX_ITERATIONS


def run(problem: BundleProblem, policy: DampingPolicy, options: SolveOptions) -> Run:
    """Solves a problem with the explicit linear solver and padded sizes."""
    found = solve(problem, policy, replace(options, linear_solver="explicit", pad=True, compilation="full"))
    costs = np.append(found.initial_cost, found.history.cost)
    return Run(costs, found.iterations if found.termination.converged else MAX_ITERATIONS)


if __name__ == "__main__":
    main()
