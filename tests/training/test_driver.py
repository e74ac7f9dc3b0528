"""The training driver on a toy game: the same numbers after a kill, a log without gaps, no two runs
mixed up."""

from __future__ import annotations

import dataclasses
import errno
import json
import os
from pathlib import Path

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toys

from jaxba.damping import ProblemInfo
from jaxba.game.random_scenes import Scenes
from jaxba.game.scene_bank import Bank, Split
from jaxba.runtime.atomic import TEMPORARY
from jaxba.training import checkpoint, driver, log, task
from jaxba.training.config import TrainConfig, load
from jaxba.training.driver import Best, Hooks, Outcome, TrainError, prepare_folder
from jaxba.training.sac import SacConfig
from jaxba.training.train_loop import LoopConfig

CONFIG = TrainConfig(
    chunks=6,
    evaluate_every=2,
    sac=SacConfig(width=8, batch=16),
    loop=LoopConfig(replay_capacity=300, warmup_steps=16, steps_per_chunk=5),
)
CLOCKS = ("wall_s", "chunk_s", "steps_per_s", "updates_per_s", "cpu_per_wall", "evaluate_s")


class Killed(Exception):
    """Stands for a signal that leaves no time for anything."""


def evaluate(actor) -> dict[str, float]:
    """Some number that depends on the weights."""
    score = float(jnp.sum(jnp.abs(actor["params"]["MLP_0"]["Dense_2"]["kernel"])))
    return {"training/score": score, "held_out/p90": np.nan}


def run(folder: Path, config: TrainConfig = CONFIG, resume: bool = False, **hooks) -> Outcome:
    config = prepare_folder(folder, None if resume else config, resume)
    return driver.train(config, toys.SEEN, evaluate, folder, Hooks(**hooks))


def kill_after(chunks: int):
    """A hook that ends everything once so many rows are written."""

    def hook(rows: list[log.Row]) -> None:
        if rows[0]["chunk"] == chunks:
            raise Killed

    return hook


def stop_after(chunks: int):
    asked = iter(range(1, 1000))
    return lambda: next(asked) == chunks


def rows(folder: Path) -> list[dict]:
    return [{k: v for k, v in row.items() if k not in CLOCKS} for row in log.read(folder)]


def same(one: Outcome, other: Outcome) -> None:
    """Bit for bit."""
    assert one.best
    assert [best[1:] for best in one.best] == [best[1:] for best in other.best]
    for a, b in (
        (one.state, other.state),
        ([x.actor for x in one.best], [x.actor for x in other.best]),
    ):
        first = checkpoint.pack(a)
        second = checkpoint.pack(b)
        assert list(first) == list(second)
        for name in first:
            assert first[name].tobytes() == second[name].tobytes(), name


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> tuple[Path, Outcome]:
    """A run of six chunks that nothing interrupts."""
    folder = tmp_path_factory.mktemp("whole") / "run"
    return folder, run(folder)


# The log


def test_every_chunk_has_its_row(whole):
    found = log.read(whole[0])
    assert [(row["seed"], row["chunk"]) for row in found] == [(0, k) for k in range(1, 7)]
    assert [row["env_steps"] for row in found] == [16 + 40 * k for k in range(1, 7)]
    assert [row["updates"] for row in found] == [5 * k for k in range(1, 7)]
    names = {
        *CLOCKS[:-1],
        "entropy",
        "temperature",
        "q_mean",
        "critic_loss",
        "actor_loss",
        "action_mean",
    }
    names |= {"action_std", "episode/length", "reward", "dropped"}
    for row in found:
        assert names <= set(row)
        assert ("training/score" in row) == (row["chunk"] % 2 == 0)
        assert row["steps_per_s"] == pytest.approx(40 / row["chunk_s"])


def test_numbers_that_are_not_finite_are_null(whole):
    text = (whole[0] / log.FILE).read_text()
    assert "NaN" not in text
    assert log.read(whole[0])[1]["held_out/p90"] is None


def test_the_best_policy_is_that_of_the_lowest_score_on_training_scenes(whole):
    scores = {
        row["chunk"]: row["training/score"] for row in log.read(whole[0]) if "training/score" in row
    }
    (best,) = whole[1].best
    assert best.chunk == min(scores, key=scores.__getitem__)
    assert best.score == scores[best.chunk]
    assert evaluate(best.actor)["training/score"] == best.score


def test_the_last_chunk_is_evaluated_and_saved_even_off_the_beat(tmp_path):
    run(tmp_path / "run", dataclasses.replace(CONFIG, chunks=3))
    assert [row["chunk"] for row in log.read(tmp_path / "run") if "training/score" in row] == [2, 3]
    assert checkpoint.steps(tmp_path / "run" / driver.CHECKPOINTS) == [2, 3]


# Going on


@pytest.mark.parametrize("chunks", [1, 3, 4])
def test_a_killed_run_goes_on_bit_for_bit(chunks, whole, tmp_path):
    folder = tmp_path / "run"
    with pytest.raises(Killed):
        run(folder, rows=kill_after(chunks))
    with (folder / log.FILE).open("a") as file:
        file.write('{"seed": 0, "chu')
    assert len(rows(folder)) == chunks
    same(run(folder, resume=True), whole[1])
    assert rows(folder) == rows(whole[0])


def test_a_run_killed_twice_goes_on_bit_for_bit(whole, tmp_path):
    folder = tmp_path / "run"
    with pytest.raises(Killed):
        run(folder, rows=kill_after(3))
    with pytest.raises(Killed):
        run(folder, resume=True, rows=kill_after(3))
    same(run(folder, resume=True), whole[1])
    assert rows(folder) == rows(whole[0])


def test_a_run_that_is_asked_to_stop_saves_and_goes_on_bit_for_bit(whole, tmp_path):
    folder = tmp_path / "run"
    outcome = run(folder, stop=stop_after(3))
    assert not outcome.finished
    assert checkpoint.steps(folder / driver.CHECKPOINTS)[-1] == 3
    outcome = run(folder, resume=True)
    assert outcome.finished
    same(outcome, whole[1])
    assert rows(folder) == rows(whole[0])


def test_a_finished_run_resumed_is_finished(whole, tmp_path):
    before = rows(whole[0])
    same(run(whole[0], resume=True), whole[1])
    assert rows(whole[0]) == before


def test_a_run_may_be_made_longer(whole, tmp_path):
    folder = tmp_path / "run"
    run(folder, dataclasses.replace(CONFIG, chunks=2))
    config = prepare_folder(folder, None, True, ("chunks=6",))
    assert config == CONFIG
    same(driver.train(config, toys.SEEN, evaluate, folder), whole[1])
    assert rows(folder) == rows(whole[0])


@pytest.mark.parametrize("chunks", [1, 3])
def test_a_run_made_shorter_ends_with_an_evaluation_of_what_it_has(chunks, tmp_path):
    """Stopped after `chunks`, between two evaluations, it is told to end there."""
    asked = iter([False] * (chunks - 1) + [True])
    assert not run(tmp_path, stop=lambda: next(asked)).finished
    shorter = dataclasses.replace(CONFIG, chunks=chunks)
    handed: list[tuple[Best, ...]] = []
    found = driver.train(shorter, toys.SEEN, evaluate, tmp_path, Hooks(best=handed.append))
    assert found.finished
    (best,) = found.best
    last = evaluate(jax.tree.map(lambda x: x[0], found.state.learner.actor))["training/score"]
    assert best.score <= last
    assert [best.chunk for (best,) in handed] == ([chunks] if best.score == last else [])


@pytest.mark.slow
def test_several_agents_learn_side_by_side_what_each_learns_alone_also_after_a_kill(
    whole, tmp_path
):
    config = dataclasses.replace(CONFIG, seeds=2)
    straight = tmp_path / "straight"
    broken = tmp_path / "broken"
    outcome = run(straight, config)
    found = rows(straight)
    assert [(row["seed"], row["chunk"]) for row in found] == [
        (s, k) for k in range(1, 7) for s in (0, 1)
    ]
    for row, alone in zip(found[::2], rows(whole[0]), strict=True):
        assert {name: x for name, x in row.items() if x is not None} == pytest.approx(
            {name: x for name, x in alone.items() if x is not None}, rel=1e-3, abs=1e-6
        )
    assert found[1]["critic_loss"] != found[0]["critic_loss"]
    for agent, best in enumerate(outcome.best):
        scores = {
            row["chunk"]: row["training/score"]
            for row in found[agent::2]
            if "training/score" in row
        }
        assert (best.agent, best.chunk) == (agent, min(scores, key=scores.__getitem__))
    assert driver.best_of(outcome.best).score == min(
        row.get("training/score", np.inf) for row in found
    )
    with pytest.raises(Killed):
        run(broken, config, rows=kill_after(3))
    same(run(broken, resume=True), outcome)
    assert rows(broken) == found


def test_only_the_last_checkpoints_stay(whole):
    folder = whole[0] / driver.CHECKPOINTS
    assert sorted(item.name for item in folder.iterdir()) == ["step_4.npz", "step_6.npz"]


def test_better_policies_are_handed_out_as_they_are_found(tmp_path):
    found: list[tuple[Best, ...]] = []
    outcome = run(tmp_path / "run", best=found.append)
    scores = [best.score for (best,) in found]
    assert scores == sorted(scores, reverse=True)
    assert found[-1] == outcome.best


# What is refused


def test_a_folder_that_holds_a_run_is_refused_and_nothing_is_lost(whole):
    before = {path: path.read_bytes() for path in whole[0].rglob("*") if path.is_file()}
    with pytest.raises(TrainError, match="holds a run already; --resume goes on with it"):
        prepare_folder(whole[0], CONFIG, False)
    assert {path: path.read_bytes() for path in whole[0].rglob("*") if path.is_file()} == before


def test_a_folder_of_something_else_is_refused(tmp_path):
    (tmp_path / "letter.txt").write_text("dear")
    with pytest.raises(TrainError, match="is not empty"):
        prepare_folder(tmp_path, CONFIG, False)
    assert [path.name for path in tmp_path.iterdir()] == ["letter.txt"]


def test_a_run_that_never_came_to_anything_is_no_obstacle(tmp_path):
    prepare_folder(tmp_path / "run", CONFIG, False)
    (tmp_path / "run" / ".DS_Store").touch()
    prepare_folder(tmp_path / "run", dataclasses.replace(CONFIG, seed=1), False)
    assert load(str(tmp_path / "run" / driver.CONFIG)).seed == 1


def test_nothing_to_resume(tmp_path):
    with pytest.raises(TrainError, match="holds no run to resume"):
        prepare_folder(tmp_path / "none", None, True)
    assert not (tmp_path / "none").exists()


def test_a_resumed_run_may_not_become_another(whole):
    with pytest.raises(TrainError, match=r"another sac\.width; a resumed run may change chunks"):
        prepare_folder(whole[0], None, True, ("sac.width=9",))
    with pytest.raises(TrainError, match="begun with another seed"):
        prepare_folder(whole[0], dataclasses.replace(CONFIG, seed=1), True)
    assert prepare_folder(whole[0], CONFIG, True) == CONFIG


def test_a_folder_that_cannot_be_made_is_one_line(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(TrainError, match=r"^[^\n]*file/run[^\n]*$"):
        prepare_folder(tmp_path / "file" / "run", CONFIG, False)


def test_losses_that_are_no_numbers_end_the_run_before_they_are_saved(tmp_path):
    config = dataclasses.replace(CONFIG, sac=dataclasses.replace(CONFIG.sac, learning_rate=1e30))
    with pytest.raises(TrainError, match="the losses are not finite any more"):
        run(tmp_path / "run", config)
    assert checkpoint.steps(tmp_path / "run" / driver.CHECKPOINTS) == []


# Checkpoints and banks


def tree():
    return {
        "key": jax.random.key(3),
        "pair": (jnp.arange(3.0), None),
        "flag": jnp.array([True, False]),
    }


@pytest.mark.parametrize("name", ["checkpoints", "[x]", "a*", "what?"])
def test_a_tree_survives_a_checkpoint(name, tmp_path):
    folder = tmp_path / name
    checkpoint.save(folder, 5, checkpoint.pack(tree()), {"wall_s": 1.5, "best": None}, 2)
    arrays, facts = checkpoint.restore(folder, 5)
    found = checkpoint.unpack(arrays, jax.eval_shape(tree))
    assert facts == {"wall_s": 1.5, "best": None}
    assert jax.tree.structure(found) == jax.tree.structure(tree())
    assert jax.random.normal(found["key"]) == jax.random.normal(tree()["key"])
    np.testing.assert_array_equal(found["flag"], [True, False])


def test_what_a_kill_left_half_written_is_no_checkpoint(tmp_path):
    (tmp_path / TEMPORARY.format("0123456789abcdef")).write_bytes(b"half of step 9")
    assert checkpoint.steps(tmp_path) == []
    checkpoint.save(tmp_path, 5, checkpoint.pack(tree()), {}, 1)
    assert [item.name for item in tmp_path.iterdir()] == ["step_5.npz"]


def test_a_full_disk_leaves_the_checkpoint_before_and_is_one_line(tmp_path, monkeypatch):
    checkpoint.save(tmp_path, 5, checkpoint.pack(tree()), {}, 1)

    def full(file, **arrays):
        file.write(b"half")
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(np, "savez", full)
    with pytest.raises(
        TrainError, match=r"^[^\n]*step_6\.npz cannot be written: No space left on device$"
    ):
        checkpoint.save(tmp_path, 6, checkpoint.pack(tree()), {}, 1)
    assert [item.name for item in tmp_path.iterdir()] == ["step_5.npz"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda arrays: arrays.pop("flag"), "flag is missing"),
        (lambda arrays: arrays.update(flag=np.zeros(2)), r"flag is float64\[2\], not bool\[2\]"),
        (
            lambda arrays: arrays.update({"pair.0": np.zeros(4)}),
            r"pair\.0 is float64\[4\], not float64\[3\]",
        ),
    ],
)
def test_a_checkpoint_of_something_else_is_refused(change, message):
    arrays = checkpoint.pack(tree())
    change(arrays)
    with pytest.raises(TrainError, match=message):
        checkpoint.unpack(arrays, jax.eval_shape(tree))


def test_a_broken_checkpoint_is_refused_in_one_line(tmp_path):
    folder = tmp_path / "run"
    run(folder, stop=stop_after(1))
    for path in (folder / driver.CHECKPOINTS).rglob("*"):
        if path.is_file():
            path.write_bytes(b"")
    with pytest.raises(TrainError, match=r"^the last checkpoint does not fit: [^\n]*$"):
        run(folder, resume=True)


def test_scenes_survive_their_file(tmp_path):
    def bank(count: int) -> Bank:
        number = jnp.arange(count, dtype=jnp.float64)
        scenes = Scenes(
            jnp.ones((count, 9, 4)),
            jnp.ones((count, 3, 11)),
            jnp.ones((count, 2, 44)),
            jnp.ones((count, 44), bool),
        )
        whole = number.astype(jnp.int32)
        info = ProblemInfo(number, whole, whole, whole, number, number, whole)
        return Bank(scenes, number, 2 * number, info, number)

    split = Split(bank(5), bank(2))
    task._write_split(tmp_path / "bank.npz", split)
    found = task.read_split(tmp_path / "bank.npz")
    chex.assert_trees_all_equal(found, split, strict=True)
    assert [path.name for path in tmp_path.iterdir()] == ["bank.npz"]
    with np.load(tmp_path / "bank.npz") as file:
        older = {name: file[name] for name in file.files if not name.endswith("best_cost")}
    np.savez(tmp_path / "older.npz", **older)
    message = (
        r"^[^\n]*older.npz: written by another version \([^\n]*best_cost[^\n]*\); begin in "
        r"a "
        r"new folder$"
    )
    with pytest.raises(TrainError, match=message):
        task.read_split(tmp_path / "older.npz")
    for damage in (b"", b"no bank", (tmp_path / "bank.npz").read_bytes()[:-100]):
        (tmp_path / "damaged.npz").write_bytes(damage)
        with pytest.raises(
            TrainError, match=r"^[^\n]*damaged.npz: damaged; begin in a new folder$"
        ):
            task.read_split(tmp_path / "damaged.npz")


def test_the_log_is_json(whole):
    for line in (whole[0] / log.FILE).read_text().splitlines():
        json.loads(line)
