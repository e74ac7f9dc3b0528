"""Bundle adjustment and the search for points at other depths, in turns until that no longer pays.

Source: COLMAP's global refinement (Schoenberger, Frahm 2016, "Structure-from-motion revisited", section 4.4).
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from jaxba.damping import DampingPolicy
from jaxba.lm.termination import Tolerances
from jaxba.problem.bundle_problem import BundleProblem
from jaxba.problem.options import StepOptions
from jaxba.runtime.compilation import CompileClock
from jaxba.solver.callback_loop import IterationRecord
from jaxba.solver.loop import History
from jaxba.solver.retriangulate import Retriangulation, retriangulate
from jaxba.solver.solve import MAX_ITERATIONS, Solution, solve

MAX_ROUNDS = 5
"""Searches at most. Source: COLMAP, ba_global_max_refinements."""


def solve_and_retriangulate(
    problem: BundleProblem,
    damping: str | DampingPolicy = "ceres",
    options: StepOptions | None = None,
    *,
    max_iterations: int = MAX_ITERATIONS,
    tolerances: Tolerances | None = None,
    callback: Callable[[IterationRecord], bool | None] | None = None,
    on_search: Callable[[Retriangulation], None] | None = None,
    **more: Any,
) -> Solution:
    """`solve`, and where it converged `retriangulate`, in turns, until that no longer pays.

    It pays as long as the cost falls by more than `ftol` of it, for `MAX_ROUNDS` searches at most. Every solve but the
    first starts with the policy's first lambda.

    Args:
        problem: start of the optimisation.
        damping: as for `solve`.
        options: as for `solve`; their loss is that of the search.
        max_iterations: limit of linear solves, all solves together.
        tolerances: as for `solve`, for each of the solves.
        callback: as for `solve`; iterations and seconds count through.
        on_search: called after every search; what does not pay (`Retriangulation.pays`) is dropped.
        more: further arguments of `solve`; the search itself is in float64 and is not padded.

    Returns:
        One solution for all of it. A search counts as no iteration; its seconds are in `total_s` and `compile_s`.

    Raises:
        ValueError, ProblemError: as `solve`.
    """
    tolerances = tolerances or Tolerances()
    before, stopped = (0, 0.0), False

    def heard(record: IterationRecord) -> bool:
        nonlocal stopped
        counted = record._replace(iteration=record.iteration + before[0], time_s=record.time_s + before[1])
        stopped = callback is not None and bool(callback(counted))
        return stopped

    # with a callback a solve runs step by step: one program, whatever the limit of each solve is
    run = functools.partial(solve, damping=damping, options=options, tolerances=tolerances, callback=heard, **more)
    whole = run(problem, max_iterations=max_iterations)
    for _ in range(MAX_ROUNDS):
        if stopped or not whole.converged or whole.iterations == max_iterations:
            break
        started = time.perf_counter()
        with CompileClock() as clock:
            found = retriangulate(whole.problem, options.loss if options else None)
        seconds = time.perf_counter() - started - clock.seconds
        whole = replace(whole, total_s=whole.total_s + seconds, compile_s=whole.compile_s + clock.seconds)
        if on_search:
            on_search(found)
        if not found.pays(tolerances.ftol):
            break
        before = whole.iterations, whole.total_s
        whole = _joined(whole, run(found.problem, max_iterations=max_iterations - whole.iterations))
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
