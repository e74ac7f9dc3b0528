"""A stream of problems that breaks off, and results that nobody wants any more."""

from __future__ import annotations

import itertools
import subprocess
import sys
import threading

import pytest

import jaxba
from jaxba import Solution, solve_many
from jaxba.solver import many

LEFT = """
import itertools, signal, time
import jaxba
from jaxba.solver import many

def solve(*given):
    time.sleep(0.05)
    return object.__new__(jaxba.Solution)

many.solve = solve
stream = itertools.repeat(jaxba.random_scene(jaxba.scene_like("tiny"), 0))
results = jaxba.solve_many(stream, "ceres", jaxba.SolveOptions(linear_solver="implicit"))
for taken, result in enumerate(results):
    if taken == 3:
        {leave}
"""
"""A program that leaves results of an endless stream, up to two thousand of which are pending."""


@pytest.fixture
def solved(monkeypatch):
    """Solves that take no time and are none."""
    monkeypatch.setattr(many, "solve", lambda *given: object.__new__(Solution))


def test_a_stream_that_fails_gives_the_results_of_what_was_read_first(solved):
    scene = jaxba.random_scene(jaxba.scene_like("tiny"), 0)

    def stream():
        yield OSError("one that cannot be read")
        yield from itertools.repeat(scene, 20)
        raise KeyError("disk")

    results = solve_many(stream())
    found = []
    with pytest.raises(KeyError, match="disk"):
        found.extend(results)
    assert [isinstance(result, Solution) for result in found] == [False, *[True] * 20]
    with pytest.raises(KeyError, match="disk"):
        list(solve_many(itertools.chain(map({}.__getitem__, ["disk"]), [scene])))


def test_the_thread_that_closes_may_be_one_that_solves(monkeypatch):
    """As where the garbage collector runs there."""
    read, left, closed = (threading.Event() for _ in range(3))
    number = itertools.count()
    scene = jaxba.random_scene(jaxba.scene_like("tiny"), 0)

    def stream():
        yield from [scene] * 3
        read.set()
        yield from itertools.repeat(OSError("missing"), many.AHEAD)

    def solve(*given):
        own = next(number)  # the first is solved by this thread
        if own == 1:
            read.wait(10)
        if own == 2:
            left.wait(10)
            results.close()
            closed.set()
        return object.__new__(Solution)

    monkeypatch.setattr(many, "solve", solve)
    results = solve_many(stream(), "ceres", jaxba.SolveOptions(linear_solver="implicit"))
    assert all(isinstance(next(results), Solution) for _ in range(2))
    left.set()
    assert closed.wait(10)
    assert next(results, None) is None


@pytest.mark.parametrize(
    ("leave", "said"),
    [
        ("break", ""),
        pytest.param("raise KeyError('mine')", "KeyError: 'mine'", marks=pytest.mark.slow),
        pytest.param(
            "signal.raise_signal(signal.SIGINT)", "KeyboardInterrupt", marks=pytest.mark.slow
        ),
        pytest.param("results.close()", "", marks=pytest.mark.slow),
    ],
)
def test_results_that_are_left_end_with_the_program_and_say_nothing(leave, said):
    code = LEFT.format(leave=leave)
    done = subprocess.run(
        [sys.executable, "-c", code], stderr=subprocess.PIPE, text=True, timeout=60
    )
    assert done.stderr.count("Traceback") == bool(said)
    assert said in done.stderr
    assert "ignored" not in done.stderr
    assert done.stderr == "" or said
