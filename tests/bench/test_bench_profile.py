"""Tolerances and performance profiles against numbers worked out by hand."""

import math
from dataclasses import replace
from itertools import pairwise

import pytest

from jaxba.bench import profile
from jaxba.bench.profile import Target
from jaxba.game.statistics import Reached
from jaxba.solver.record import Record, TracePoint


def make_record(problem, solver, costs, *, step_s=1.0, repeat=0, termination="ftol"):
    """A run whose i-th iteration ends at `i * step_s` with accepted cost `costs[i]`; equal costs
    are rejections."""
    trace = [TracePoint(0, 0.0, costs[0], math.nan, True, 0, math.nan)]
    for i, (before, cost) in enumerate(pairwise(costs), start=1):
        trace.append(
            TracePoint(i, i * step_s, cost, 1e-3, cost < before, 0, 0.5 if cost < before else -1.0)
        )
    accepted = sum(p.accepted for p in trace[1:])
    ends = (len(costs) * step_s, costs[0], costs[-1], len(costs) - 1, accepted, 0, termination)
    return Record(
        problem,
        "f",
        2,
        3,
        4,
        solver,
        "jax",
        "cpu",
        "float64",
        2,
        repeat,
        0.0,
        0.0,
        *ends,
        tuple(trace),
    )


FAST = make_record("p", "fast", [1000.0, 200.0, 100.05, 100.0])
SLOW = make_record("p", "slow", [1000.0, 500.0, 500.0, 200.0, 101.0, 100.2], step_s=2.0)
STUCK = make_record("p", "stuck", [1000.0] * 101, termination="max_iterations")
RECORDS = [FAST, SLOW, STUCK]
NEVER = (math.inf, math.inf)


@pytest.mark.parametrize(
    ("target", "fast", "slow", "stuck"),
    [
        (Target("tau", 0.1), (2.0, 2.0), (4.0, 8.0), NEVER),  # 100 + 0.1 * 900 = 190
        (Target("tau", 1e-3), (2.0, 2.0), (5.0, 10.0), NEVER),  # 100.9
        (Target("relative", 1e-2), (2.0, 2.0), (4.0, 8.0), NEVER),  # 101, reached exactly by slow
        (Target("relative", 1e-3), (2.0, 2.0), NEVER, NEVER),  # 100.1
        (Target("relative", 1e-4), (3.0, 3.0), NEVER, NEVER),  # 100.01
        (Target("converged"), (3.0, 3.0), (5.0, 10.0), NEVER),
    ],
)
def test_targets_are_reached_when_computed_by_hand(target, fast, slow, stuck):
    table = profile.reach_table(RECORDS, target)
    assert {solver: row["p"] for solver, row in table.items()} == {
        "fast": Reached(*fast),
        "slow": Reached(*slow),
        "stuck": Reached(*stuck),
    }


def test_best_cost_is_the_lowest_accepted_cost_of_any_solver():
    assert profile.best_cost(RECORDS) == {"p": 100.0}
    assert profile.initial_costs(RECORDS) == {"p": 1000.0}


def test_of_a_float32_run_only_the_final_cost_counts_which_is_computed_in_float64():
    rough = replace(
        make_record("p", "rough", [1000.0, 99.99, 99.98]), dtype="float32", final_cost=100.01
    )
    assert profile.best_cost([FAST, rough]) == {"p": 100.0}
    assert profile.best_cost([FAST, replace(rough, final_cost=99.0)]) == {"p": 99.0}


def test_non_finite_costs_are_never_best_and_never_reached():
    broken = make_record("p", "broken", [math.nan, math.nan])
    assert profile.best_cost([broken, FAST]) == {"p": 100.0}
    assert profile.first(broken, 1e9) == Reached(math.inf, math.inf)
    assert math.isnan(profile.best_cost([broken])["p"])
    assert profile.reach_table([broken], Target("tau", 0.1))["broken"]["p"] == Reached(
        math.inf, math.inf
    )


def test_start_below_the_threshold_counts_as_iteration_zero():
    assert profile.first(FAST, 1000.0) == Reached(0.0, 0.0)


def test_a_zero_residual_problem_does_not_demand_the_same_rounding_error_of_every_solver():
    exact = make_record("z", "exact", [1.0, 1e-3, 1e-26])
    other = make_record("z", "other", [1.0, 1e-2, 1e-11, 3e-13])
    table = profile.reach_table([exact, other], Target("relative", 1e-4))
    assert table["exact"]["z"].iterations == 2
    assert table["other"]["z"].iterations == 3  # below 1e-12 f0, though 13 decades above f*
    assert profile.relative_threshold(1.0, 0.0, 1e-4) == 1e-12
    assert profile.relative_threshold(1000.0, 100.0, 1e-2) == 101.0


def test_converging_after_the_limit_is_a_failure():
    late = make_record("p", "late", [1000.0 - i for i in range(102)])
    assert late.iterations == 101
    assert not profile.converged(late)
    assert profile.converged(make_record("p", "in time", [1000.0 - i for i in range(101)]))
    assert not profile.converged(STUCK)


def test_the_solver_and_the_benchmark_agree_about_what_is_converged():
    # here, so that the pure functions are tested without the solver
    from jaxba.solver.solve import Termination

    for reason in Termination:
        assert profile.converged(replace(FAST, termination=reason.name.lower())) == reason.converged
    assert profile.converged(replace(FAST, termination="CONVERGENCE"))


def test_repeats_are_combined_by_their_median_and_half_failed_is_failed():
    def repeats(*steps):
        return [
            make_record("p", "a", [1000.0, 100.0], step_s=step, repeat=i)
            for i, step in enumerate(steps)
        ]

    assert profile.reach_table(repeats(5.0, 1.0, 2.0), Target("converged"))["a"]["p"] == Reached(
        1.0, 2.0
    )
    failed = make_record("p", "a", [1000.0, 1000.0], repeat=9, termination="max_iterations")
    two_of_three = [*repeats(1.0, 3.0), failed]
    assert profile.reach_table(two_of_three, Target("converged"))["a"]["p"] == Reached(1.0, 3.0)
    one_of_two = [*repeats(1.0), failed]
    assert profile.reach_table(one_of_two, Target("converged"))["a"]["p"] == Reached(
        math.inf, math.inf
    )


def test_profile_with_a_tie_a_failure_and_a_problem_that_no_solver_solves():
    times = {
        "a": {"p": 1.0, "q": 2.0, "r": math.inf, "s": math.inf},
        "b": {"p": 1.0, "q": 1.0, "r": 4.0, "s": math.nan},
        "c": {"p": 3.0},  # was not run on the others
        "d": {"p": math.inf, "q": math.inf, "r": math.inf, "s": math.inf},
    }
    curves = profile.performance_profile(times)
    assert curves["a"] == ((1.0, 2.0), (0.25, 0.5))
    assert curves["b"] == ((1.0,), (0.75,))  # never 1: s stays in the denominator
    assert curves["c"] == ((1.0, 3.0), (0.0, 0.25))
    assert curves["d"] == ((1.0,), (0.0,))


def test_profile_of_problems_solved_at_the_start_and_of_nothing():
    curves = profile.performance_profile({"a": {"p": 0.0}, "b": {"p": 0.0}, "c": {"p": 1.0}})
    assert [curves[s] for s in "abc"] == [((1.0,), (1.0,)), ((1.0,), (1.0,)), ((1.0,), (0.0,))]
    assert profile.performance_profile({}) == {}
    assert profile.performance_profile({"a": {}}) == {"a": ((1.0,), (0.0,))}


def test_different_starts_and_different_cost_definitions_are_reported():
    assert profile.cost_warnings(RECORDS) == []
    near = make_record("p", "float32", [1000.0 * (1 + 1e-6), 100.0])
    assert profile.cost_warnings([FAST, near]) == []
    zeroing = make_record("p", "colmap", [999.8, 99.0])
    (line,) = profile.cost_warnings([FAST, zeroing])
    assert "0.02 %" in line
    assert "rounding" in line
    other = make_record("p", "other", [980.0, 99.0])
    (line,) = profile.cost_warnings([FAST, other])
    assert "2 %" in line
    assert "did not start alike" in line
