"""`jaxba-solve --seconds`: the best state so far is written, and that is no failure."""

from __future__ import annotations

import csv

import numpy as np
import pytest
import support

import jaxba
from jaxba.cli.several import COSTS
from jaxba.cli.solve import run
from jaxba.problem import geometry
from jaxba.solver import time_limit

ASKED = ("--policy", "constant:1", "--compilation", "quick", "--ftol", "0")


@pytest.fixture(autouse=True)
def busy_clock(monkeypatch):
    """On which a second passes each time that somebody looks at it."""
    seconds = iter(range(10**9))
    monkeypatch.setattr(time_limit, "clock", lambda: float(next(seconds)))


@pytest.fixture
def tiny(tmp_path):
    jaxba.write_bal(support.tiny(), tmp_path / "tiny.txt")
    return tmp_path / "tiny.txt"


def test_the_best_state_so_far_is_written(tiny, tmp_path, capsys):
    output = tmp_path / "out.txt"
    assert run([str(tiny), *ASKED, "--seconds", "8.5", "--strict", "--output", str(output)]) == 0
    assert "not converged: time limit" in capsys.readouterr().out
    assert geometry.cost(jaxba.read_bal(output)) < geometry.cost(support.tiny())


def test_a_limit_below_the_set_up_writes_the_start_with_a_note_and_is_no_failure(
    tiny, tmp_path, capsys
):
    output = tmp_path / "out.txt"
    assert run([str(tiny), *ASKED, "--seconds", "0.5", "--strict", "--output", str(output)]) == 0
    shown = capsys.readouterr()
    assert "note: the time limit was over before the first iteration" in shown.out
    assert "not converged: time limit" in shown.out
    assert not shown.err
    np.testing.assert_array_equal(jaxba.read_bal(output).points, jaxba.read_bal(tiny).points)


def test_several_problems_and_recipes_have_it(tiny, tmp_path, capsys):
    jaxba.write_bal(support.tiny(), tmp_path / "other.txt")
    folder = tmp_path / "solved"
    paths = [str(tiny), str(tmp_path / "other.txt")]
    assert run([*paths, *ASKED, "--seconds", "20", "--output", str(folder)]) == 0
    with (folder / COSTS).open(newline="") as file:
        assert [row["end"] for row in csv.DictReader(file)] == ["time limit"] * 2
    capsys.readouterr()
    assert (
        run(
            [
                str(tiny),
                "--compilation",
                "quick",
                "--ftol",
                "0",
                "--seconds",
                "8.5",
                "--recipes",
                "2",
            ]
        )
        == 0
    )
    assert "not converged: time limit" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("value", "said"),
    [
        ("0", "--seconds must be positive, is 0.0"),
        ("-1", "--seconds must be positive, is -1.0"),
        ("nan", "--seconds must be positive, is nan"),
        ("soon", "--seconds must be a number, not 'soon'"),
    ],
)
def test_a_limit_that_is_none_is_refused_in_one_line(tiny, capsys, value, said):
    assert run([str(tiny), "--seconds", value]) == 2
    assert capsys.readouterr().err == f"error: {said}\n"
