"""`jaxba-paper` in this process: one table on tiny scenes, continuing, a missing record, and errors
of one line."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from jaxba.cli.paper import run
from jaxba.game import rollout, scene_bank
from jaxba.paper.report import CLAIMS
from jaxba.paper.results import PLAYS
from jaxba.paper.tables_and_figures import TABLES_AND_FIGURES
from jaxba.runtime import groups

TINY = """
agents:
  overrides:
    - chunks=1
    - evaluate_every=1
    - envs=8
    - "bank.kind={cameras: 4, points: 12, family: paper}"
    - bank.scenes=160
    - bank.refine_points=0
    - game.max_iterations=100
    - sac.width=8
    - sac.batch=16
    - loop.replay_capacity=500
    - loop.warmup_steps=16
    - loop.steps_per_chunk=8
  seeds: 1
  state_sizes: [5]
real:
  bal: [{name: Ladybug, files: [$JAXBA_DATA/bal/problem-49-7776-pre.txt.bz2]}]
  kitti: {name: KITTI, files: [$JAXBA_DATA/nothing.txt]}
figures: {scene: "scene:tiny", large_scene: "scene:tiny:1", profile_scenes: 1}
"""


@pytest.fixture(autouse=True)
def without_data(monkeypatch):
    monkeypatch.delenv("JAXBA_DATA", raising=False)


@pytest.fixture(scope="module")
def settings(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("settings") / "tiny.yaml"
    path.write_text(TINY)
    return path


def command(settings: Path, folder: Path) -> list[str]:
    report = folder.parent / "docs" / "paper.md"
    report.parent.mkdir(exist_ok=True)
    where = ["--out", str(folder), "--report", str(report)]
    return ["--config", str(settings), *where, "--only", "state-size"]


@pytest.fixture(scope="module")
def finished(settings, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("paper") / "run"
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("JAXBA_DATA", raising=False)
        patch.setattr(rollout, "LANES", groups.GROUP)
        # every rule needs its own compiled program
        patch.setattr(scene_bank, "PORTFOLIO", ("ceres",))
        assert run(command(settings, folder)) == 0
    return folder


def runs(capsys) -> int:
    found = re.findall(r"^  (\d+) runs?, ", capsys.readouterr().out, re.MULTILINE)
    assert len(found) == 1
    return int(found[0])


@pytest.mark.slow
def test_one_table_in_an_empty_folder(finished):
    plays = [json.loads(line) for line in (finished / PLAYS).read_text().splitlines()]
    trained = [
        "agent-printed",
        "agent",
        "agent-constant",
        "agent-guarded",
        "agent-guarded-constant",
    ]
    assert [(p["method"], p["seed"]) for p in plays] == [
        (name, 0) for name in ("classic", "ceres", *trained)
    ]
    assert len({len(p["iterations"]) for p in plays}) == 1
    text = (finished.parent / "docs" / "paper.md").read_text()
    assert "`jaxba-paper --config tiny.yaml`" in text
    assert "Machine: cpu" in text
    assert str(finished.parent) not in text
    assert "**BAL**: not run: JAXBA_DATA is not set." in text
    assert re.search(r"\| Ladybug: DeepLM \+ ours over DeepLM, seconds .* \*\*not run\*\* \|", text)
    row = next(line for line in text.splitlines() if line.startswith("| classic | 20 |"))
    mean = sum(
        i if c else 100 for i, c in zip(plays[0]["iterations"], plays[0]["converged"], strict=True)
    )
    assert row.split("|")[3].strip() == f"{mean / len(plays[0]['iterations']):.1f}".removesuffix(
        ".0"
    )
    for entry in TABLES_AND_FIGURES.values():
        assert entry.title
    assert text.count("\n## ") >= len(TABLES_AND_FIGURES)
    claims = (finished / CLAIMS).read_text()
    assert text.startswith(claims)
    assert claims.count("\n## ") == 1
    assert "Ladybug: DeepLM + ours over DeepLM" in claims


@pytest.mark.slow
def test_a_second_call_computes_nothing(finished, settings, capsys):
    before = (finished / PLAYS).read_bytes()
    assert run(command(settings, finished)) == 0
    assert runs(capsys) == 0
    assert (finished / PLAYS).read_bytes() == before


@pytest.mark.slow
@pytest.mark.parametrize("lost", [0, 2])
def test_only_a_missing_record_is_computed_again(finished, settings, capsys, lost, monkeypatch):
    monkeypatch.setattr(rollout, "LANES", groups.GROUP)
    lines = (finished / PLAYS).read_text().splitlines(keepends=True)
    (finished / PLAYS).write_text("".join(line for k, line in enumerate(lines) if k != lost))
    assert run(command(settings, finished)) == 0
    assert runs(capsys) == 1
    again = (finished / PLAYS).read_text().splitlines(keepends=True)
    old = json.loads(lines[lost])
    new = json.loads(again[-1])
    assert {**old, "seconds": 0} == {**new, "seconds": 0}
    (finished / PLAYS).write_text("".join(lines))


def error_of(capsys, *argv: str) -> str:
    assert run(list(argv)) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    return error


@pytest.mark.slow
def test_a_folder_of_another_run_is_refused(finished, tmp_path, capsys):
    other = tmp_path / "other.yaml"
    other.write_text(TINY.replace("seeds: 1", "seeds: 2"))
    error = error_of(capsys, "--config", str(other), "--out", str(finished))
    assert "holds a run with another agents.seeds" in error


def test_wrong_arguments_are_one_line(capsys, tmp_path):
    assert "--only tables: unknown; known: kitti, bal" in error_of(capsys, "--only", "tables")
    wrong = tmp_path / "wrong.yaml"
    wrong.write_text("seeds: 3")
    assert "unknown key seeds" in error_of(
        capsys, "--config", str(wrong), "--out", str(tmp_path / "run")
    )
    assert not (tmp_path / "run").exists()
    missing = str(tmp_path / "none" / "paper.md")
    assert "does not exist" in error_of(
        capsys, "--config", "fast", "--out", str(tmp_path / "run"), "--report", missing
    )


def test_list_prints_all_tables_and_figures(capsys):
    assert run(["--list"]) == 0
    listed = [line.split()[0] for line in capsys.readouterr().out.splitlines()]
    assert listed == list(TABLES_AND_FIGURES)
    tables = "kitti bal synthetic subproblems zero-net state-size reversed rewards schedule small"
    assert listed == [*tables.split(), "lambda", "profiles", "convergence"]
