"""`jaxba-tune` in this process, on rigged races: what it prints and writes, and that `jaxba-solve` reads it."""

from __future__ import annotations

import functools
from pathlib import Path

import pytest

import jaxba
from jaxba import random_scene, write_problem
from jaxba.bench import tuning
from jaxba.bench.tuning import Candidate, Played
from jaxba.cli import solve
from jaxba.cli.tune import run

BEST = Candidate(refine_points=2, repairs="trials")


@pytest.fixture
def file(tmp_path) -> Path:
    path = tmp_path / "street.txt"
    write_problem(random_scene(jaxba.SceneConfig(cameras=16, points=200), 0), path)
    return path


def rig(monkeypatch, best: Candidate, ratio: float) -> None:
    """Makes one setting cheaper than all others, which are alike."""
    play = lambda candidate, part: Played((ratio if candidate == best else 1.0) * part.linear_s, 1.0)
    monkeypatch.setattr(tuning, "tune", functools.partial(tuning.tune, play=play))


def test_what_is_found_is_written_for_jaxba_solve_and_the_same_command_says_the_same(
    file, tmp_path, monkeypatch, capsys
):
    rig(monkeypatch, BEST, 0.5)
    said, out = [], tmp_path / "settings.yaml"
    for _ in range(2):
        assert run([str(file), "--windows", "8", "--out", str(out)]) == 0
        said.append((capsys.readouterr().out, out.read_text()))
    assert said[0] == said[1]
    line = f"better than the default: {BEST}, 0.50 [0.50, 0.50] of its price on 8 held-out windows"
    assert line in said[0][0].splitlines()
    assert f"# {line}" in said[0][1].splitlines()
    args = solve.with_settings(str(out), [str(file), "--repairs", "all"])
    assert (args.problem, args.refine_points, args.repairs) == (str(file), 2, "all")


def test_where_nothing_is_better_the_file_has_the_default(file, tmp_path, monkeypatch, capsys):
    rig(monkeypatch, tuning.DEFAULT, 0.5)
    out = tmp_path / "settings.yaml"
    assert run([str(file), "--windows", "8", "--out", str(out)]) == 0
    assert "nothing is better than the default: no other won the race" in capsys.readouterr().out.splitlines()
    assert solve.with_settings(str(out), []) == solve.Arguments()


@pytest.mark.parametrize(
    ("words", "named"),
    [
        ([], "files"),
        (["FILE", "--seconds", "301"], "--seconds"),
        (["FILE", "--windows", "7"], "--windows"),
        (["FILE", "--seed", "-1"], "--seed"),
        (["FILE", "--out", "FILE"], "--out"),
        (["FILE", "--within", "0"], "--within"),
        (["missing.txt"], "missing.txt"),
        (["SMALL"], "8 cameras"),
    ],
)
def test_bad_input_is_one_line_that_names_it(words, named, file, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    small = tmp_path / "small.txt"
    write_problem(random_scene(jaxba.SceneConfig(cameras=6, points=30), 0), small)
    assert run([{"FILE": str(file), "SMALL": str(small)}.get(word, word) for word in words]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert named in said
    assert not (tmp_path / "settings.yaml").exists()
