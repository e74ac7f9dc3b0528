"""`jaxba-solve` with several problems: a solution and a line for each, whatever becomes of the
others."""

from __future__ import annotations

import csv
import os

import numpy as np
import pytest

import jaxba
from jaxba.cli import common, several, solve
from jaxba.cli.several import COSTS
from jaxba.cli.solve import run

ASKED = ("--policy", "ceres", "--max-iterations", "5", "--compilation", "quick")


@pytest.fixture
def problems(tmp_path):
    """Three problems in a folder."""
    folder = tmp_path / "given"
    folder.mkdir()
    for seed in range(3):
        jaxba.write_problem(
            jaxba.random_scene(jaxba.scene_like("tiny"), seed), folder / f"scene-{seed}.txt.gz"
        )
    return folder


def rows(folder) -> list[dict[str, str]]:
    with (folder / COSTS).open(newline="") as file:
        return list(csv.DictReader(file))


def test_each_problem_of_a_folder_has_a_solution_and_a_line(problems, tmp_path, capsys):
    output = tmp_path / "solved"
    assert run([str(problems), "--output", str(output), *ASKED]) == 0
    assert "3 problems solved, 0 failed" in capsys.readouterr().out
    found = rows(output)
    assert [row["problem"] for row in found] == [f"scene-{seed}.txt.gz" for seed in range(3)]
    for row in found:
        alone = jaxba.solve(
            jaxba.read_problem(problems / row["problem"]),
            "ceres",
            jaxba.SolveOptions(max_iterations=5, compilation="quick"),
        )
        np.testing.assert_allclose(float(row["initial_cost"]), alone.initial_cost, rtol=1e-9)
        np.testing.assert_allclose(float(row["final_cost"]), alone.final_cost, rtol=1e-9)
        assert int(row["iterations"]) == alone.iterations
        written = jaxba.read_problem(output / row["problem"])
        np.testing.assert_allclose(written.points, alone.problem.points, rtol=1e-7, atol=1e-9)


def test_one_that_fails_is_one_line_and_the_others_go_on(problems, tmp_path, capsys):
    (problems / "bad\n.txt").write_text("2 1 2\nthese are no numbers\n")
    output = tmp_path / "solved"
    assert run([str(problems), "--output", str(output), *ASKED]) == 2
    errors = [line for line in capsys.readouterr().err.splitlines() if "bad" in line]
    assert len(errors) == 1
    assert errors[0].startswith("error: ")
    assert errors[0].count("bad\\n.txt") == 1
    assert [bool(row["final_cost"]) for row in rows(output)] == [False, True, True, True]
    assert not (output / "bad\n.txt").exists()


def test_what_is_only_read_is_written_as_a_bal_file_and_a_folder_of_opensfm_is_one_problem(
    problems, tmp_path
):
    paths = ["a/x.sfm", "a/y.json", "a/z.txt.gz"]
    assert several._names(paths) == ["x.sfm.txt", "y.json.txt", "z.txt.gz"]
    (tmp_path / "sfm").mkdir()
    (tmp_path / "sfm" / "reconstruction.json").write_text("[]")
    assert several.inputs([str(tmp_path / "sfm")]) == []
    assert several.inputs([str(tmp_path / "sfm"), "b.txt"]) == [str(tmp_path / "sfm"), "b.txt"]
    assert several.inputs([str(problems)]) == sorted(map(str, problems.iterdir()))
    with pytest.raises(common.UsageError):
        several.inputs(["-", "b.txt"])


def test_a_run_goes_on_where_it_was_also_after_a_line_that_was_cut(problems, tmp_path, capsys):
    output = tmp_path / "solved"
    paths = sorted(map(str, problems.iterdir()))
    assert run([*paths[:2], "--output", str(output), *ASKED]) == 0
    first = rows(output)
    assert run([*paths, "--output", str(output), *ASKED]) == 2
    assert "--resume" in capsys.readouterr().err
    costs = output / COSTS
    costs.write_bytes(costs.read_bytes()[:-20])  # killed while it wrote the second line
    solution = output / first[0]["problem"]
    written = solution.stat().st_mtime_ns
    assert run([*paths, "--output", str(output), "--resume", *ASKED]) == 0
    assert "1 of 3 are there already" in capsys.readouterr().out
    found = rows(output)
    assert [row["problem"] for row in found] == [f"scene-{seed}.txt.gz" for seed in range(3)]
    assert found[0] == first[0]
    assert found[1]["final_cost"]
    assert solution.stat().st_mtime_ns == written


@pytest.mark.parametrize(
    "more",
    [
        ["--loss", "cauchy"],
        ["--policy", "nielsen"],
        ["--ftol", "1e-3"],
        ["--intrinsics", "fixed"],
        ["--constant", "focal"],
        ["--max-iterations", "6"],
    ],
)
def test_a_run_does_not_go_on_by_other_options(problems, tmp_path, more, capsys):
    output = tmp_path / "solved"
    assert run([str(problems), "--output", str(output), *ASKED]) == 0
    content = (output / COSTS).read_bytes()
    capsys.readouterr()
    assert run([str(problems), "--output", str(output), "--resume", *ASKED, *more]) == 2
    error = capsys.readouterr().err
    assert "other options, constraints or policy" in error
    assert error.count("\n") == 1
    assert (output / COSTS).read_bytes() == content


def test_a_run_does_not_go_on_by_constraints_whose_files_have_changed(problems, tmp_path, capsys):
    output = tmp_path / "solved"
    constraints = tmp_path / "constraints.yaml"
    log = tmp_path / "log.csv"
    constraints.write_text("constant_points: [3]\nposition_priors: {file: log.csv, stddev: 5}\n")
    positions = [f"{number},{number % 3},{number},0.{number}" for number in range(6)]
    log.write_text("\n".join(["image,x,y,z", *positions]) + "\n")
    asked = [
        str(problems),
        "--output",
        str(output),
        "--constraints",
        str(constraints),
        "--max-iterations",
        "0",
    ]
    assert run(asked) == 0
    assert run([*asked, "--resume", "--compilation", "auto"]) == 0
    assert "3 of 3 are there already" in capsys.readouterr().out
    for file in (log, constraints):
        content = file.read_text()
        file.write_text(content.replace("3", "4"))
        assert run([*asked, "--resume"]) == 2
        assert "other options, constraints or policy" in capsys.readouterr().err
        file.write_text(content)


def test_what_has_changed_and_what_is_lost_is_solved_anew(problems, tmp_path, capsys):
    output = tmp_path / "solved"
    assert run([str(problems), "--output", str(output), *ASKED]) == 0
    before = rows(output)
    paths = sorted(problems.iterdir())
    jaxba.write_problem(jaxba.random_scene(jaxba.scene_like("tiny"), 9), paths[0])
    (output / before[1]["problem"]).unlink()
    os.utime(paths[2])  # touched, but not changed
    capsys.readouterr()
    assert run([str(problems), "--output", str(output), "--resume", *ASKED]) == 0
    told = capsys.readouterr().out
    assert "1 of 3 are there already" in told
    assert "solved anew: 1 whose files have changed, 1 whose solutions are not there" in told
    after = {row["problem"]: row for row in rows(output)}
    assert after["scene-2.txt.gz"] == before[2]
    assert after["scene-1.txt.gz"] == before[1]
    assert after["scene-0.txt.gz"]["initial_cost"] != before[0]["initial_cost"]
    assert (output / "scene-1.txt.gz").exists()


def test_an_error_that_nobody_expects_comes_after_the_solutions_of_what_was_read(
    problems, tmp_path, monkeypatch
):
    def read(args, path):
        if path.endswith("scene-2.txt.gz"):
            raise RuntimeError("unexpected")
        return jaxba.read_problem(path)

    monkeypatch.setattr(solve, "_one_of_several", read)
    with pytest.raises(RuntimeError, match="unexpected"):
        run([str(problems), "--output", str(tmp_path / "solved"), *ASKED])
    assert [bool(row["final_cost"]) for row in rows(tmp_path / "solved")] == [True, True]


def test_a_run_goes_on_with_names_of_any_bytes_and_costs_that_an_editor_or_a_crash_has_touched(
    problems, tmp_path, capsys
):
    output = tmp_path / "solved"
    first = problems / "scene-0.txt.gz"
    odd = problems / os.fsdecode(b'a \xe9\x85\n,".txt.gz')
    first.rename(odd)
    assert run([str(problems), "--output", str(output), *ASKED]) == 0
    costs = output / COSTS
    whole = costs.read_bytes()
    costs.write_bytes(whole + b"\n\0\0\xff\n")
    capsys.readouterr()
    again = [
        str(odd),
        str(problems / "scene-1.txt.gz"),
        "--output",
        str(output),
        "--resume",
        *ASKED,
    ]
    assert run(again) == 0
    printed = capsys.readouterr()
    assert "2 of 2 are there already" in printed.out
    assert "0 problems solved, 0 failed" in printed.out
    assert costs.read_bytes().startswith(whole)


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (["--log", "log.json"], "--log"),
        (["--covariance", "c.npz"], "--covariance"),
        (["--devices", "2"], "--devices"),
        (["--resume"], "--output"),
    ],
)
def test_what_is_for_one_problem_is_refused_for_several(problems, more, said, capsys):
    assert run([*sorted(map(str, problems.iterdir())), *more]) == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1


def test_no_problem_is_written_over_and_none_is_named_twice(problems, capsys):
    paths = sorted(map(str, problems.iterdir()))
    assert run([*paths, "--output", str(problems), *ASKED]) == 2
    assert "would be replaced" in capsys.readouterr().err
    assert run([paths[0], paths[0], "--output", str(problems / "new")]) == 2
    assert "named twice" in capsys.readouterr().err
    assert run(["--resume"]) == 2
