"""`jaxba-train` in this process on few scenes: its files, Ctrl-C, continuing, and errors of one
line."""

from __future__ import annotations

import os
import re
import shutil
import signal
from pathlib import Path

import chex
import pytest
from safetensors import safe_open

from jaxba.cli.train import run
from jaxba.damping.policy_file import load_policy
from jaxba.game import rollout
from jaxba.runtime import groups
from jaxba.training import log, task
from jaxba.training.config import load
from jaxba.typing import InputError

TINY = [
    *("chunks=4", "evaluate_every=1", "envs=8"),
    *(
        "bank.kind={cameras: 4, points: 12, family: paper}",
        "bank.scenes=160",
        "bank.refine_points=0",
    ),
    "game.max_iterations=12",
    *(
        "sac.width=8",
        "sac.batch=16",
        "loop.replay_capacity=500",
        "loop.warmup_steps=16",
        "loop.steps_per_chunk=8",
    ),
]
COMMAND = ["--config", "default", "--set", *TINY]
CLOCKS = ("wall_s", "chunk_s", "steps_per_s", "updates_per_s", "cpu_per_wall", "evaluate_s")


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    """Few lanes and rules, since every rule needs its own compiled program."""
    monkeypatch.setattr(rollout, "LANES", groups.GROUP)
    monkeypatch.setattr(task, "BASELINES", ("ceres",))


@pytest.fixture(scope="module")
def scenes(tmp_path_factory) -> Path:
    """A folder whose run was interrupted after the first chunk."""
    folder = tmp_path_factory.mktemp("train") / "run"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rollout, "LANES", groups.GROUP)
        patch.setattr(task, "BASELINES", ("ceres",))
        interrupt_at(1, patch)
        assert run([*COMMAND, "--out", str(folder)]) == 130
    return folder


@pytest.fixture
def folder(scenes, tmp_path) -> Path:
    return Path(shutil.copytree(scenes, tmp_path / "run"))


@pytest.fixture(scope="module")
def finished(scenes, tmp_path_factory) -> Path:
    folder = Path(shutil.copytree(scenes, tmp_path_factory.mktemp("done") / "run"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rollout, "LANES", groups.GROUP)
        patch.setattr(task, "BASELINES", ("ceres",))
        assert run(["--out", str(folder), "--resume"]) == 0
    return folder


def interrupt_at(chunk: int, patch: pytest.MonkeyPatch, times: int = 1) -> None:
    """Sends Ctrl-C while the log of a chunk is written."""
    write = log.write

    def pressed(folder, row):
        done = write(folder, row)
        if row["chunk"] == chunk:
            for _ in range(times):
                os.kill(os.getpid(), signal.SIGINT)
        return done

    patch.setattr(log, "write", pressed)


def error_of(capsys, *argv: str) -> str:
    assert run(list(argv)) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ")
    assert error.count("\n") == 1
    return error


# Errors


def test_errors_of_the_configuration_are_one_line(capsys, tmp_path):
    out = str(tmp_path / "run")
    assert "did you mean width" in error_of(capsys, "--set", "sac.with=3", "--out", out)
    assert "unknown key zzz" in error_of(
        capsys, "--set", "seed=1", "--set", "zzz=1", "seeds=2", "--out", out
    )
    assert "known: default, fast, paper, paper-tuned" in error_of(
        capsys, "--config", "best", "--out", out
    )
    assert "No such file" in error_of(capsys, "--config", "some/where.yaml", "--out", out)
    assert "holds no run to resume" in error_of(capsys, "--resume", "--out", out)
    assert not (tmp_path / "run").exists()


# Results


@pytest.mark.slow
def test_a_run_writes_policy_page_log_and_configuration(finished):
    names = {path.name for path in finished.iterdir()}
    assert names == {
        *("config.yaml", "bank.npz", "rules.npz", "metrics.jsonl", "checkpoints"),
        *("policy.safetensors", "report.html"),
    }
    assert load(str(finished / "config.yaml")) == load("default", TINY)
    assert [row["chunk"] for row in log.read(finished)] == [1, 2, 3, 4]
    assert log.read(finished)[1]["episode/ceres"] > 0


def test_the_policy_file_has_the_best_policy_and_its_origin(finished):
    policy = load_policy(finished / "policy.safetensors")
    assert policy.config == load("default", TINY).game.agent
    scored = [row for row in log.read(finished) if "held_out/score" in row]
    best = min(scored, key=lambda row: row["training/score"])
    with safe_open(finished / "policy.safetensors", framework="numpy") as file:
        metadata = file.metadata()
    assert metadata["chunk"] == str(best["chunk"])
    assert metadata["training_score"] == f"{best['training/score']:.4f}"
    assert "cameras: 4" in metadata["config"]
    actor = {"params": {"MLP_0": {f"Dense_{k}": x._asdict() for k, x in enumerate(policy.layers)}}}
    work = task.build(load("default", TINY), finished)
    assert work.compare([actor])[0]["trained"].mean == pytest.approx(best["held_out/score"], abs=1)


def test_a_finished_run_resumed_prints_the_table_again(finished, capsys):
    before = (finished / "metrics.jsonl").read_bytes()
    assert run(["--out", str(finished), "--resume"]) == 0
    output = capsys.readouterr().out
    for name in ("trained", "ceres", "virtual best", "policy.safetensors"):
        assert name in output
    for stage in (
        "starting",
        "compiling the training loop",
        "training",
        "comparing with the rules",
        "episodes and page",
    ):
        assert re.search(rf"^{stage}: [\d.]+ s$", output, re.MULTILINE)
    assert (finished / "metrics.jsonl").read_bytes() == before


# Several processes

IN_ANOTHER = """
import sys
from jaxba.cli import train
from jaxba.game import rollout
from jaxba.runtime import groups
from jaxba.training import task
rollout.LANES, task.BASELINES = groups.GROUP, ("ceres",)
sys.exit(train.run(sys.argv[1:]))
"""


# Interruptions


def test_ctrl_c_saves_the_run_and_prints_how_to_continue(folder, capsys, monkeypatch):
    before = signal.getsignal(signal.SIGINT)
    interrupt_at(3, monkeypatch)
    assert run(["--out", str(folder), "--resume"]) == 130
    captured = capsys.readouterr()
    assert f"interrupted and saved; go on with jaxba-train --out {folder} --resume" in captured.out
    assert "stopping after this chunk" in captured.err
    assert [row["chunk"] for row in log.read(folder)] == [1, 2, 3]
    assert signal.getsignal(signal.SIGINT) is before


def test_an_interrupted_run_continues_with_the_same_results(folder, finished, capsys, monkeypatch):
    with monkeypatch.context() as patch:
        interrupt_at(3, patch, times=2)
        assert run(["--out", str(folder), "--resume"]) == 130
    assert "interrupted; go on with" in capsys.readouterr().out
    assert run(["--out", str(folder), "--resume"]) == 0

    def plain(row):
        return {k: v for k, v in row.items() if k not in CLOCKS}

    assert list(map(plain, log.read(folder))) == list(map(plain, log.read(finished)))
    ours, theirs = (
        load_policy(run_folder / "policy.safetensors") for run_folder in (folder, finished)
    )
    chex.assert_trees_all_equal(ours, theirs)


# Errors


@pytest.mark.slow
def test_an_agent_is_trained_for_the_given_method(tmp_path):
    out = tmp_path / "run"
    assert run([*COMMAND, "method=stba", "chunks=1", "--out", str(out)]) == 0
    assert list(task.build(load(str(out / "config.yaml")), out).rules) == [
        "stba",
        "ceres",
        "virtual best",
    ]
    assert (out / "policy.safetensors").is_file()


def test_a_folder_that_has_a_run_is_refused(folder, capsys):
    assert "holds a run already; --resume goes on with it" in error_of(
        capsys, *COMMAND, "--out", str(folder)
    )


@pytest.mark.slow
def test_a_resumed_run_of_other_settings_is_refused(folder, capsys):
    error = error_of(capsys, "--out", str(folder), "--resume", "--set", "sac.width=9")
    assert "begun with another sac.width" in error


@pytest.mark.slow
def test_a_bank_without_useful_scenes_is_one_line(capsys, tmp_path, monkeypatch):
    def none(*_args, **_kwargs):
        raise InputError("only 0 of 9 scenes are usable: draw more")

    monkeypatch.setattr(task, "make_split", none)
    assert "draw more" in error_of(capsys, *COMMAND, "--out", str(tmp_path / "run"))
