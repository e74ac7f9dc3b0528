"""Bundle adjustment and the search for points at other depths, in turns until that no longer pays.

Source: COLMAP's global refinement (Schoenberger, Frahm 2016, "Structure-from-motion revisited", section 4.4).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from jaxba.damping import DampingPolicy
from jaxba.problem.bundle_problem import BundleProblem
from jaxba.runtime.compilation import CompileClock
from jaxba.solver.callback_loop import IterationRecord
from jaxba.solver.loop import History
from jaxba.solver.options import SolveOptions
from jaxba.solver.prepare import DEFAULT_POLICY
from jaxba.solver.retriangulate import Retriangulation, retriangulate
from jaxba.solver.solve import Solution, solve

MAX_ROUNDS = 5
"""Searches at most. Source: COLMAP, ba_global_max_refinements."""


def solve_and_retriangulate(
    problem: BundleProblem,
    policy: str | DampingPolicy = DEFAULT_POLICY,
    options: SolveOptions | None = None,
    *,
    callback: Callable[[IterationRecord], bool | None] | None = None,
    on_search: Callable[[Retriangulation], None] | None = None,
) -> Solution:
    """`solve`, and where it converged `retriangulate`, in turns, until that no longer pays.

    It pays as long as the cost falls by more than `ftol` of it, for `MAX_ROUNDS` searches at most. Every solve but the
    first starts with the policy's first lambda.

    Args:
        problem: start of the optimisation.
        policy: as for `solve`.
        options: as for `solve`; the limit of linear solves is that of all solves together. The search has their loss,
            is in float64 and is not padded.
        callback: as for `solve`; iterations and seconds count through.
        on_search: called after every search; what does not pay (`Retriangulation.pays`) is dropped.

    Returns:
        One solution for all of it. A search counts as no iteration; its seconds are in `total_s` and `compile_s`.

    Raises:
        ValueError, ProblemError: as `solve`.
    """
    options = SolveOptions() if options is None else options
    before, stopped = (0, 0.0), False

    def heard(record: IterationRecord) -> bool:
        nonlocal stopped
        counted = record._replace(iteration=record.iteration + before[0], time_s=record.time_s + before[1])
        stopped = callback is not None and bool(callback(counted))
        return stopped

    # with a callback a solve runs step by step: one program, whatever the limit of each solve is
    run = lambda problem, limit: solve(problem, policy, replace(options, max_iterations=limit), callback=heard)
    whole = run(problem, options.max_iterations)
    for _ in range(MAX_ROUNDS):
        if stopped or not whole.converged or whole.iterations == options.max_iterations:
            break
        started = time.perf_counter()
        with CompileClock() as clock:
            found = retriangulate(whole.problem, options.loss)
        seconds = time.perf_counter() - started - clock.seconds
        whole = replace(whole, total_s=whole.total_s + seconds, compile_s=whole.compile_s + clock.seconds)
        if on_search:
            on_search(found)
        if not found.pays(options.tolerances.ftol):
            break
        before = whole.iterations, whole.total_s
        whole = _joined(whole, run(found.problem, options.max_iterations - whole.iterations))
    return whole


def _joined(before: Solution, last: Solution) -> Solution:
    """Two solves, the second of which goes on where the first ended, as one."""
    return replace(
        last,
        initial_cost=before.initial_cost,
        iterations=before.iterations + last.iterations,
        accepted=before.accepted + last.accepted,
        history=History(*(np.concatenate(pair) for pair in zip(before.history, last.history, strict=True))),
        setup_s=before.setup_s + last.setup_s,
        compile_s=before.compile_s + last.compile_s,
        total_s=before.total_s + last.total_s,
        quick_iterations=before.quick_iterations + last.quick_iterations,
    )
