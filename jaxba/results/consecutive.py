"""Several solves of one problem, one after the other, that look like one from outside."""

from __future__ import annotations

import functools
from dataclasses import replace

import jax
import numpy as np
from jaxtyping import Int

from jaxba.damping import DampingPolicy
from jaxba.lm.termination import Termination
from jaxba.problem.bundle_problem import BundleProblem
from jaxba.solver.drivers import Callback, IterationRecord, Watch
from jaxba.solver.options import SolveOptions
from jaxba.solver.progress import Waiting
from jaxba.solver.solve import Solution, solve_without
from jaxba.solver.time_limit import TimeLimit

STOPS = (Termination.STOPPED, Termination.TIME_LIMIT)
"""Ends of a solve after which no other one goes on."""


class Consecutive:
    """Solves with one policy and one time limit. Callback and watch count iterations and seconds
    over all of them."""

    stopped = False
    """Whether the callback has asked to stop, or the time limit is over."""

    def __init__(
        self,
        policy: str | DampingPolicy,
        callback: Callback | None,
        watch: Watch | None,
        waiting: Waiting,
        limit: TimeLimit,
    ) -> None:
        self._policy = policy
        self._callback = callback
        self._watch = watch
        self._waiting = waiting
        self._limit = limit
        self.done: list[Solution] = []

    @property
    def total(self) -> Solution:
        """All solves together."""
        return functools.reduce(joined, self.done)

    def begin_phase(self, text: str) -> None:
        """Shows what the next solve is of."""
        self._waiting.begin_phase(text)

    def solve(
        self,
        away: Int[np.ndarray, " away"],
        problem: BundleProblem,
        options: SolveOptions,
        whole: BundleProblem,
    ) -> Solution:
        """`solve_without`; who watches sees the parameters in `whole`. It runs from Python, so that
        all limits use the same programs."""
        count = sum(one.iterations for one in self.done)
        seconds = sum(one.total_s for one in self.done)
        watch = self._watch

        def of_all(record: IterationRecord) -> IterationRecord:
            return record._replace(
                iteration=record.iteration + count, time_s=record.time_s + seconds
            )

        def forward(record: IterationRecord) -> bool:
            self.stopped = bool(self._callback and self._callback(of_all(record)))
            return self.stopped

        seen = watch and (
            lambda record, now: watch(of_all(record), lambda: with_parameters(whole, now()))
        )
        hooks = {"callback": forward, "watch": seen, "waiting": self._waiting}
        found = solve_without(away, problem, self._policy, self._limit.rest(options), **hooks)
        self.stopped |= found.termination == Termination.TIME_LIMIT
        self.done.append(found)
        return found


def with_parameters(problem: BundleProblem, found: BundleProblem) -> BundleProblem:
    """The problem with the parameters of another one, of other observations."""
    names = ("cameras", "points", "rigs", "residuals")
    return problem.replace(**{name: getattr(found, name) for name in names})


def joined(before: Solution, last: Solution) -> Solution:
    """The solution of two consecutive solves together. One that follows a stopped one only computes
    costs."""
    return replace(
        last,
        termination=before.termination if before.termination in STOPS else last.termination,
        initial_cost=before.initial_cost,
        start=before.start,
        iterations=before.iterations + last.iterations,
        accepted=before.accepted + last.accepted,
        history=jax.tree.map(
            lambda *columns: np.concatenate(columns), before.history, last.history
        ),
        setup_s=before.setup_s + last.setup_s,
        compile_s=before.compile_s + last.compile_s,
        total_s=before.total_s + last.total_s,
        quick_iterations=before.quick_iterations + last.quick_iterations,
    )
