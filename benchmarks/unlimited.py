"""Iterations to convergence with a limit so high that it does not matter.

    python -m benchmarks.unlimited [PROBLEM ...] [--solvers classic,ceres,learned,learned+refine0] [--limit 1000]

The tables of `jaxba-bench` count a solve that has not converged after 100 iterations as 100, as the paper does, which
favours slow solvers. Here the true number is counted. The final costs are shown too, since a convergence test may also
end a slow solve far above the best cost.
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
    """Prints a Markdown row for each problem and one for the geometric means."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("problem", nargs="*")
    parser.add_argument("--solvers", default="classic,ceres,learned,learned+refine0")
    parser.add_argument("--limit", type=int, default=1000)
    args = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    process.keep_memory()
    settings = RunSettings(max_iterations=args.limit)
    problems = sources(args.problem or real_problems())
    solvers = [job.solver for job in plan(problems[:1], args.solvers.split(","), repeats=1)]
    counts: dict[str, list[int]] = {str(solver): [] for solver in solvers}
    print(
        "| problem (iterations, in brackets if not converged; final cost over the best, minus 1) |",
        " | ".join(counts),
        "|",
    )
    print("| --- |", " --- |" * len(counts))
    for source in problems:
        problem = source.read()
        records = [run_solver(problem, source, solver, 0, settings) for solver in solvers]
        best = min(record.final_cost for record in records)
        cells = []
        for record in records:
            counts[record.solver].append(record.iterations)
            count = f"{record.iterations}" if record.termination in CONVERGED else f"({record.iterations})"
            cells.append(f"{count}, {record.final_cost / best - 1:.1e}")
        print(f"| {source.name} |", " | ".join(cells), "|", flush=True)
    means = {solver: statistics.geometric_mean(each) for solver, each in counts.items()}
    print("| geometric mean |", " | ".join(f"{mean:.2f}" for mean in means.values()), "|")
    for yardstick in ("classic", "ceres"):
        if yardstick in means:
            over = ", ".join(f"{solver} {mean / means[yardstick]:.3f}" for solver, mean in means.items())
            print(f"\nover {yardstick}: {over}")


if __name__ == "__main__":
    main()
