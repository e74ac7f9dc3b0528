"""Inexact linear solvers end where a factorisation does, on random problems of every kind
(random_problems.py)."""

from __future__ import annotations

import pytest
from random_problems import draw
from support import solve

from jaxba import Termination, Tolerances

TIGHT = {"tolerances": Tolerances(ftol=1e-13, xtol=1e-12), "max_iterations": 300}


def check(kind: int, seed: int, inexact: tuple[str, ...]) -> None:
    problem, loss = draw(kind, seed)
    for options in (TIGHT, {}):

        def end(solver, options=options):
            return solve(problem, linear_solver=solver, loss=loss, compilation="quick", **options)

        exact = end("explicit")
        if exact.termination == Termination.MAX_ITERATIONS:  # its steps are damped to the end
            continue
        for solver in inexact:
            found = end(solver)
            assert found.converged
            if options:
                assert found.final_cost <= (1 + 1e-8) * exact.final_cost
            elif solver != "cg":  # which makes no more products where more are needed
                assert found.iterations <= 2 * exact.iterations + 5


@pytest.mark.slow
def test_conjugate_gradients_end_where_a_factorisation_does():
    """Two sensors, the place of one free, and priors of positions."""
    check(25, 0, ("implicit",))


@pytest.mark.slow
@pytest.mark.parametrize("kind", range(12))
def test_all_solvers_end_where_a_factorisation_does(kind):
    for seed in range(2):
        check(kind, seed, ("sparse", "implicit", "cg"))
