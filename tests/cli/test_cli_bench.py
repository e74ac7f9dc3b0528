"""`jaxba-bench` in this process: result files, continuing a run, and errors."""

from __future__ import annotations

import errno
import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
import support
import yaml

import jaxba
from jaxba import write_bal
from jaxba.bench import report
from jaxba.bench import run as bench_run
from jaxba.cli.bench import run
from jaxba.damping.learned import always
from jaxba.damping.registry import SHIPPED
from jaxba.problem import geometry
from jaxba.scenes import DEFAULT_SCENES
from jaxba.structure.padding import capacity_of

KEYS = [
    *(
        "problem",
        "family",
        "cameras",
        "points",
        "observations",
        "solver",
        "backend",
        "device",
        "dtype",
        "threads",
    ),
    *(
        "repeat",
        "setup_s",
        "compile_s",
        "total_s",
        "initial_cost",
        "final_cost",
        "iterations",
        "accepted",
    ),
    *("cg_iterations", "termination", "trace", "notes"),
]
TRACE_KEYS = ["iteration", "time_s", "cost", "lambda", "accepted", "cg_iterations", "gain_ratio"]

BRIEF = ["--solvers", "classic,ceres", "--repeats", "1", "--max-iterations", "5"]


def lines(folder: Path) -> list[dict]:
    return [json.loads(line) for line in (folder / "results.jsonl").read_text().splitlines()]


def bench(folder: Path, *argv: str) -> int:
    return run([*argv, "--out", str(folder)])


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> Path:
    """A complete run with its report."""
    folder = tmp_path_factory.mktemp("bench") / "run"
    assert bench(folder, "scene:tiny", *BRIEF) == 0
    return folder


@pytest.fixture
def folder(finished, tmp_path) -> Path:
    """A copy of that run."""
    return Path(shutil.copytree(finished, tmp_path / "run"))


@pytest.fixture
def undrawn(monkeypatch):
    """Writes no report, which is tested elsewhere."""
    monkeypatch.setattr(report, "write_report", lambda *_, **__: None)


def check_one_line(status: int, error: str, message: str) -> None:
    assert status == 2
    assert error.startswith("error: ")
    assert error.count("\n") == 1
    assert message in error


# Results


def test_every_line_has_exactly_the_documented_keys_in_order(finished):
    found = lines(finished)
    assert [line["solver"] for line in found] == ["classic", "ceres"]
    for line in found:
        assert list(line) == KEYS
        assert all(list(point) == TRACE_KEYS for point in line["trace"])


def test_the_numbers_of_a_line_are_those_of_the_solve(finished):
    problem = support.tiny()
    for line in lines(finished):
        assert (line["problem"], line["family"], line["repeat"]) == ("tiny", "scene", 0)
        assert (line["cameras"], line["points"], line["observations"]) == (6, 40, 200)
        np.testing.assert_allclose(line["initial_cost"], geometry.cost(problem), rtol=1e-10)
        trace = line["trace"]
        start = {
            "iteration": 0,
            "time_s": 0.0,
            "cost": line["initial_cost"],
            "lambda": None,
            "accepted": True,
        }
        assert trace[0] == {**start, "cg_iterations": 0, "gain_ratio": None}
        assert [point["iteration"] for point in trace] == list(range(line["iterations"] + 1))
        assert line["iterations"] <= 5
        assert trace[-1]["cost"] == line["final_cost"]
        assert sum(point["accepted"] for point in trace[1:]) == line["accepted"]
        times = [point["time_s"] for point in trace]
        assert times == sorted(times)
        assert times[-1] <= line["total_s"]
        assert trace[1]["lambda"] == {"classic": 0.25, "ceres": 1e-4}[line["solver"]]
        assert min(line["setup_s"], line["compile_s"], line["total_s"]) >= 0
        assert line["threads"] >= 1


def test_a_report_is_written(finished):
    text = (finished / "report.html").read_text()
    assert text.startswith("<!DOCTYPE html>")
    assert "classic" in text
    assert (
        "<pre>jaxba-bench scene:tiny --solvers classic,ceres --repeats 1 --max-iterations 5 --out "
        f"{finished}" in text
    )


# Continuing


def test_a_second_run_with_the_same_folder_adds_nothing(folder, undrawn, capsys):
    before = (folder / "results.jsonl").read_bytes()
    assert bench(folder, "scene:tiny", *BRIEF) == 0
    assert (folder / "results.jsonl").read_bytes() == before
    assert "2 of 2 runs already in" in capsys.readouterr().out


def test_a_second_run_adds_only_what_is_new(folder, undrawn, capsys):
    before = (folder / "results.jsonl").read_bytes()
    argv = ["--solvers", "ceres,gtsam,lm+classic", "--repeats", "1", "--max-iterations", "5"]
    assert bench(folder, "scene:tiny", *argv) == 0
    after = (folder / "results.jsonl").read_bytes()
    assert after.startswith(before)
    assert [line["solver"] for line in lines(folder)] == ["classic", "ceres", "gtsam"]


def test_the_incomplete_line_of_a_killed_run_is_removed(folder, undrawn, capsys):
    path = folder / "results.jsonl"
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) - 300])
    assert bench(folder, "scene:tiny", *BRIEF) == 0
    found = lines(folder)
    assert [line["solver"] for line in found] == ["classic", "ceres"]
    assert path.read_bytes().endswith(b"}\n")


@pytest.mark.parametrize(
    "change",
    [["--max-iterations", "6"], ["--linear-solver", "implicit"]],
    ids=["max-iterations", "linear-solver"],
)
def test_other_settings_may_not_continue_in_the_folder(change, folder, undrawn, capsys):
    before = (folder / "results.jsonl").read_bytes()
    argv = BRIEF if "--linear-solver" in change else BRIEF[:-2]
    check_one_line(bench(folder, "scene:tiny", *argv, *change), capsys.readouterr().err, "another")
    assert (folder / "results.jsonl").read_bytes() == before


def test_another_problem_of_the_same_name_may_not_continue_in_the_folder(
    folder, tmp_path, undrawn, capsys
):
    path = tmp_path / "tiny.txt"
    write_bal(support.paper(0), path)
    check_one_line(bench(folder, str(path), *BRIEF), capsys.readouterr().err, "another tiny")


def changed_file(folder: Path) -> Path:
    """A file that has changed since the folder got results of it."""
    path = folder.parent / "one.txt"
    write_bal(support.tiny(), path)
    assert (
        bench(folder, str(path), "--solvers", "ceres", "--repeats", "1", "--max-iterations", "5")
        == 0
    )
    write_bal(support.tiny().replace(points=support.tiny().points + 0.01), path)
    return path


def test_another_problem_in_the_same_file_may_not_continue_in_the_folder(folder, undrawn, capsys):
    path = changed_file(folder)
    check_one_line(bench(folder, str(path), *BRIEF), capsys.readouterr().err, "another one;")


def test_a_folder_without_checksums_is_continued(folder, undrawn, capsys):
    path = changed_file(folder)
    settings = json.loads((folder / "settings.json").read_text())
    assert list(settings.pop("files")) == ["one"]
    (folder / "settings.json").write_text(json.dumps(settings))
    assert bench(folder, str(path), *BRIEF) == 0


def test_another_policy_in_the_same_file_may_not_continue_in_the_folder(folder, undrawn, capsys):
    mine = folder.parent / "mine.safetensors"
    shipped = jaxba.load_policy(SHIPPED)
    argv = ["scene:tiny", "--solvers", str(mine), "--repeats", "1", "--max-iterations", "5"]
    jaxba.save_policy(mine, shipped)
    assert bench(folder, *argv) == 0
    jaxba.save_policy(mine, always(0.0, shipped.config))
    check_one_line(bench(folder, *argv), capsys.readouterr().err, f"another {mine};")


def test_the_error_names_a_damaged_result_file_and_its_line(folder, undrawn, capsys):
    path = folder / "results.jsonl"
    path.write_bytes(b"no json\n" + path.read_bytes())
    check_one_line(
        bench(folder, "scene:tiny", *BRIEF), capsys.readouterr().err, "results.jsonl, line 1"
    )


def test_ctrl_c_keeps_the_results_and_the_next_run_does_the_rest(
    tmp_path, undrawn, capsys, monkeypatch
):
    solve_one = bench_run.run_solver
    done = []

    def interrupted(*args):
        if done:
            raise KeyboardInterrupt
        done.append(1)
        return solve_one(*args)

    folder = tmp_path / "run"
    with monkeypatch.context() as patch:
        patch.setattr(bench_run, "run_solver", interrupted)
        assert bench(folder, "scene:tiny", *BRIEF) == 130
    assert [line["solver"] for line in lines(folder)] == ["classic"]
    assert "interrupted" in capsys.readouterr().out
    assert bench(folder, "scene:tiny", *BRIEF) == 0
    assert [line["solver"] for line in lines(folder)] == ["classic", "ceres"]


def test_without_a_folder_results_are_gathered_in_one(undrawn, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    brief = ["scene:tiny", "--repeats", "1", "--max-iterations", "2", "--solvers"]
    assert run([*brief, "ceres"]) == run([*brief, "classic"]) == run([*brief, "ceres"]) == 0
    assert [line["solver"] for line in lines(tmp_path / "runs" / "bench")] == ["ceres", "classic"]
    assert run([*brief[:-2], "3", "--solvers", "ceres"]) == 2
    assert "holds a run with another max_iterations; give another --out" in capsys.readouterr().err


def test_the_default_scenes_share_programs():
    capacities = {capacity_of(jaxba.random_scene(scene, 0)) for scene in DEFAULT_SCENES.values()}
    assert len(capacities) == 1
    assert None not in capacities


def test_a_run_with_two_records_counts_once(folder, undrawn, capsys):
    path = folder / "results.jsonl"
    path.write_bytes(2 * path.read_bytes())
    assert bench(folder, "scene:tiny", *BRIEF) == 0
    assert "2 of 2 runs already in" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("module", "writer"), [(bench_run.json_lines, "append"), (report, "write_report")]
)
def test_a_full_disk_is_one_line_and_status_2(module, writer, tmp_path, capsys, monkeypatch):
    def full(*_, **__):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(module, writer, full)
    status = bench(tmp_path / "run", "scene:tiny", *BRIEF)
    check_one_line(
        status, capsys.readouterr().err, f"--out {tmp_path / 'run'}: No space left on device"
    )


def test_every_repeat_has_its_line(tmp_path, undrawn, capsys):
    argv = ["--solvers", "ceres", "--repeats", "2", "--max-iterations", "5"]
    assert bench(tmp_path / "run", "scene:tiny", *argv) == 0
    first, second = lines(tmp_path / "run")
    assert (first["repeat"], second["repeat"]) == (0, 1)
    assert [p["cost"] for p in first["trace"]] == [p["cost"] for p in second["trace"]]


# Problems and suites


def test_a_bad_file_among_good_ones_is_reported_once_and_the_others_are_done(
    tmp_path, undrawn, capsys
):
    good = tmp_path / "good.txt"
    bad = tmp_path / "bad.txt"
    write_bal(support.tiny(), good)
    bad.write_bytes(good.read_bytes()[:500])
    status = bench(tmp_path / "run", str(bad), str(good), *BRIEF)
    check_one_line(status, capsys.readouterr().err, "bad.txt")
    assert [(line["problem"], line["solver"]) for line in lines(tmp_path / "run")] == [
        ("good", "classic"),
        ("good", "ceres"),
    ]


def test_a_bad_file_that_was_repaired_is_solved_in_the_same_folder(tmp_path, undrawn, capsys):
    good = tmp_path / "good.txt"
    bad = tmp_path / "bad.txt"
    folder = tmp_path / "run"
    write_bal(support.tiny(), good)
    bad.write_bytes(good.read_bytes()[:500])
    bench(folder, str(bad), str(good), *BRIEF)
    bad.write_bytes(good.read_bytes())
    assert bench(folder, str(bad), str(good), *BRIEF) == 0
    assert sorted({line["problem"] for line in lines(folder)}) == ["bad", "good"]


def test_a_solver_that_runs_out_of_memory_is_reported_and_others_are_done(
    tmp_path, undrawn, capsys, monkeypatch
):
    def greedy(problem, source, solver, *arguments):
        if str(solver) == "classic":
            raise MemoryError
        return solve(problem, source, solver, *arguments)

    solve = bench_run.run_solver
    monkeypatch.setattr(bench_run, "run_solver", greedy)
    write_bal(support.tiny(), tmp_path / "good.txt")
    status = bench(tmp_path / "run", str(tmp_path / "good.txt"), *BRIEF)
    check_one_line(status, capsys.readouterr().err, "good, classic: not enough memory")
    assert [line["solver"] for line in lines(tmp_path / "run")] == ["ceres"]


def test_names_with_brackets_and_colons_are_printed_as_they_are(tmp_path, undrawn, capsys):
    path = tmp_path / "seq[red]:cat:.txt"
    write_bal(support.tiny(), path)
    argv = [str(path), "--solvers", "ceres", "--repeats", "1", "--max-iterations", "1"]
    assert bench(tmp_path / "run[bold]", *argv) == 0
    out = capsys.readouterr().out
    assert "\nseq[red]:cat:: 1 run in " in f"\n{out}"
    assert str(tmp_path / "run[bold]" / "report.html") in out


def test_a_file_name_that_is_not_valid_text_is_escaped(tmp_path, capsys):
    path = tmp_path / os.fsdecode(b"b\xfcro.txt")
    write_bal(support.tiny(), path)
    argv = [str(path), "--solvers", "ceres", "--repeats", "1", "--max-iterations", "1"]
    assert bench(tmp_path / "run", *argv) == 0
    assert [line["problem"] for line in lines(tmp_path / "run")] == ["b\\udcfcro"]
    assert "b\\udcfcro" in (tmp_path / "run" / "report.html").read_text()


def test_two_files_of_one_name_get_two_names(tmp_path, undrawn, capsys):
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        write_bal(support.tiny(), tmp_path / name / "tiny.txt")
    argv = ["--solvers", "ceres", "--repeats", "1", "--max-iterations", "1"]
    assert bench(tmp_path / "run", *(str(tmp_path / n / "tiny.txt") for n in "ab"), *argv) == 0
    found = [(line["problem"], line["family"]) for line in lines(tmp_path / "run")]
    assert found == [("tiny", "a"), ("b-tiny", "b")]


def test_a_problem_that_is_named_twice_is_one(tmp_path, undrawn, capsys):
    path = tmp_path / "tiny.txt"
    write_bal(support.tiny(), path)
    argv = ["--solvers", "ceres", "--repeats", "1", "--max-iterations", "1"]
    assert (
        bench(
            tmp_path / "run",
            str(path),
            str(tmp_path / "." / "tiny.txt"),
            "scene:tiny",
            "scene:tiny",
            *argv,
        )
        == 0
    )
    assert [line["family"] for line in lines(tmp_path / "run")] == [tmp_path.name, "scene"]


def test_the_final_costs_of_float32_are_computed_in_float64(tmp_path, undrawn, capsys):
    write_bal(support.tiny(), tmp_path / "tiny.txt")
    argv = ["--solvers", "ceres@float32,ceres", "--repeats", "1", "--max-iterations", "3"]
    assert bench(tmp_path / "run", str(tmp_path / "tiny.txt"), *argv) == 0
    rough, exact = lines(tmp_path / "run")
    assert rough["initial_cost"] == pytest.approx(exact["initial_cost"], rel=1e-12)
    # the steps differ by rounding only, and by less than the error of a sum in float32
    assert rough["final_cost"] != rough["trace"][-1]["cost"]
    assert rough["final_cost"] == pytest.approx(rough["trace"][-1]["cost"], rel=1e-4)


RULES = """
import dataclasses
import jax.numpy as jnp
import jaxba

@jaxba.register_pytree
@dataclasses.dataclass(frozen=True)
class Same:
    min_gain: float = 0.0

    def init(self, info):
        return (), jnp.asarray(1e-4, info.cost.dtype)

    def propose(self, state, step):
        return state, step.damping

@jaxba.register_pytree
@dataclasses.dataclass(frozen=True)
class Branching(Same):
    def propose(self, state, step):
        return state, step.damping if step.accepted else 2 * step.damping

@dataclasses.dataclass(frozen=True)
class Unregistered(Same):
    pass

class Needy(Same):
    def __init__(self, wish):
        pass
"""


def test_a_rule_in_a_file_is_run_like_others_and_its_fault_is_one_line(tmp_path, undrawn, capsys):
    path = tmp_path / "my+rules@1.py"
    path.write_text(RULES)
    names = [f"{path}:Same", f"{path}:Same+refine1", "constant:1e-4"]
    arguments = ["scene:tiny", *BRIEF[2:], "--solvers"]
    status = bench(tmp_path / "refused", *arguments, f"{path}:Branching")
    message = f"{path}, line 21: ValueError: policy Branching: propose cannot be compiled: "
    check_one_line(status, capsys.readouterr().err, message)
    assert bench(tmp_path / "run", *arguments, ",".join(names)) == 0
    capsys.readouterr()
    own, refined, constant = lines(tmp_path / "run")
    assert [own["solver"], refined["solver"]] == names[:2]
    assert own["final_cost"] == pytest.approx(constant["final_cost"], rel=1e-9)
    assert refined["trace"][1]["cost"] < own["trace"][1]["cost"]
    path.write_text(RULES + "# changed\n")
    check_one_line(
        bench(tmp_path / "run", "scene:tiny", "--solvers", names[0], *BRIEF[2:]),
        capsys.readouterr().err,
        "another",
    )


BAD_RULES = {
    "None": "rules.py has no class None",
    "Unregistered": "rules.py: ValueError: policy Unregistered is no pytree: decorate",
    "Needy": "missing 1 required positional argument: 'wish'",
    "jnp": "rules.py: TypeError: 'module' object is not callable",
}


@pytest.mark.parametrize("name", BAD_RULES)
def test_a_class_that_is_no_rule_is_one_line_and_status_2(name, tmp_path, capsys):
    path = tmp_path / "rules.py"
    path.write_text(RULES)
    check_one_line(
        bench(tmp_path / "run", "--solvers", f"{path}:{name}"),
        capsys.readouterr().err,
        BAD_RULES[name],
    )
    path.write_text("1 +")
    check_one_line(
        bench(tmp_path / "run", "--solvers", f"{path}:{name}"),
        capsys.readouterr().err,
        "rules.py: SyntaxError",
    )


def suite(tmp_path: Path, **entries) -> str:
    path = tmp_path / "suite.yaml"
    path.write_text(yaml.safe_dump(entries))
    return str(path)


def test_wildcards_and_variables_in_a_suite_are_expanded(tmp_path, undrawn, capsys, monkeypatch):
    (tmp_path / "data").mkdir()
    write_bal(support.tiny(), tmp_path / "data" / "one.txt")
    write_bal(support.tiny(), tmp_path / "data" / "two.txt.gz")
    monkeypatch.setenv("JAXBA_TEST_FOLDER", str(tmp_path / "data"))
    entries = {"problems": ["$JAXBA_TEST_FOLDER/*.txt*", "scene:tiny"], "solvers": ["ceres"]}
    path = suite(tmp_path, **entries, tolerance=0.01, repeats=1, max_iterations=1)
    assert bench(tmp_path / "run", "--suite", path) == 0
    assert [line["problem"] for line in lines(tmp_path / "run")] == ["one", "two", "tiny"]
    (tmp_path / "suite.yaml").write_text(
        yaml.safe_dump(entries) + "tolerance: 1e-2\nrepeats: 1\nmax_iterations: 1\n"
    )
    assert bench(tmp_path / "run", "--suite", path) == 0
    assert bench(tmp_path / "other", "scene:tiny", "--suite", path, "--solvers", "classic") == 0
    assert [(line["problem"], line["solver"]) for line in lines(tmp_path / "other")] == [
        ("tiny", "classic")
    ]


BAD = {
    "unknown solver": (
        ["scene:tiny", "--solvers", "ceres,cerse"],
        "unknown damping policy 'cerse'",
    ),
    "unknown method": (["scene:tiny", "--solvers", "sgd+ceres"], "unknown method 'sgd'"),
    "mixed types of a method": (
        ["scene:tiny", "--solvers", "ceres,stba+ceres@mixed"],
        "mixed types are for plain LM",
    ),
    "missing rule": (["scene:tiny", "--solvers", "no.py:Rule"], "no.py: No such file"),
    "missing policy": (
        ["scene:tiny", "--solvers", "no.safetensors"],
        "no.safetensors: No such file",
    ),
    "no solver": (["scene:tiny", "--solvers", ","], "--solvers names no solver"),
    "missing file": (["no-such-file.txt"], "no-such-file.txt: no such file"),
    "directory": (["."], "a directory without a COLMAP model"),
    "unknown scene": (["scene:none"], "no scene is called 'none'"),
    "bad seed": (["scene:tiny:x"], "the seed must be a whole number"),
    "no repeats": (["scene:tiny", "--repeats", "0"], "--repeats must be positive"),
    "no iterations": (
        ["scene:tiny", "--max-iterations", "-1"],
        "--max-iterations must be positive",
    ),
    "too many iterations": (
        ["scene:tiny", "--max-iterations", "10000000000"],
        "at most 2147483647",
    ),
    "tolerance 0": (["scene:tiny", "--tolerance", "0"], "--tolerance must lie between 0 and 1"),
    "tolerance 1": (["scene:tiny", "--tolerance", "1"], "--tolerance must lie between 0 and 1"),
    "missing suite": (["--suite", "no-such-suite.yaml"], "No such file"),
    "unknown suite": (
        ["--suite", "rule"],
        "no configuration 'rule'; known: methods, real, rules, synthetic, or the path",
    ),
}


@pytest.mark.parametrize("kind", list(BAD))
def test_bad_input_is_one_line_and_status_2_and_nothing_is_written(kind, tmp_path, capsys):
    argv, message = BAD[kind]
    check_one_line(bench(tmp_path / "run", *argv), capsys.readouterr().err, message)
    assert not (tmp_path / "run").exists()


def test_a_suite_is_found_by_its_name(tmp_path, undrawn, capsys):
    status = bench(
        tmp_path / "run",
        "scene:tiny",
        "--suite",
        "synthetic",
        "--repeats",
        "1",
        "--max-iterations",
        "1",
    )
    assert status == 0
    assert [line["solver"] for line in lines(tmp_path / "run")] == [
        "classic",
        "ceres",
        "nielsen",
        "gtsam",
        "ceres+refine3",
    ]


def test_the_error_names_the_variable_of_the_folder_of_real_problems(tmp_path, monkeypatch, capsys):
    wanted = (
        "--suite rules: $JAXBA_DATA/bal/problem-*.bz2: the environment variable JAXBA_DATA, "
        "a "
        "folder of problems, is"
    )
    for value in (None, ""):
        monkeypatch.delenv("JAXBA_DATA", raising=False)
        if value is not None:
            monkeypatch.setenv("JAXBA_DATA", value)
        check_one_line(bench(tmp_path / "run", "--suite", "rules"), capsys.readouterr().err, wanted)
    monkeypatch.setenv("JAXBA_DATA", str(tmp_path))
    wanted = f"--suite rules: {tmp_path}/bal/problem-*.bz2: no such file"
    check_one_line(bench(tmp_path / "run", "--suite", "rules"), capsys.readouterr().err, wanted)


BAD_SUITES = {
    "unknown key": ({"problem": ["scene:tiny"]}, "unknown key problem; did you mean problems?"),
    "wrong type": ({"problems": "scene:tiny"}, "problems must be a list, is 'scene:tiny'"),
    "wrong number": (
        {"problems": ["scene:tiny"], "repeats": 1.5},
        "repeats must be a whole number, is 1.5",
    ),
    "truth as number": (
        {"problems": ["scene:tiny"], "repeats": True},
        "repeats must be a whole number, is True",
    ),
    "unset variable": (
        {"problems": ["$JAXBA_NO_SUCH_VARIABLE/x.txt"]},
        "/x.txt: the environment variable JAXBA_NO_SUCH_VARIABLE, a folder of problems, is not set",
    ),
    "glob without match": ({"problems": ["no-such-folder/*.txt"]}, "no such file"),
    "unknown solver": (
        {"problems": ["scene:tiny"], "solvers": ["cerse"]},
        "unknown damping policy",
    ),
    "bad tolerance": (
        {"problems": ["scene:tiny"], "tolerance": 2.0},
        "--tolerance must lie between 0 and 1",
    ),
}


@pytest.mark.parametrize("kind", list(BAD_SUITES))
def test_a_bad_suite_is_one_line_and_status_2(kind, tmp_path, capsys):
    entries, message = BAD_SUITES[kind]
    status = bench(tmp_path / "run", "--suite", suite(tmp_path, **entries))
    check_one_line(status, capsys.readouterr().err, message)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("text", ["problems: [", "- a\n- b\n", "just words", "\x00", ""])
def test_a_suite_that_is_no_mapping_is_one_line_and_status_2(text, tmp_path, capsys):
    path = tmp_path / "suite.yaml"
    path.write_text(text)
    status = bench(tmp_path / "run", "--suite", str(path))
    check_one_line(status, capsys.readouterr().err, "--suite")


def test_an_output_folder_that_is_a_file_is_one_line_and_status_2(tmp_path, capsys):
    path = tmp_path / "run"
    path.write_text("mine")
    check_one_line(bench(path, "scene:tiny", *BRIEF), capsys.readouterr().err, "--out")
    assert path.read_text() == "mine"
