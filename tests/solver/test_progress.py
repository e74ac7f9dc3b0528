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
    solution = run(support.tiny(), callback=lambda record: seen.append(record.iteration), verbose=True)
    rows = [line.split() for line in capsys.readouterr().out.splitlines() if line[:4].strip().isdigit()]
    assert [int(row[0]) for row in rows] == list(range(solution.iterations + 1))
    assert float(rows[0][1]) == pytest.approx(solution.initial_cost, rel=1e-6)
    assert float(rows[-1][1]) == pytest.approx(solution.final_cost, rel=1e-6)
    assert seen == list(range(1, solution.iterations + 1))
    run(support.tiny())
    assert capsys.readouterr().out == ""


def test_compilation_is_announced_where_it_takes_time(capsys, monkeypatch):
    with progress.compiling():
        pass
    assert capsys.readouterr().out == ""
    monkeypatch.setattr(progress, "BEAT_S", 0.01)
    with progress.compiling():
        time.sleep(0.3)
    words, dots = capsys.readouterr().out.split(" ")
    assert words == "compiling"
    assert dots.startswith("..")
    assert dots.endswith("\n")
