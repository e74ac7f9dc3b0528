"""What a full disk or a power failure leaves of a run: a torn log, checkpoints that were cut
short."""

from __future__ import annotations

import dataclasses
import json
import shutil
from pathlib import Path

import pytest
import toys
from test_driver import CONFIG, evaluate, rows, run, same

from jaxba.training import checkpoint, driver, log
from jaxba.training.driver import Outcome, TrainError

LONGER = dataclasses.replace(CONFIG, chunks=8)


@pytest.fixture(scope="module")
def unbroken(tmp_path_factory) -> tuple[Path, Outcome]:
    """A run of eight chunks that nothing interrupts."""
    folder = tmp_path_factory.mktemp("unbroken") / "run"
    return folder, run(folder, LONGER)


@pytest.fixture(scope="module")
def six(tmp_path_factory) -> Path:
    """The folder of a run of six chunks; its checkpoints are after 4 and 6."""
    folder = tmp_path_factory.mktemp("six") / "run"
    run(folder)
    assert checkpoint.steps(folder / driver.CHECKPOINTS) == [4, 6]
    return folder


@pytest.fixture
def folder(six, tmp_path) -> Path:
    return Path(shutil.copytree(six, tmp_path / "run"))


def resumed(folder: Path) -> tuple[Outcome, list[str]]:
    said: list[str] = []
    config = driver.prepare_folder(folder, LONGER, True)
    return driver.train(config, toys.SEEN, evaluate, folder, driver.Hooks(note=said.append)), said


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def flip_a_bit(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


DAMAGES = {
    "cut": cut,
    "empty": lambda path: path.write_bytes(b""),
    "zeros": lambda path: path.write_bytes(bytes(path.stat().st_size)),
    "a-bit": flip_a_bit,
    "a-folder": lambda path: (path.unlink(), path.mkdir()),
    "of-an-earlier-version": lambda path: (path.unlink(), path.with_suffix("").mkdir()),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_the_checkpoint_before_a_damaged_one_is_taken_with_a_word(damage, folder, unbroken):
    DAMAGES[damage](folder / driver.CHECKPOINTS / "step_6.npz")
    outcome, said = resumed(folder)
    same(outcome, unbroken[1])
    assert rows(folder) == rows(unbroken[0])
    (word,) = [line for line in said if "cannot be read" in line]
    assert "step_6" in word
    assert word.endswith("; going on from the one before, after chunk 4")
    assert "\n" not in word
    assert checkpoint.steps(folder / driver.CHECKPOINTS) == [6, 8]


def test_a_stray_checkpoint_of_a_higher_number_displaces_none(folder, unbroken):
    (folder / driver.CHECKPOINTS / "step_999").mkdir()
    outcome, _ = resumed(folder)
    same(outcome, unbroken[1])
    assert checkpoint.steps(folder / driver.CHECKPOINTS) == [6, 8]


def test_damaged_checkpoints_alone_are_one_line(folder):
    for number in (4, 6):
        cut(folder / driver.CHECKPOINTS / f"step_{number}.npz")
    with pytest.raises(
        TrainError, match=r"^the last checkpoint does not fit: [^\n]*step_6[^\n]* \(and 1 more\)"
    ):
        resumed(folder)


TEARS = {
    "last-line": lambda text: text[:-40],
    "last-newline": lambda text: text[:-1],
    "zeros-at-the-end": lambda text: text[:-300] + bytes(300),
    "middle": lambda text: text.replace(b',"env_steps"', b"", 1).replace(b'\n{"seed"', b"", 1),
    "no-utf-8": lambda text: text[:900] + b"\xff\xfe" + text[902:],
    "another-object": lambda text: text.replace(b'"chunk":3', b'"chunk":"x"', 1),
    "a-number": lambda text: b"17\n" + text,
}


@pytest.mark.parametrize("tear", TEARS)
def test_damaged_lines_of_the_log_are_dropped_with_a_word(tear, folder, unbroken):
    path = folder / log.FILE
    whole = path.read_bytes()
    path.write_bytes(TEARS[tear](whole))
    good = [
        line
        for line in path.read_bytes().splitlines(keepends=True)
        if line in whole.splitlines(keepends=True)
    ]
    expected = [json.loads(line) for line in good]
    assert log.read(folder) == expected
    outcome, said = resumed(folder)
    same(outcome, unbroken[1])
    assert log.read(folder)[: len(good)] == expected
    assert [row["chunk"] for row in log.read(folder)][-2:] == [7, 8]
    assert path.read_bytes().startswith(b"".join(good))
    (word,) = [line for line in said if "damaged" in line]
    assert "metrics.jsonl: 1 damaged line dropped" in word


def test_a_log_that_is_gone_or_empty_begins_anew(folder):
    (folder / log.FILE).unlink()
    resumed(folder)
    assert [row["chunk"] for row in log.read(folder)] == [7, 8]
