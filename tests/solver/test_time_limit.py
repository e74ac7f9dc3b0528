"""A limit of time ends a solve after the iteration in which it is over, whatever runs the
iterations.

The clock is the test's own: it stands still but where the test moves it."""

from __future__ import annotations

import threading
from dataclasses import replace

import numpy as np
import pytest
import support
from compilations import Compilations

import jaxba
from jaxba import ProblemWarning, SolveOptions, Termination, Tolerances, solve
from jaxba.problem import geometry
from jaxba.runtime import process
from jaxba.solver import many, sharded, time_limit
from jaxba.solver import solve as solving

SLOW = "constant:1"
"""A policy so cautious that a solve goes on for more iterations than a test lets it."""

OVER = "the time limit was over before the first iteration, so that the result is the start"


class Clock:
    """A clock that a test moves."""

    def __init__(self) -> None:
        self.seconds = 1000.0

    def __call__(self) -> float:
        return self.seconds

    def pass_second(self, *_: object) -> None:
        self.seconds += 1.0


class BusyClock(threading.local):
    """A clock on which a second passes each time that a thread looks at its own."""

    def __init__(self) -> None:
        self.seconds = 1000.0

    def __call__(self) -> float:
        self.seconds += 1.0
        return self.seconds


@pytest.fixture
def clock(monkeypatch):
    found = Clock()
    monkeypatch.setattr(time_limit, "clock", found)
    return found


@pytest.fixture
def busy_clock(monkeypatch):
    monkeypatch.setattr(time_limit, "clock", BusyClock())


def limited(seconds: float | None, **options) -> SolveOptions:
    return SolveOptions(
        tolerances=Tolerances(ftol=0.0, seconds=seconds), max_iterations=8, **options
    )


def in_parts(monkeypatch, problem) -> None:
    monkeypatch.setattr(sharded, "LARGE", 1)
    monkeypatch.setattr(sharded, "PART", problem.num_observations // 3)
    monkeypatch.setattr(sharded, "PART_OF_CAMERA", 0)


def assert_is_start(solution, problem) -> None:
    assert solution.termination == Termination.TIME_LIMIT
    assert solution.iterations == solution.accepted == 0
    assert (
        solution.initial_cost
        == solution.final_cost
        == pytest.approx(geometry.cost(problem), rel=1e-9)
    )
    assert np.array_equal(solution.problem.cameras, problem.cameras)
    assert np.array_equal(solution.problem.points, problem.points)
    assert solution.notes == ()


# One solve

WAYS = {
    "auto": {},
    "full": {"compilation": "full", "pad": False},
    "devices": {"devices": 2},
    "parts": {"linear_solver": "implicit"},
}


@pytest.mark.parametrize(
    "way", ["auto", *(pytest.param(way, marks=pytest.mark.slow) for way in list(WAYS)[1:])]
)
def test_a_solve_ends_after_the_iteration_in_which_the_time_is_over(way, clock, monkeypatch):
    problem = support.tiny()
    if way == "parts":
        in_parts(monkeypatch, problem)
    whole = solve(problem, SLOW, limited(None, **WAYS[way]))
    assert whole.iterations == 8
    found = solve(problem, SLOW, limited(2.5, **WAYS[way]), callback=clock.pass_second)
    assert found.termination == Termination.TIME_LIMIT
    assert found.termination.reason == "time limit"
    assert not found.converged
    assert found.iterations == 3
    np.testing.assert_allclose(found.history.cost, whole.history.cost[:3], rtol=1e-9)
    assert geometry.cost(found.problem) == pytest.approx(found.final_cost, rel=1e-9)
    assert found.final_cost < found.initial_cost


@pytest.mark.parametrize(
    "way", ["auto", *(pytest.param(way, marks=pytest.mark.slow) for way in list(WAYS)[1:])]
)
def test_the_limit_holds_without_a_callback(way, busy_clock, monkeypatch):
    problem = support.tiny()
    if way == "parts":
        in_parts(monkeypatch, problem)
    found = solve(problem, SLOW, limited(8.5, **WAYS[way]))
    assert found.termination == Termination.TIME_LIMIT
    assert 0 < found.iterations < 8


def test_a_limit_that_is_not_reached_changes_nothing_and_compiles_nothing(clock, monkeypatch):
    monkeypatch.setattr("jaxba.runtime.process.release_programs", lambda: False)
    plain = solve(support.tiny(), SLOW, limited(None))
    with Compilations() as compiled:
        ends = [solve(support.tiny(), SLOW, limited(seconds)) for seconds in (1e9, 60.0, np.inf)]
    assert not compiled.names
    for found in ends:
        assert found.termination == plain.termination == Termination.MAX_ITERATIONS
        assert np.array_equal(found.history.cost, plain.history.cost)


def test_convergence_comes_before_the_end_of_the_time(clock):
    options = SolveOptions(tolerances=Tolerances(ftol=1.0, seconds=0.5))
    assert (
        solve(support.tiny(), SLOW, options, callback=clock.pass_second).termination
        == Termination.COST
    )


@pytest.mark.parametrize("name", ["set_up", "as_measured"])
def test_a_limit_below_the_set_up_gives_the_start_with_a_warning_and_compiles_no_step(
    name, clock, monkeypatch
):
    function = getattr(solving, name)

    def slow(*given, **named):
        clock.pass_second()
        return function(*given, **named)

    monkeypatch.setattr(solving, name, slow)
    monkeypatch.setattr(solving.Stepwise, "begin", lambda *_: pytest.fail("a step is compiled"))
    with pytest.warns(ProblemWarning, match=OVER):
        found = solve(support.tiny(), SLOW, limited(0.5))
    assert_is_start(found, support.tiny())


@pytest.mark.parametrize("way", ["auto", pytest.param("devices", marks=pytest.mark.slow)])
def test_compilation_counts(way, clock, monkeypatch):
    for driver in (solving.Stepwise, solving.OnDevices):
        begin = driver.begin

        def slow(self, begin=begin):
            clock.pass_second()
            return begin(self)

        monkeypatch.setattr(driver, "begin", slow)
    with pytest.warns(ProblemWarning, match=OVER):
        found = solve(support.tiny(), SLOW, limited(0.5, **WAYS[way]))
    assert_is_start(found, support.tiny())


def test_without_iterations_there_is_no_time_to_limit(busy_clock):
    options = replace(limited(0.5), max_iterations=0)
    assert solve(support.tiny(), SLOW, options).termination == Termination.MAX_ITERATIONS


def test_a_checkpoint_goes_on_with_the_whole_limit(clock, tmp_path):
    file = tmp_path / "solve.npz"
    whole = solve(support.tiny(), SLOW, limited(None))
    ends = [
        solve(support.tiny(), SLOW, limited(2.5), checkpoint=file, callback=clock.pass_second)
        for _ in range(3)
    ]
    assert [end.iterations for end in ends] == [3, 6, 8]
    assert [end.termination for end in ends[:2]] == [Termination.TIME_LIMIT] * 2
    assert ends[2].termination == Termination.MAX_ITERATIONS
    np.testing.assert_allclose(ends[2].history.cost, whole.history.cost, rtol=1e-9)


# Several


def test_of_many_problems_each_has_its_own_limit(busy_clock, monkeypatch):
    monkeypatch.setattr(many, "WORTH", 2)
    problems = [support.tiny()] * 4
    found = list(jaxba.solve_many(problems, SLOW, limited(8.5)))
    alone = solve(support.tiny(), SLOW, limited(8.5))
    for one in found:
        assert isinstance(one, jaxba.Solution)
        assert one.termination == alone.termination == Termination.TIME_LIMIT
        assert one.iterations == alone.iterations > 0


def test_recipes_share_a_limit(clock, monkeypatch):
    monkeypatch.setattr(process, "threads", lambda: 1)  # one after the other
    iterate = solving.Stepwise.iterate

    def slow(self):
        clock.pass_second()
        return iterate(self)

    monkeypatch.setattr(solving.Stepwise, "iterate", slow)
    with pytest.warns(ProblemWarning, match=OVER):
        first, second = jaxba.solve_recipes(support.tiny(), 2, SLOW, limited(2.5))
    assert first.iterations == 3
    assert_is_start(second, support.tiny())


# Consecutive solves


def test_searches_for_points_share_the_limit(clock):
    searches = []

    def search(found) -> None:
        searches.append(found)
        clock.pass_second()

    plain = SolveOptions(compilation="quick", refinement=jaxba.Refinement(points=3))
    options = replace(plain, tolerances=Tolerances(seconds=0.5))
    # of which a point is left where it is until it is searched for
    problem = support.strayed(-3.0, every=40)
    found = jaxba.solve_and_retriangulate(problem, "ceres", options, on_search=search)
    assert len(searches) == 1
    assert found.iterations == solve(problem, "ceres", plain).iterations
    assert found.termination == Termination.TIME_LIMIT
    assert found.final_cost == pytest.approx(searches[0].cost_after, rel=1e-9)
    assert geometry.cost(found.problem) == pytest.approx(found.final_cost, rel=1e-9)


def test_stages_of_a_rejecting_solve_share_the_limit_and_say_why_they_ended(clock):
    options = SolveOptions(compilation="quick", tolerances=Tolerances(seconds=3.5))
    found = jaxba.solve_graduated(support.tiny(), SLOW, options, callback=clock.pass_second)
    assert found.termination == Termination.TIME_LIMIT
    assert found.iterations == 4
    assert found.rejected is not None
    kept = found.problem.subset(~found.rejected)
    assert geometry.cost(kept) == pytest.approx(found.final_cost, rel=1e-9)
    stopped = jaxba.solve_graduated(
        support.tiny(),
        SLOW,
        SolveOptions(compilation="quick"),
        callback=lambda record: record.iteration == 4,
    )
    assert stopped.termination == Termination.STOPPED
    assert stopped.final_cost == pytest.approx(found.final_cost, rel=1e-9)


def test_a_rejecting_solve_without_time_gives_the_start(busy_clock):
    options = SolveOptions(compilation="quick", tolerances=Tolerances(seconds=0.5))
    with pytest.warns(ProblemWarning, match=OVER):
        found = jaxba.solve_graduated(support.tiny(), SLOW, options)
    assert (found.termination, found.iterations) == (Termination.TIME_LIMIT, 0)
    assert np.array_equal(found.problem.points, support.tiny().points)
    assert found.initial_cost == found.final_cost


# Options


@pytest.mark.parametrize("seconds", [0, -1.0, float("nan"), -np.inf])
def test_a_limit_is_positive(seconds):
    with pytest.raises(ValueError, match=f"^seconds must be positive, is {seconds}$"):
        SolveOptions(tolerances=Tolerances(seconds=seconds))
