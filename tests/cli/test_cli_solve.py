"""`jaxba-solve` in this process: what it prints, writes and returns."""

from __future__ import annotations

import io
import json
import os
import re
import signal
import stat
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import support
from support import solve

from jaxba import (
    Refinement,
    SceneConfig,
    SolveOptions,
    random_scene,
    read_bal,
    read_problem,
    write_bal,
    write_bundler,
    write_problem,
)
from jaxba.cli import table
from jaxba.cli.solve import Arguments, run, solve_options
from jaxba.io import json_lines
from jaxba.problem import geometry
from jaxba.solver import progress
from jaxba.solver.record import Record

RECORD_KEYS = [
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


@pytest.fixture
def tiny(tmp_path) -> Path:
    path = tmp_path / "in" / "tiny.txt"
    path.parent.mkdir()
    write_bal(support.tiny(), path)
    return path


def rows(text: str) -> list[list[str]]:
    """Lines of the iteration table."""
    return [line.split() for line in text.splitlines() if line[:4].strip().isdigit()]


# Options


def test_repairs_and_the_smallest_gain_may_be_others_than_those_of_the_policy():
    args = Arguments(policy="guarded:1e-5", refine_points=3, repairs="trials", min_gain=1e-2)
    policy, options = solve_options(args)
    assert (policy.initial, policy.min_gain) == (1e-5, 1e-2)
    rays = Refinement(points=3, starts="rays", trials=4)
    assert options.refinement == rays
    assert solve_options(replace(args, repairs="none"))[1].refinement == Refinement(points=3)
    assert solve_options(Arguments(repairs="all"))[1] == solve_options(Arguments())[1]
    assert solve_options(Arguments(policy="learned", min_gain=0.5))[0].min_gain == 0.5


# Solves


def test_a_file_is_solved_and_the_solution_written(tiny, tmp_path, capsys):
    output = tmp_path / "out.txt.bz2"
    log = tmp_path / "log.json"
    assert run([str(tiny), "--output", str(output), "--log", str(log)]) == 0
    printed = capsys.readouterr()
    assert printed.err == ""
    solved = read_bal(output)
    record = json.loads(log.read_text())
    assert list(record) == RECORD_KEYS
    np.testing.assert_allclose(record["initial_cost"], geometry.cost(support.tiny()), rtol=1e-10)
    np.testing.assert_allclose(record["final_cost"], geometry.cost(solved), rtol=1e-10)
    for name in ("observations", "camera_index", "point_index"):
        assert np.array_equal(getattr(solved, name), getattr(support.tiny(), name))
    assert (record["solver"], record["dtype"], record["termination"]) == (
        "guarded",
        "float64",
        "cost",
    )
    assert (record["cameras"], record["points"], record["observations"]) == (6, 40, 200)
    costs = [point["cost"] for point in record["trace"]]
    assert costs[0] == record["initial_cost"]
    assert costs[-1] == record["final_cost"]
    assert [point["iteration"] for point in record["trace"]] == list(
        range(record["iterations"] + 1)
    )
    assert json_lines.from_plain(Record, record).accepted == record["iterations"]
    assert "6 cameras, 40 points, 200 observations" in printed.out
    assert "converged: relative decrease" in printed.out
    assert f"wrote {output}" in printed.out
    assert f"wrote {log}" in printed.out
    lines = rows(printed.out)
    assert [int(line[0]) for line in lines] == list(range(record["iterations"] + 1))
    np.testing.assert_allclose([float(line[1]) for line in lines], costs, rtol=1e-6)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["in", "log.json", "out.txt.bz2"]


def test_without_a_problem_a_built_in_scene_is_solved(capsys):
    assert run([]) == 0
    printed = capsys.readouterr()
    assert "random scene street: 20 cameras, 1500 points, " in printed.out
    assert "\nconverged: " in printed.out
    assert printed.err == ""


@pytest.mark.slow
def test_a_search_for_points_is_reported_and_rows_are_numbered_consecutively(tmp_path, capsys):
    """One point behind its cameras, with which the solve alone converges far above the minimum."""
    problem = solve(support.tiny()).problem
    log = tmp_path / "log.json"
    points = np.array(problem.points)
    center = geometry.camera_centers(problem.cameras)[problem.camera_index[0]]
    points[0] = center - 3 * (points[0] - center)
    write_bal(problem.replace(points=points), tmp_path / "strayed.txt")
    stranding = ["--policy", "ceres", "--refine-points", "3"]
    assert (
        run([str(tmp_path / "strayed.txt"), *stranding, "--retriangulate", "--log", str(log)]) == 0
    )
    printed = capsys.readouterr().out
    record = json.loads(log.read_text())
    searches = re.findall(
        r"^   search for points at other depths: (\d+) of 40 points moved, cost (.*) -> (.*)$",
        printed,
        re.M,
    )
    assert len(searches) >= 1
    assert int(searches[0][0]) > 0
    assert float(searches[0][2]) < float(searches[0][1])
    assert "   search for points at other depths: none found\nconverged" in printed
    assert [int(line[0]) for line in rows(printed)] == list(range(record["iterations"] + 1))
    assert [point["iteration"] for point in record["trace"]] == list(
        range(record["iterations"] + 1)
    )
    np.testing.assert_allclose(record["final_cost"], geometry.cost(problem), rtol=1e-5)


@pytest.mark.parametrize("loss", ["squared", "cauchy"])
def test_the_rms_is_that_of_the_residuals_whatever_the_loss(loss, tiny, tmp_path, capsys):
    output = tmp_path / "out.txt"
    assert run([str(tiny), "--loss", loss, "--max-iterations", "3", "--output", str(output)]) == 0
    found = re.search(r"\(rms (.*) -> (.*) px\)", capsys.readouterr().out)
    assert found
    rms = [
        np.sqrt(np.mean(np.sum(geometry.residuals(read_bal(path)) ** 2, axis=1)))
        for path in (tiny, output)
    ]
    np.testing.assert_allclose([float(number) for number in found.groups()], rms, rtol=1e-3)


def test_padded_sizes_are_reported(tiny, capsys):
    fast = [str(tiny), "--max-iterations", "1", "--policy", "ceres", "--pad", "yes"]
    assert run(fast) == 0
    assert (
        "padded to 8 cameras, 256 points, 1024 observations, 6144 pairs\n"
        in capsys.readouterr().out
    )
    assert run([*fast, "--linear-solver", "implicit"]) == 0
    assert "padded to" not in capsys.readouterr().out


def test_the_iteration_limit_is_reported_and_not_an_error(tiny, tmp_path, capsys):
    output = tmp_path / "out.txt"
    assert run([str(tiny), "--max-iterations", "2", "--ftol", "0", "--output", str(output)]) == 0
    printed = capsys.readouterr().out
    assert "not converged: iteration limit" in printed
    assert "2 iterations" in printed
    assert geometry.cost(read_bal(output)) < geometry.cost(support.tiny())


def test_without_iterations_the_cost_is_printed_and_the_problem_converted(tiny, tmp_path, capsys):
    output = tmp_path / "same.txt"
    model = tmp_path / "model"
    assert (
        run(
            [
                str(tiny),
                "--max-iterations",
                "0",
                "--output",
                str(output),
                "--record",
                f"{tmp_path}/r.npz",
            ]
        )
        == 0
    )
    printed = capsys.readouterr().out
    cost = f"{geometry.cost(support.tiny()):.6e}"
    assert f"not converged: iteration limit\ncost {cost} -> {cost} " in printed
    assert output.read_bytes() == tiny.read_bytes()
    assert run([str(tiny), "--max-iterations", "0", "--output", f"{model}/"]) == 0
    np.testing.assert_allclose(read_problem(model).points, support.tiny().points, rtol=1e-12)


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no /dev/stdin")
def test_a_problem_comes_in_and_goes_out_by_the_standard_streams(tmp_path):
    write_bundler(support.tiny(), tmp_path / "given")
    with open(tmp_path / "given", "rb") as file:
        given = file.read()
    code = "from jaxba.cli.solve import main; main()"
    words = ["-", "--max-iterations", "0", "--output", "-"]
    ran = subprocess.run(
        [sys.executable, "-c", code, *words], input=given, capture_output=True, check=True
    )
    (tmp_path / "solved.txt").write_bytes(ran.stdout)
    np.testing.assert_allclose(
        read_bal(tmp_path / "solved.txt").cameras, support.tiny().cameras, rtol=1e-12
    )
    assert b"/dev/stdin: 6 cameras, 40 points" in ran.stderr


def test_a_rejected_step_is_marked(tiny, capsys):
    assert run([str(tiny), "--policy", "constant:1e30", "--compilation", "full"]) == 0
    printed = capsys.readouterr().out
    assert rows(printed)[1][-1] == "rejected"
    assert "not converged: " in printed
    assert "1 iteration, 0 accepted" in printed


def test_the_point_cloud_has_every_point_and_camera(tiny, tmp_path, capsys):
    output = tmp_path / "out.ply"
    assert run([str(tiny), "--max-iterations", "1", "--output", str(output)]) == 0
    data = output.read_bytes()
    assert data.startswith(b"ply\n")
    assert b"element vertex 46\n" in data
    body = data.split(b"end_header\n", 1)[1]
    assert len(body) == 46 * (3 * 8 + 3)


@pytest.mark.slow
def test_options_reach_the_solver(tiny, tmp_path, capsys):
    log = tmp_path / "log.json"
    options = [
        "--policy",
        "classic:0.03",
        "--refine-points",
        "3",
        "--max-iterations",
        "3",
        "--log",
        str(log),
    ]
    assert run([str(tiny), *options]) == 0
    record = json.loads(log.read_text())
    assert record["solver"] == "classic:0.03+refine3"
    assert [point["lambda"] for point in record["trace"]][:2] == [None, 0.03]
    assert "policy classic:0.03 + 3 point iterations, float64" in capsys.readouterr().out
    assert run([str(tiny), "--dtype", "float32", "--max-iterations", "2", "--log", str(log)]) == 0
    record = json.loads(log.read_text())
    assert (record["solver"], record["dtype"]) == ("guarded@float32", "float32")
    assert (
        run([str(tiny), "--linear-solver", "implicit", "--max-iterations", "2", "--log", str(log)])
        == 0
    )
    record = json.loads(log.read_text())
    assert record["cg_iterations"] > 0
    assert record["backend"].endswith("(implicit)")
    assert (
        run(
            [
                str(tiny),
                "--method",
                "stba:3",
                "--policy",
                "stba",
                "--max-iterations",
                "2",
                "--log",
                str(log),
            ]
        )
        == 0
    )
    assert json.loads(log.read_text())["solver"] == "stba:3+stba"
    assert "method stba:3" in capsys.readouterr().out


@pytest.mark.parametrize("name", ["learned", "ceres"])
def test_left_out_options_are_those_of_a_solve_in_python(name):
    policy, options = solve_options(Arguments(policy=name))
    assert replace(options, refinement=None, coordinates=None) == SolveOptions()
    assert options.step_options(policy) == SolveOptions().step_options(policy)


def test_an_option_of_the_step_leaves_the_others_as_the_policy_was_trained():
    _, trained = solve_options(Arguments())
    _, turned = solve_options(Arguments(rotation="manifold", refine_points=2))
    assert turned.coordinates == replace(trained.coordinates, rotation="manifold")
    assert turned.refinement == Refinement(points=2)
    assert (
        replace(turned, coordinates=trained.coordinates, refinement=trained.refinement) == trained
    )


def test_fixed_intrinsics_are_bitwise_unchanged_and_the_rest_is_optimised(tiny, tmp_path):
    out = tmp_path / "out.txt"
    assert run([str(tiny), "--intrinsics", "fixed", "--output", str(out)]) == 0
    before = read_bal(tiny)
    after = read_bal(out)
    np.testing.assert_array_equal(after.cameras[:, 6:], before.cameras[:, 6:])
    assert (after.cameras[:, :6] != before.cameras[:, :6]).any(axis=1).all()
    assert geometry.cost(after) < 0.5 * geometry.cost(before)


def test_notes_on_the_data_have_the_right_counts(tmp_path, capsys):
    problem = support.odd()
    path = tmp_path / "odd.txt"
    output = tmp_path / "out.txt"
    write_bal(problem, path)
    assert run([str(path), "--output", str(output)]) == 0
    notes = [line for line in capsys.readouterr().out.splitlines() if line.startswith("note: ")]
    once = int(np.sum(np.bincount(problem.point_index) == 1))
    assert once >= 2
    behind = problem.camera_index[geometry.depths(problem) <= 0]
    after = int(np.sum(geometry.depths(read_bal(output)) <= 0))
    assert len(behind) == 1
    assert after == 0
    assert notes == [
        "note: 1 camera without observations; poses stay as they are",
        "note: 2 points without observations; positions stay as they are",
        f"note: {once} points seen once; damping alone fixes the depth",
        "note: observations behind their camera: 1 at the start, 0 at the end (most of camera "
        f"{behind[0]})",
    ]


def test_clean_data_needs_no_notes(tiny, capsys):
    assert run([str(tiny), "--max-iterations", "1"]) == 0
    assert "note:" not in capsys.readouterr().out


def test_an_existing_output_is_replaced(tiny, tmp_path, capsys):
    output = tmp_path / "out.txt"
    output.write_text("old")
    assert run([str(tiny), "--max-iterations", "1", "--output", str(output)]) == 0
    assert read_bal(output).num_cameras == 6


def test_a_file_that_is_replaced_keeps_its_permissions_and_a_read_only_one_is_refused(
    tiny, tmp_path, capsys
):
    output = tmp_path / "out.txt"
    output.write_text("old")
    output.chmod(0o600)
    assert run([str(tiny), "--max-iterations", "1", "--output", str(output)]) == 0
    assert stat.S_IMODE(output.stat().st_mode) == 0o600
    output.write_text("old")
    output.chmod(0o444)
    capsys.readouterr()
    status = run([str(tiny), "--max-iterations", "1", "--output", str(output)])
    check_one_line(status, capsys.readouterr().err)
    assert output.read_text() == "old"


def test_the_input_may_be_the_output(tiny, capsys):
    assert run([str(tiny), "--max-iterations", "1", "--output", str(tiny)]) == 0
    assert geometry.cost(read_bal(tiny)) < geometry.cost(support.tiny())


def test_a_start_without_a_finite_cost_is_reported(tmp_path, capsys):
    """A point on its camera's plane: there is nothing to descend from."""
    problem = support.single().replace(
        cameras=np.array([[0, 0, 0, 0, 0, 0, 500.0, 0, 0]]), points=np.array([[1.0, 2.0, 0.0]])
    )
    path = tmp_path / "plane.txt"
    log = tmp_path / "log.json"
    write_bal(problem, path)
    status = run([str(path), "--log", str(log)])
    printed = capsys.readouterr()
    if status == 0:
        assert "\nnot converged: " in printed.out
        assert json.loads(log.read_text())["final_cost"] is None
    else:
        check_one_line(status, printed.err)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_stops_after_the_iteration_and_writes_the_solution(
    number, tiny, tmp_path, capsys, monkeypatch
):
    output = tmp_path / "out.txt"
    row = progress.row

    def interrupted(record, before):
        if record.iteration == 2:
            signal.raise_signal(number)
        return row(record, before)

    monkeypatch.setattr(progress, "row", interrupted)
    before = signal.getsignal(number)
    assert run([str(tiny), "--ftol", "0", "--output", str(output)]) == 0
    printed = capsys.readouterr()
    assert "not converged: stopped by the caller" in printed.out
    assert "2 iterations" in printed.out
    assert "stopping after this iteration" in printed.err
    assert geometry.cost(read_bal(output)) < geometry.cost(support.tiny())
    assert signal.getsignal(number) is before


def test_a_second_ctrl_c_ends_at_once_with_one_line(tiny, tmp_path, capsys, monkeypatch):
    def interrupted(*_):
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(progress, "row", interrupted)
    before = signal.getsignal(signal.SIGINT)
    assert run([str(tiny), "--output", str(tmp_path / "out.txt")]) == 130
    assert capsys.readouterr().err.splitlines()[1:] == ["interrupted"]
    assert not (tmp_path / "out.txt").exists()
    assert signal.getsignal(signal.SIGINT) is before


def test_the_solution_is_written_if_the_reader_of_stdout_closes_it(tiny, tmp_path, monkeypatch):
    output = tmp_path / "out.txt"
    (reader, writer) = os.pipe()
    os.close(reader)
    with open(writer, "w") as closed:
        monkeypatch.setattr(sys, "stdout", closed)
        assert run([str(tiny), "--max-iterations", "2", "--output", str(output)]) == 0
    assert geometry.cost(read_bal(output)) < geometry.cost(support.tiny())


def test_a_name_that_stdout_cannot_encode_is_printed_escaped(tmp_path, monkeypatch):
    path = tmp_path / "büro.txt"
    write_bal(support.tiny(), path)
    stdout = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    monkeypatch.setattr(sys, "stdout", stdout)
    assert run([str(path), "--max-iterations", "1"]) == 0
    stdout.seek(0)
    assert "b\\xfcro.txt: 6 cameras" in stdout.read()


def test_outputs_may_be_devices_and_streams(tiny, capfd):
    assert (
        run([str(tiny), "--max-iterations", "1", "--output", "/dev/null", "--log", "/dev/stdout"])
        == 0
    )
    assert '"problem"' in capfd.readouterr().out


def test_a_solution_on_standard_output_has_no_other_output_beside_it(tiny, tmp_path, capfd):
    assert run([str(tiny), "--max-iterations", "1", "--output", "/dev/stdout"]) == 0
    captured = capfd.readouterr()
    (tmp_path / "out.txt").write_text(captured.out)
    assert geometry.cost(read_bal(tmp_path / "out.txt")) < geometry.cost(support.tiny())
    assert "wrote /dev/stdout" in captured.err


def test_a_link_into_a_missing_folder_is_refused_before_the_solve(tiny, tmp_path, capsys):
    link = tmp_path / "link.txt"
    link.symlink_to(tmp_path / "missing" / "out.txt")
    assert run([str(tiny), "--output", str(link)]) == 2
    captured = capsys.readouterr()
    assert "missing does not exist" in captured.err
    assert captured.err.count("\n") == 1
    assert not captured.out


def test_not_enough_memory_is_one_line(tiny, capsys, monkeypatch):
    def solve(*_, **__):
        raise MemoryError

    monkeypatch.setattr("jaxba.cli.solve.solve", solve)
    assert run([str(tiny)]) == 2
    assert capsys.readouterr().err == "error: not enough memory\n"


def test_a_log_is_written_to_the_target_of_a_link_and_to_a_pipe(tiny, tmp_path):
    target = tmp_path / "log.json"
    link = tmp_path / "link.json"
    pipe = tmp_path / "pipe"
    link.symlink_to(target)
    os.mkfifo(pipe)
    fast = [str(tiny), "--max-iterations", "1"]
    assert run([*fast, "--log", str(link)]) == 0
    assert link.is_symlink()
    assert list(json.loads(target.read_text())) == RECORD_KEYS
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    try:
        assert run([*fast, "--log", str(pipe)]) == 0
        assert list(json.loads(os.read(reader, 1 << 16))) == RECORD_KEYS
    finally:
        os.close(reader)
    assert pipe.is_fifo()


@pytest.mark.parametrize("moment", ["heading", "summary"])
def test_ctrl_c_before_or_after_the_iterations_is_one_line(moment, tiny, capsys, monkeypatch):
    monkeypatch.setattr(table, moment, lambda *_: signal.raise_signal(signal.SIGINT))
    assert run([str(tiny), "--max-iterations", "1"]) == 130
    assert capsys.readouterr().err == "interrupted\n"


# Errors


def check_one_line(status: int, error: str) -> None:
    assert status == 2
    assert error.startswith("error: ")
    assert error.endswith("\n")
    assert error.count("\n") == 1


def cut_short(path: Path, share: float) -> Path:
    path.write_bytes(path.read_bytes()[: int(path.stat().st_size * share)])
    return path


def garbage(tiny: Path) -> Path:
    path = tiny.parent / "garbage.safetensors"
    path.write_bytes(b"no policy")
    return path


def empty(tiny: Path) -> Path:
    path = tiny.parent / "empty"
    path.mkdir()
    return path


BAD = {
    "missing file": (lambda tiny: [str(tiny) + ".none"], "No such file"),
    "empty name": (lambda tiny: [""], "the name of the problem is empty"),
    "empty directory": (lambda tiny: [str(empty(tiny))], "directory"),
    "truncated file": (lambda tiny: [str(cut_short(tiny, 0.5))], "tiny.txt"),
    "empty file": (lambda tiny: [str(cut_short(tiny, 0))], "tiny.txt"),
    "unknown policy": (
        lambda tiny: [str(tiny), "--policy", "cerse"],
        "unknown damping policy 'cerse'",
    ),
    "lambda that is no number": (
        lambda tiny: [str(tiny), "--policy", "constant:x"],
        "positive number",
    ),
    "missing policy": (
        lambda tiny: [str(tiny), "--policy", "no.safetensors"],
        "no.safetensors: No such file",
    ),
    "policy that is none": (
        lambda tiny: [str(tiny), "--policy", str(garbage(tiny))],
        "not a safetensors file",
    ),
    "unknown method": (lambda tiny: [str(tiny), "--method", "magic"], "known: lm, stba, deeplm"),
    "size of no clusters": (lambda tiny: [str(tiny), "--method", "deeplm:3"], "no clusters"),
    "solver of a method": (
        lambda tiny: [str(tiny), "--method", "deeplm", "--linear-solver", "sparse"],
        "has its own",
    ),
    "negative refinement": (
        lambda tiny: [str(tiny), "--refine-points", "-1"],
        "--refine-points must be at least 0",
    ),
    "learned in another unit": (
        lambda tiny: [str(tiny), "--scaling", "identity"],
        "not with scaling 'identity'",
    ),
    "mixed types of a method": (
        lambda tiny: [str(tiny), "--method", "stba", "--dtype", "mixed"],
        "mixed types are for plain LM",
    ),
    "negative iterations": (
        lambda tiny: [str(tiny), "--max-iterations", "-3"],
        "--max-iterations must be at least 0",
    ),
    "too many iterations": (
        lambda tiny: [str(tiny), "--max-iterations", "10000000000"],
        "at most 2147483647",
    ),
    "negative ftol": (lambda tiny: [str(tiny), "--ftol", "-1e-6"], "--ftol must not be negative"),
    "ftol that is no number": (
        lambda tiny: [str(tiny), "--ftol", "nan"],
        "--ftol must not be negative",
    ),
    "negative xtol": (
        lambda tiny: [str(tiny), "--xtol", "-1"],
        "--xtol must not be negative, is -1",
    ),
    "loss without scale": (
        lambda tiny: [str(tiny), "--loss", "huber", "--loss-scale", "0"],
        "--loss-scale must be positive",
    ),
    "output in a missing folder": (
        lambda tiny: [str(tiny), "--output", str(tiny.parent / "no" / "o.txt")],
        "--output",
    ),
    "output is a directory": (
        lambda tiny: [str(tiny), "--output", str(tiny.parent)],
        "holds other files",
    ),
    "output in a missing directory": (
        lambda tiny: [str(tiny), "--output", f"{tiny.parent}/no/new/"],
        "no does not exist",
    ),
    "gain ratio that no step exceeds": (
        lambda tiny: [str(tiny), "--min-gain", "1"],
        "--min-gain must be at least 0",
    ),
    "compressed output of another format": (
        lambda tiny: [str(tiny), "--output", "o.zip.gz"],
        "cannot write o.zip.gz: files with .zip",
    ),
    "log is the problem": (
        lambda tiny: [str(tiny), "--log", f"{tiny.parent}/../in/tiny.txt"],
        "is a file of the problem",
    ),
    "log in a missing folder": (
        lambda tiny: [str(tiny), "--log", str(tiny.parent / "no" / "log.json")],
        "--log",
    ),
    "log is a directory": (lambda tiny: [str(tiny), "--log", str(tiny.parent)], "--log"),
}


@pytest.mark.parametrize("kind", list(BAD))
def test_bad_input_is_one_line_and_status_2_and_nothing_is_written(kind, tiny, tmp_path, capsys):
    arguments, message = BAD[kind]
    argv = arguments(tiny)
    if "--output" not in argv:
        argv += ["--output", str(tmp_path / "out.txt")]
    before = sorted(tmp_path.rglob("*"))
    status = run(argv)
    printed = capsys.readouterr()
    check_one_line(status, printed.err)
    assert message in printed.err
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize(
    "argv", [["--dtype", "float16"], ["--max-iterations", "many"], ["--no-such-option", "1"]]
)
def test_errors_of_the_parser_are_one_line_with_status_2_and_print_nothing_on_stdout(argv, capsys):
    status = run(argv)
    printed = capsys.readouterr()
    check_one_line(status, printed.err)
    assert printed.out == ""
    assert argv[0] in printed.err


def test_the_parser_proposes_the_nearest_option(capsys):
    assert run(["--polcy", "ceres"]) == 2
    assert capsys.readouterr().err.endswith("perhaps you meant --policy\n")


def test_reject_is_for_all_observations(tmp_path, capsys):
    write_problem(support.tiny(), f"{tmp_path}/model/")
    (tmp_path / "c.yaml").write_text("part: {images: [1, 2, 3]}\n")
    assert (
        run([str(tmp_path / "model"), "--constraints", str(tmp_path / "c.yaml"), "--reject"]) == 2
    )
    assert capsys.readouterr().err == "error: --reject is for all observations, not for a part\n"


@pytest.mark.slow
def test_reject_notes_wrong_matches_by_image_and_leaves_them_out_of_the_model(tmp_path, capsys):
    scene = random_scene(SceneConfig(cameras=12, points=400, mean_track=6.0, trajectory="orbit"), 1)
    wrong = np.random.default_rng(0).random(scene.num_observations) < 0.2
    pixels = np.where(
        wrong[:, None],
        np.random.default_rng(1).uniform(-300, 300, (len(wrong), 2)),
        scene.observations,
    )
    write_problem(scene.replace(observations=pixels), f"{tmp_path}/model/")
    arguments = [str(tmp_path / "model"), "--reject", "--compilation", "quick", "--output"]
    assert run([*arguments, str(tmp_path / "out")]) == 0
    lines = capsys.readouterr().out.splitlines()
    notes = [line for line in lines if line.startswith("note: rejected ")]
    left = read_problem(tmp_path / "out").num_observations
    phases = [line for line in lines if line.startswith("   -- ")]
    assert phases[0].startswith("   -- all observations, with weights for residuals around ")
    assert phases[-1] == f"   -- the {left} observations that fit"
    assert len(notes) == 1
    assert re.match(
        rf"note: rejected {len(wrong) - left} of {len(wrong)} observations: image \d+ \(", notes[0]
    )
    assert left == pytest.approx((~wrong).sum(), rel=0.03)
    assert run([*arguments, str(tmp_path / "out.txt"), "--retriangulate"]) == 2
    assert "exclude each other" in capsys.readouterr().err
