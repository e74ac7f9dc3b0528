"""Iterations that solves need to converge where nothing ends them early.

    python -m benchmarks.unlimited [PROBLEM ...] [--solvers classic,ceres,learned,learned+refine0] [--limit 1000]

The tables of `jaxba-bench` count a solve that has not converged after 100 iterations as 100, as the paper does. That
flatters whoever needs more. Here the count is the true one, and the ends are told apart: a stop rule may also end a
solve that crawls, far above the best.
"""

from __future__ import annotations

import argparse
import statistics
from typing import NamedTuple

import jax

import jaxba
from benchmarks.suite import real_problems
from jaxba import host
from jaxba.bench.sources import sources
from jaxba.naming import parse_solver
from jaxba.problem import BundleProblem


class End(NamedTuple):
    """How a solve ended."""

    iterations: int
    converged: bool
    cost: float


def end_of(problem: BundleProblem, solver: str, limit: int) -> End:
    """Solves a problem with `auto`'s linear solver."""
    name = parse_solver(solver)
    policy, options = name.build()
    found = jaxba.solve(
        problem, policy, options, method=name.method, linear_solver="auto", max_iterations=limit, dtype=name.dtype
    )
    return End(found.iterations, found.converged, found.final_cost)


def main() -> None:
    """Prints a Markdown row for every problem and one for the geometric means."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("problem", nargs="*")
    parser.add_argument("--solvers", default="classic,ceres,learned,learned+refine0")
    parser.add_argument("--limit", type=int, default=1000)
    args = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    host.keep_memory()
    solvers = args.solvers.split(",")
    counts: dict[str, list[int]] = {solver: [] for solver in solvers}
    print("| problem (iterations, in brackets if not converged; end above the best) |", " | ".join(solvers), "|")
    print("| --- |", " --- |" * len(solvers))
    for source in sources(args.problem or real_problems()):
        ends = {solver: end_of(source.read(), solver, args.limit) for solver in solvers}
        best = min(end.cost for end in ends.values())
        cells = []
        for solver, end in ends.items():
            counts[solver].append(end.iterations)
            count = f"{end.iterations}" if end.converged else f"({end.iterations})"
            cells.append(f"{count}, {end.cost / best - 1:.1e}")
        print(f"| {source.name} |", " | ".join(cells), "|", flush=True)
    means = {solver: statistics.geometric_mean(each) for solver, each in counts.items()}
    print("| geometric mean |", " | ".join(f"{mean:.2f}" for mean in means.values()), "|")
    for yardstick in ("classic", "ceres"):
        if yardstick in means:
            over = ", ".join(f"{solver} {mean / means[yardstick]:.3f}" for solver, mean in means.items())
            print(f"\nover {yardstick}: {over}")


if __name__ == "__main__":
    main()
