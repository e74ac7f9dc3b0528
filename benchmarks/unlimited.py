"""Iterations that solves need to converge where nothing ends them early.

    python -m benchmarks.unlimited [PROBLEM ...] [--solvers classic,ceres,learned,learned+refine0] [--limit 1000]

The tables of `jaxba-bench` count a solve that has not converged after 100 iterations as 100, as the paper does. That
flatters whoever needs more. Here the count is the true one, and the ends are told apart: a stop rule may also end a
solve that crawls, far above the best.
"""

from __future__ import annotations

import argparse
import statistics

import jax

from benchmarks.suite import real_problems
from jaxba.bench.profile import CONVERGED
from jaxba.bench.run import RunSettings, plan, run_solver
from jaxba.bench.sources import sources
from jaxba.runtime import process


def main() -> None:
    """Prints a Markdown row for every problem and one for the geometric means."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("problem", nargs="*")
    parser.add_argument("--solvers", default="classic,ceres,learned,learned+refine0")
    parser.add_argument("--limit", type=int, default=1000)
    args = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    process.keep_memory()
    settings = RunSettings(max_iterations=args.limit)
    places = sources(args.problem or real_problems())
    solvers = [job.solver for job in plan(places[:1], args.solvers.split(","), repeats=1)]
    counts: dict[str, list[int]] = {str(solver): [] for solver in solvers}
    print("| problem (iterations, in brackets if not converged; end above the best) |", " | ".join(counts), "|")
    print("| --- |", " --- |" * len(counts))
    for source in places:
        problem = source.read()
        ends = [run_solver(problem, source, solver, 0, settings) for solver in solvers]
        best = min(end.final_cost for end in ends)
        cells = []
        for end in ends:
            counts[end.solver].append(end.iterations)
            count = f"{end.iterations}" if end.termination in CONVERGED else f"({end.iterations})"
            cells.append(f"{count}, {end.final_cost / best - 1:.1e}")
        print(f"| {source.name} |", " | ".join(cells), "|", flush=True)
    means = {solver: statistics.geometric_mean(each) for solver, each in counts.items()}
    print("| geometric mean |", " | ".join(f"{mean:.2f}" for mean in means.values()), "|")
    for yardstick in ("classic", "ceres"):
        if yardstick in means:
            over = ", ".join(f"{solver} {mean / means[yardstick]:.3f}" for solver, mean in means.items())
            print(f"\nover {yardstick}: {over}")


if __name__ == "__main__":
    main()
