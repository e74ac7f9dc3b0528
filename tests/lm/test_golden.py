"""Real problems against what Ceres 2.1 (C++, exact solves, its own rule) did with them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from support import DATA, needs_data, solve, start

from jaxba import StepOptions, Termination, read_problem
from jaxba.problem import geometry
from jaxba.problem.options import Refinement

pytestmark = [needs_data, pytest.mark.slow]

LADYBUG = "problem-49-7776-pre"
TRAFALGAR = "problem-21-11315-pre"

NAMES = json.loads((Path(DATA) / "reference.json").read_text()) if DATA else {}
"""Reference values by problem; empty without data."""

CERES = {
    LADYBUG: """850912.460681 46481.9269255 14817.5184734 13460.2922064 13433.0371704
        13388.7630645 13375.5073385 13365.9638953 13360.4877081 13356.5052437
        13353.6010514 13351.4119035 13349.7594793 13348.5082624 13347.5567682
        13346.8286788 13346.2678405 13345.8332324 13345.494735 13345.2299908 13345.0222184
        13344.8587053 13344.7297468 13344.6291413 13344.5512564 13344.4904052
        13344.4421992 13344.4041423 13344.3744504 13344.3512348 13344.3326215
        13344.3183995""",
    TRAFALGAR: """4413239.31443 35425.1360774 31180.9767948 30515.8079156 30424.1464789
        30388.7317701 30379.3905723 30378.6460692""",
}
"""Costs after each iteration, the start first: Ceres 2.1.0, DENSE_SCHUR, ftol 1e-6. Ceres does not
take the step whose decrease is within ftol, jaxba takes it and counts it."""

CERES_LAMBDAS = {
    LADYBUG: [1e-4, 1e-4 / 3, 1e-4 / 9, 1e-4 / 27, 3.793e-6, 3.071e-6, 2.993e-6, 2.497e-6],
    TRAFALGAR: [
        1e-4,
        1e-4 / 3,
        1.75154e-5,
        5.83848e-6,
        2.29447e-6,
        1.12572e-6,
        3.75241e-7,
        1.2508e-7,
    ],
}
"""1 / radius before each step."""


def path(name: str) -> Path:
    assert DATA is not None
    found = list(Path(DATA).glob(f"bal*/{name}.txt.bz2"))
    assert len(found) == 1, name
    return found[0]


@pytest.fixture(scope="module")
def solved():
    """Solves by problem and solver, each done once; the two rules share a compiled step."""
    done = {}

    def get(name: str, damping: str, refine_points: int = 0):
        key = (name, damping, refine_points)
        if key not in done:
            problem = read_problem(path(name))
            done[key] = solve(
                problem,
                damping,
                StepOptions(refinement=Refinement(points=refine_points)),
                callback=lambda record: None,
            )
        return done[key]

    return get


@pytest.mark.parametrize("name", NAMES)
def test_initial_cost_is_that_of_ceres(name):
    """On the host, and by the solver's own projection where it is compiled for a device."""
    reference = NAMES[name]
    problem = read_problem(path(name))
    sizes = (problem.num_cameras, problem.num_points, problem.num_observations)
    assert sizes == (reference["cameras"], reference["points"], reference["observations"])
    np.testing.assert_allclose(geometry.cost(problem), reference["initial"], rtol=1e-9)
    _, state = start(problem, StepOptions(linear_solver="implicit"))
    np.testing.assert_allclose(state.cost, reference["initial"], rtol=1e-9)


@pytest.mark.parametrize("name", [LADYBUG, TRAFALGAR])
def test_ceres_rule_walks_the_path_of_ceres(name, solved):
    """Five costs to seven digits, all of them to five: late on Ladybug lambda is 1e-8 and what
    little it adds differs, since Ceres clamps the diagonal after scaling the columns and jaxba
    before."""
    solution = solved(name, "ceres")
    expected = np.array(CERES[name].split(), float)
    costs = np.append(solution.initial_cost, solution.history.cost)[: len(expected)]
    np.testing.assert_allclose(costs[:5], expected[:5], rtol=1e-7)
    np.testing.assert_allclose(costs, expected, rtol=1e-5)
    lambdas = np.array(CERES_LAMBDAS[name])
    np.testing.assert_allclose(solution.history.damping[: len(lambdas)], lambdas, rtol=2e-4)
    assert solution.history.accepted.all()


def test_ceres_rule_converges_on_ladybug_as_ceres_does(solved):
    solution = solved(LADYBUG, "ceres")
    assert solution.termination == Termination.COST
    assert 30 <= solution.iterations <= 33
    np.testing.assert_allclose(solution.final_cost, 13344.3, atol=0.05)
    np.testing.assert_allclose(geometry.cost(solution.problem), solution.final_cost, rtol=1e-10)


def test_ceres_rule_converges_on_trafalgar_as_ceres_does(solved):
    solution = solved(TRAFALGAR, "ceres")
    assert solution.termination == Termination.COST
    assert 6 <= solution.iterations <= 8
    np.testing.assert_allclose(solution.final_cost, 30378.64, atol=0.02)


@pytest.mark.parametrize(("name", "low", "high"), [(LADYBUG, 33, 37), (TRAFALGAR, 20, 22)])
def test_the_classic_rule_needs_as_many_iterations_as_in_the_reference(name, low, high, solved):
    solution = solved(name, "classic")
    assert solution.converged
    assert low <= solution.iterations <= high
    np.testing.assert_allclose(solution.final_cost, NAMES[name]["classic"]["final"], rtol=1e-5)


def first_within(solution, bound: float) -> int:
    """Iterations until the accepted cost is at most `bound`."""
    return int(np.flatnonzero(solution.history.cost <= bound)[0]) + 1


@pytest.mark.parametrize("name", [LADYBUG, TRAFALGAR])
@pytest.mark.parametrize("rule", ["ceres", "classic"])
def test_iterations_to_a_relative_tolerance_are_those_of_the_reference(name, rule, solved):
    for key, epsilon in (("to_1e-2", 1e-2), ("to_1e-3", 1e-3)):
        count = first_within(solved(name, rule), NAMES[name]["best"] * (1 + epsilon))
        assert abs(count - NAMES[name][rule][key]) <= 1, key


def test_three_point_iterations_reach_a_thousandth_of_the_optimum_in_six_steps(solved):
    solution = solved(LADYBUG, "ceres", 3)
    assert first_within(solution, 13344.2413 * (1 + 1e-3)) <= 6
    assert solution.converged
    assert solution.iterations <= 18
    np.testing.assert_allclose(solution.final_cost, 13344.2413, rtol=1e-4)
