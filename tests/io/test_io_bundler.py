"""Bundler models: the same problem as the BAL file made from it, and every bad file is refused with
one clear line."""

from __future__ import annotations

import bz2
import gzip
import lzma
import os
from pathlib import Path

import numpy as np
import pytest

from jaxba.io import read_bundler, read_problem
from jaxba.problem.bundle_problem import ProblemError

DATA = os.environ.get("JAXBA_DATA")
needs_data = pytest.mark.skipif(DATA is None, reason="JAXBA_DATA is not set")
OPENERS = {"": open, ".bz2": bz2.open, ".gz": gzip.open, ".xz": lzma.open}

# Lines: 1 header, 2 counts, 3-7, 8-12 and 13-17 cameras (the second is not registered), 18-20 and
# 21-23 points.
LINES = [
    "# Bundle file v0.3",
    "3 2",
    *("500.0 -0.1 0.01", "1 0 0", "0 1 0", "0 0 1", "0.1 0.2 0.3"),
    *("0 0 0", "0 0 0", "0 0 0", "0 0 0", "0 0 0"),
    *("600.0 -0.2 0.02", "0 -1 0", "1 0 0", "0 0 1", "0.4 0.5 0.6"),
    *("1.0 2.0 -3.0", "255 0 7", "2 0 11 10.5 -20.5 2 12 30.5 40.5"),
    *("4.0 5.0 -6.0", "0 0 0", "1 2 13 -1.5 1e1"),
]


def write(path: Path, changes: dict[int, str | None]) -> Path:
    """Writes the valid model with lines (from 1) exchanged or, for None, left out."""
    lines = [changes.get(number, line) for number, line in enumerate(LINES, 1)]
    suffix = path.suffix if path.suffix in OPENERS else ""
    with OPENERS[suffix](path, "wb") as file:
        file.write(("\n".join(line for line in lines if line is not None) + "\n").encode())
    return path


def message_of(path: Path) -> str:
    with pytest.raises(ProblemError) as caught:
        read_bundler(path)
    message = str(caught.value)
    assert message.isprintable()
    assert path.name in message
    return message


@pytest.mark.parametrize("suffix", OPENERS)
@pytest.mark.parametrize("size", [1, 5, 1000])
def test_a_small_model_is_read_as_it_stands(tmp_path, monkeypatch, suffix, size):
    monkeypatch.setattr("jaxba.io.text.BLOCK_BYTES", size)
    problem = read_problem(write(tmp_path / f"bundle.out{suffix}", {}))
    np.testing.assert_array_equal(problem.points, [[1, 2, -3], [4, 5, -6]])
    np.testing.assert_array_equal(problem.point_index, [0, 0, 1])
    np.testing.assert_array_equal(problem.observations, [[10.5, -20.5], [30.5, 40.5], [-1.5, 10]])
    # the camera that is not registered is gone
    np.testing.assert_array_equal(problem.camera_index, [0, 1, 1])
    first = [0, 0, 0, 0.1, 0.2, 0.3, 500, -0.1, 0.01]
    second = [0, 0, np.pi / 2, 0.4, 0.5, 0.6, 600, -0.2, 0.02]
    np.testing.assert_allclose(problem.cameras, [first, second], rtol=1e-15, atol=1e-15)


def test_line_ends_of_windows_are_read(tmp_path):
    path = tmp_path / "bundle.out"
    path.write_bytes(("\r\n".join(LINES)).encode())
    assert read_bundler(path).num_observations == 3


def test_a_registered_camera_without_views_is_kept(tmp_path):
    changes: dict[int, str | None] = {8: "10 0 0", 9: "1 0 0", 10: "0 1 0", 11: "0 0 1"}
    assert read_bundler(write(tmp_path / "bundle.out", changes)).num_cameras == 3


def test_points_with_less_than_two_views_are_kept(tmp_path):
    problem = read_bundler(write(tmp_path / "bundle.out", {23: "0"}))
    assert (problem.num_points, problem.num_observations) == (2, 2)


BAD_TEXTS = {
    "another version": (
        {1: "# Bundle file v0.4"},
        "line 1: '# Bundle file v0.4' is not the header",
    ),
    "no header": ({1: None}, "line 1: '3 2' is not the header"),
    "no cameras": ({2: "0 2"}, "line 2: '0' is outside 1..2147483647 (number of cameras)"),
    "fraction of a camera": ({2: "1.5 2"}, "line 2: '1.5' is not an integer (number of cameras)"),
    "huge count of cameras": (
        {2: "2147483647 2"},
        "line 23: the file ends before the R33 of camera 4",
    ),
    "huge count of points": ({2: "3 2147483647"}, "line 23: the file ends before the x of point 2"),
    "word for a focal length": ({3: "f 0 0"}, "line 3: 'f' is not a number (f of camera 0)"),
    "nan in a rotation": ({5: "0 nan 0"}, "line 5: 'nan' is not a finite number (R22 of camera 0)"),
    "reflection": (
        {6: "0 0 -1"},
        "line 4: '1' is the first number of a matrix that is no rotation (R11 of camera 0)",
    ),
    "scaled rotation": (
        {4: "2 0 0"},
        "line 4: '2' is the first number of a matrix that is no rotation",
    ),
    "huge rotation": (
        {4: "1e200 0 0"},
        "line 4: '1e200' is the first number of a matrix that is no rotation",
    ),
    "view of no camera": (
        {23: "1 3 13 0 0"},
        "line 23: '3' is outside 0..2 (camera index of view 0 of point 1)",
    ),
    "view of a lost camera": (
        {23: "1 1 13 0 0"},
        "line 8: '0' stands for a camera that is not registered",
    ),
    "camera with a fraction": (
        {20: "1 .5 11 0 0"},
        "line 20: '.5' is not an integer (camera index of view 0",
    ),
    "negative count of views": (
        {20: "-1"},
        "line 20: '-1' is outside 0..2147483647 (number of views of point 0)",
    ),
    "fractional count of views": (
        {20: "0.5"},
        "line 20: '0.5' is not an integer (number of views of point 0)",
    ),
    "count of views too large": (
        {23: "2 2 1 1 1"},
        "line 23: the file ends before the camera index of view 1 of poi",
    ),
    "huge count of views": (
        {20: "2000000000"},
        "line 23: the file ends before the y of view 2 of point 0",
    ),
    "word in a colour": ({19: "255 red 7"}, "line 19: 'red' is not a number (green of point 0)"),
    "word as a key": (
        {20: "1 0 key 0 0"},
        "line 20: 'key' is not a number (key of view 0 of point 0)",
    ),
    "no views at all": ({20: "0", 23: "0"}, "no camera sees a point"),
    "left over": ({23: "0 9"}, "line 23: '9' is left over after the last number"),
    "word left over": ({23: "0\nend"}, "line 24: 'end' is left over after the last number"),
}


@pytest.mark.parametrize("suffix", ["", ".gz"])
@pytest.mark.parametrize("case", BAD_TEXTS)
def test_bad_text_is_refused_by_line_and_field(tmp_path, case, suffix):
    changes, expected = BAD_TEXTS[case]
    path = write(tmp_path / f"bundle.out{suffix}", changes)
    assert expected in message_of(path)


def test_every_truncation_is_refused(tmp_path):
    path = tmp_path / "bundle.out"
    whole = "\n".join(LINES[:-1]) + "\n1 2 13 -1.5 "
    for size in range(len(whole)):
        path.write_text(whole[:size])
        assert "line " in message_of(path)


@pytest.mark.parametrize("suffix", [".bz2", ".gz", ".xz"])
def test_damaged_compressed_files_are_refused(tmp_path, suffix):
    path = write(tmp_path / f"bundle.out{suffix}", {})
    whole = path.read_bytes()
    for content in (
        b"",
        whole[:10],
        whole[:-1],
        whole[: len(whole) // 2],
        whole + b"garbage",
        b"# Bundle file v0.3\n",
    ):
        path.write_bytes(content)
        message_of(path)


@needs_data
def test_real_model_is_the_problem_that_was_converted_from_it():
    """The other file was made by an independent converter, which drops points with fewer than two
    views."""
    folder = Path(str(DATA))
    problem = read_problem(folder / "bundler" / "Balbianello.out")
    expected = read_problem(folder / "bal-converted" / "balbianello-5-544-pre.txt.bz2")
    np.testing.assert_allclose(problem.cameras, expected.cameras, rtol=1e-9, atol=1e-9)
    views = np.bincount(problem.point_index, minlength=problem.num_points)
    kept = np.flatnonzero(views >= 2)
    np.testing.assert_allclose(np.asarray(problem.points)[kept], expected.points, rtol=1e-9)

    def rows(of, renumber):
        table = np.column_stack([of.camera_index, renumber[of.point_index], of.observations])
        return table[np.lexsort(table.T[:2])]

    renumber = np.full(problem.num_points, -1)
    renumber[kept] = np.arange(len(kept))
    found = rows(problem, renumber)
    np.testing.assert_allclose(
        found[found[:, 1] >= 0], rows(expected, np.arange(expected.num_points)), rtol=1e-7
    )
