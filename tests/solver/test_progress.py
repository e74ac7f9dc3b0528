"""What `solve` prints if it is verbose."""

from __future__ import annotations

import time

import pytest
import support

import jaxba
from jaxba.solver import progress


@pytest.mark.parametrize("run", [jaxba.solve, jaxba.solve_and_retriangulate])
def test_a_verbose_solve_prints_a_row_for_every_iteration_and_calls_back(run, capsys):
    seen = []
    solution = run(
        support.tiny(), callback=lambda record: seen.append(record.iteration), verbose=True
    )
    rows = [
        line.split() for line in capsys.readouterr().out.splitlines() if line[:4].strip().isdigit()
    ]
    assert [int(row[0]) for row in rows] == list(range(solution.iterations + 1))
    assert float(rows[0][1]) == pytest.approx(solution.initial_cost, rel=1e-6)
    assert float(rows[-1][1]) == pytest.approx(solution.final_cost, rel=1e-6)
    assert seen == list(range(1, solution.iterations + 1))
    run(support.tiny())
    assert capsys.readouterr().out == ""


def test_compilation_is_announced_where_it_takes_time(capsys, monkeypatch):
    with progress.Printed().compiling():
        pass
    assert capsys.readouterr().out == ""
    monkeypatch.setattr(progress, "BEAT_S", 0.01)
    with progress.Printed().compiling():
        time.sleep(0.3)
    words, dots = capsys.readouterr().out.split(" ")
    assert words == "compiling"
    assert dots.startswith("..")
    assert dots.endswith("\n")


def test_a_long_iteration_counts_its_seconds_on_a_terminal_beside_those_of_the_last_one(
    capsys, monkeypatch
):
    monkeypatch.setattr(progress, "BEAT_S", 0.001)
    monkeypatch.setattr(progress, "LONG_ITERATION_S", 0.0)
    waiting = progress.Printed()
    with waiting.iterating(1):
        pass
    assert capsys.readouterr().out == ""  # no terminal
    monkeypatch.setattr("sys.stdout.isatty", lambda: True)
    with waiting.iterating(2):
        shown = ""
        while "last" not in shown:  # however late the other thread is
            shown += capsys.readouterr().out
    shown += capsys.readouterr().out
    assert shown.startswith("\r   2  0 s, the last one took 0 ")
    assert shown.endswith("\r\033[K")
    monkeypatch.setattr(progress, "LONG_ITERATION_S", 1e9)
    with waiting.iterating(3):
        pass
    assert capsys.readouterr().out == ""


def test_a_long_solve_says_what_it_takes_before_it_starts(capsys, monkeypatch):
    for name in ("LONG_S", "ANNOUNCED"):
        monkeypatch.setattr(f"jaxba.solver.estimate.{name}", 0)
    jaxba.solve(support.tiny(), options=jaxba.SolveOptions(max_iterations=1), verbose=True)
    first = capsys.readouterr().out.splitlines()[0]
    assert first.startswith(f"{support.tiny().num_observations} observations: some ")
    assert first.endswith(" s an iteration")
