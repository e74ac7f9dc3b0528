"""Bundle adjustment and retriangulation in alternation, until retriangulation no longer lowers the
cost.

Source: COLMAP's global refinement (Schoenberger, Frahm 2016, "Structure-from-motion revisited",
section 4.4)."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

from jaxba.damping import DampingPolicy
from jaxba.problem.bundle_problem import BundleProblem
from jaxba.problem.facing import set_aside
from jaxba.results.consecutive import Consecutive
from jaxba.results.retriangulate import Retriangulation, retriangulate_without
from jaxba.runtime.compilation import CompileClock
from jaxba.solver.drivers import Callback, Watch
from jaxba.solver.options import SolveOptions, checked_options
from jaxba.solver.place import check_problem
from jaxba.solver.prepare import DEFAULT_POLICY
from jaxba.solver.progress import shown
from jaxba.solver.solve import Solution
from jaxba.solver.start import as_measured
from jaxba.solver.time_limit import TimeLimit

MAX_ROUNDS = 5
"""Most retriangulations. Source: COLMAP, ba_global_max_refinements."""


def solve_and_retriangulate(
    problem: BundleProblem,
    policy: str | DampingPolicy = DEFAULT_POLICY,
    options: SolveOptions | None = None,
    *,
    callback: Callback | None = None,
    on_search: Callable[[Retriangulation], None] | None = None,
    watch: Watch | None = None,
    verbose: bool = False,
) -> Solution:
    """`solve` and, if it converged, `retriangulate`, alternately.

    It ends when a retriangulation lowers the cost by at most `ftol` times the cost, or after
    `MAX_ROUNDS` of them. Every solve starts with the policy's initial lambda. Returns one solution
    for all solves. Retriangulation is not an iteration; its time is in `total_s` and `compile_s`.
    Raises ValueError, ProblemError: as `solve`.

    Args:
        problem: start of the optimisation.
        policy: as for `solve`.
        options: as for `solve`; `max_iterations` and `Tolerances.seconds` limit all solves
            together. Retriangulation uses the same loss, in float64 and without padding.
        callback: as for `solve`; iterations and seconds are counted over all solves.
        on_search: called after every retriangulation, including the last one, whose result is
            discarded if the decrease is too small (`Retriangulation.pays`).
        watch: as for `solve`; iterations and seconds are counted over all solves.
        verbose: as for `solve`."""
    check_problem(problem)
    options = checked_options(options)
    limit = TimeLimit(options)
    problem = as_measured(problem)
    callback, waiting = shown(callback, verbose)
    away = set_aside(problem)
    solves = Consecutive(policy, callback, watch, waiting, limit)

    def run(problem: BundleProblem, iterations: int) -> None:
        solves.solve(away, problem, replace(options, max_iterations=iterations), problem)

    run(problem, options.max_iterations)
    for _ in range(MAX_ROUNDS):
        solution = solves.total
        if (
            solves.stopped
            or not solution.converged
            or solution.iterations == options.max_iterations
        ):
            break
        started = time.perf_counter()
        with CompileClock() as clock:
            found = retriangulate_without(away, solution.problem, options.loss)
        seconds = time.perf_counter() - started - clock.seconds
        last = solves.done[-1]
        taken = {"total_s": last.total_s + seconds, "compile_s": last.compile_s + clock.seconds}
        solves.done[-1] = replace(last, **taken)
        if on_search:
            on_search(found)
        if not found.pays(options.tolerances.ftol):
            break
        run(found.problem, options.max_iterations - solution.iterations)
    limit.warn_if_too_short(solves.total.termination, solves.total.iterations)
    return solves.total
