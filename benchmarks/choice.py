"""Times of the linear solvers, compared with the predictions of the cost model
(`solver/choose.py`).

    python -m benchmarks.choice [PROBLEM ...] [--solver ceres+refine3] [--iterations 6] [--repeats
    5] [--fit]

A problem is a file or a random scene (`scene:random-150`). Default: those in `JAXBA_DATA` and two
random scenes. For each linear solver, the whole loop is one compiled program; the solvers are timed
alternately. `loss` is the time of the solver that `auto` chooses over that of the fastest. `--fit`
prints the constants of the cost model that fit these times best, with the counted number of
products in conjugate gradients."""

from __future__ import annotations

import argparse
import statistics
from dataclasses import replace
from typing import NamedTuple

import jax
import numpy as np
from scipy.optimize import nnls

import jaxba
from benchmarks.suite import LARGE_SCENES, real_problems
from jaxba.bench.sources import sources
from jaxba.problem.bundle_problem import BundleProblem
from jaxba.runtime import process
from jaxba.solver.choose import SECONDS, Work, choose, seconds, work
from jaxba.solver.names import parse_solver


class Timed(NamedTuple):
    """Measurement of a linear solver on a problem."""

    seconds: float  # per iteration
    products: float  # matrix-vector products of conjugate gradients per iteration


def measure(problem: BundleProblem, solver: str, iterations: int, repeats: int) -> dict[str, Timed]:
    """Median time of an iteration with each linear solver that fits into memory, timed alternately.
    The first round compiles and is not counted."""
    spent: dict[str, list[float]] = {name: [] for name in work(problem)}
    products = {}
    for repeat in range(repeats + 1):
        for name, times in spent.items():
            policy, options = parse_solver(solver).build()
            end = jaxba.solve(
                problem,
                policy,
                replace(options, linear_solver=name, max_iterations=iterations, compilation="full"),
            )
            products[name] = float(np.sum(end.history.cg_iterations)) / end.iterations
            if repeat:
                times.append(end.total_s / end.iterations)
    return {name: Timed(statistics.median(times), products[name]) for name, times in spent.items()}


def fit(done: list[tuple[Work, float]]) -> Work:
    """The non-negative constants with the least sum of squared relative errors."""
    taken = np.array([each for _, each in done])
    unit = np.array(list(SECONDS.values()))
    amounts = (
        np.array([[amounts.get(kind, 0.0) for kind in SECONDS] for amounts, _ in done])
        * unit
        / taken[:, None]
    )
    found, _ = nnls(amounts, np.ones(len(done)))
    return dict(zip(SECONDS, (found * unit).tolist(), strict=True))


def main() -> None:
    """Prints a line for each problem, and the fit."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("problem", nargs="*")
    parser.add_argument("--solver", default="ceres+refine3")
    parser.add_argument("--iterations", type=int, default=6)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--fit", action="store_true")
    args = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    process.keep_memory()
    done = []
    losses = []
    print("problem: solver measured ms (predicted, with the products counted) ...: loss of auto")
    for source in sources(args.problem or [*real_problems(), *LARGE_SCENES]):
        problem = source.read()
        times = measure(problem, args.solver, args.iterations, args.repeats)
        taken = choose(problem)
        losses.append(times[taken].seconds / min(time.seconds for time in times.values()))
        cells = []
        for name, time in times.items():
            amounts = work(problem, time.products)[name]
            done.append((amounts, time.seconds))
            mark = "*" if name == taken else ""
            cells.append(
                f"{mark}{name} {1e3 * time.seconds:.2f} ({1e3 * seconds(amounts):.2f}, "
                f"{time.products:.1f})"
            )
        print(f"{source.name}: {'; '.join(cells)}: {losses[-1]:.2f}", flush=True)
    print(f"loss: geometric mean {np.exp(np.mean(np.log(losses))):.3f}, largest {max(losses):.2f}")
    if args.fit:
        for name, each in fit(done).items():
            print(f"{name}: {each:.2e} (stated: {SECONDS[name]:.2e})")


if __name__ == "__main__":
    from jaxba.runtime.process import single_blas_thread

    with single_blas_thread():
        main()
