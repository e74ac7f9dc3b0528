"""Logging for Weights & Biases: what is sent, and what is said where the package is missing."""

from __future__ import annotations

import sys

import pytest

from jaxba.training.driver import TrainError
from jaxba.training.wandb_log import RUN, WandbLog, chunk_values

ROWS = [
    {"seed": k, "chunk": 2, "updates": 8, "wall_s": 1.5, "held_out/score": 3.0 + 2 * k, "nothing": None} for k in (0, 1)
]


def test_means_over_agents_and_each_agent_are_logged():
    found = chunk_values(ROWS)
    assert found["held_out/score"] == 4.0
    assert [found[f"seed{k}/held_out/score"] for k in (0, 1)] == [3.0, 5.0]
    assert "nothing" not in found
    assert "seed" not in found
    assert set(chunk_values(ROWS[:1])) == {"updates", "wall_s", "held_out/score"}


def test_a_missing_package_is_said_with_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "wandb", None)
    with pytest.raises(TrainError, match=r"pip install 'jaxba\[wandb\]'"):
        WandbLog("project", tmp_path, {})


@pytest.mark.extra
@pytest.mark.filterwarnings("ignore")  # of wandb itself
def test_an_offline_run_is_kept_in_the_folder_and_goes_on_under_its_id(tmp_path, monkeypatch):
    pytest.importorskip("wandb", reason="needs the extra wandb")
    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("WANDB_SILENT", "true")
    for _ in range(2):
        board = WandbLog("project", tmp_path, {"seeds": 2})
        board.write(ROWS)
        board.close()
    number = (tmp_path / RUN).read_text().strip()
    logs = sorted((tmp_path / "wandb").glob(f"offline-run-*{number}*/run-{number}.wandb"))
    assert len(logs) >= 1
    assert b"seed1/held_out/score" in logs[0].read_bytes()
