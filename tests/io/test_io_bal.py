"""BAL files: what is written reads back bit by bit, and every bad file is refused with one clear
line."""

from __future__ import annotations

import bz2
import gzip
import json
import lzma
import os
import stat
import threading
import tracemalloc
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from jaxba.io import files, read_bal, read_problem, text, write_bal, write_problem
from jaxba.problem.bundle_problem import BundleProblem, ProblemError

DATA = os.environ.get("JAXBA_DATA")
needs_data = pytest.mark.skipif(DATA is None, reason="JAXBA_DATA is not set")
SUFFIXES = ["", ".bz2", ".gz", ".xz"]
OPENERS = {"": open, ".bz2": bz2.open, ".gz": gzip.open, ".xz": lzma.open}

# 2 cameras, 3 points, 4 observations: line 1 the counts, 2-5 the observations, 6-23 the cameras,
# 24-32 the points.
LINES = ["2 3 4", "0 0 1.5 -2.5", "1 0 3.25 4e0", "0 1 -5 6", "1 2 .5 7."]
LINES += [str(number) for number in (*range(18), *range(100, 109))]


def text_of(changes: Mapping[int, str | None]) -> str:
    """The valid file with lines (from 1) exchanged or, for None, left out."""
    lines = [changes.get(number, line) for number, line in enumerate(LINES, 1)]
    return "\n".join(line for line in lines if line is not None) + "\n"


def random_problem(
    seed: int, *, cameras: int = 5, points: int = 40, observations: int = 300
) -> BundleProblem:
    """A problem whose numbers are random bit patterns: every exponent, subnormals and both
    zeros."""
    rng = np.random.default_rng(seed)

    def numbers(*shape: int) -> np.ndarray:
        values = rng.integers(0, 2**64, size=shape, dtype=np.uint64).view(np.float64)
        values = np.where(np.isfinite(values), values, 0.1)
        special = [
            0.0,
            -0.0,
            5e-324,
            -5e-324,
            2.2250738585072014e-308,
            2.225073858507201e-308,
            np.finfo(float).max,
        ]
        return np.where(rng.random(shape) < 0.2, rng.choice(special, shape), values)

    return BundleProblem.create(
        numbers(cameras, 9),
        numbers(points, 3),
        numbers(observations, 2),
        rng.integers(0, cameras, observations),
        rng.integers(0, points, observations),
    )


def assert_same_bits(one: BundleProblem, other: BundleProblem) -> None:
    for name in ("cameras", "points", "observations", "camera_index", "point_index"):
        a = np.asarray(getattr(one, name))
        b = np.asarray(getattr(other, name))
        assert (a.dtype, a.shape, a.tobytes()) == (b.dtype, b.shape, b.tobytes()), name


def message_of(path: Path, read=read_bal) -> str:
    """The message with which the file is refused, after a check of what holds for every message."""
    with pytest.raises(ProblemError) as caught:
        read(path)
    message = str(caught.value)
    assert message.isprintable()
    assert len(message.splitlines()) == 1
    assert path.name in message
    return message


def test_a_small_file_is_read_as_it_stands(tmp_path):
    (tmp_path / "a.txt").write_text(text_of({}))
    problem = read_bal(tmp_path / "a.txt")
    np.testing.assert_array_equal(problem.camera_index, [0, 1, 0, 1])
    np.testing.assert_array_equal(problem.point_index, [0, 0, 1, 2])
    np.testing.assert_array_equal(problem.observations, [[1.5, -2.5], [3.25, 4], [-5, 6], [0.5, 7]])
    np.testing.assert_array_equal(problem.cameras, np.arange(18.0).reshape(2, 9))
    np.testing.assert_array_equal(problem.points, np.arange(100.0, 109).reshape(3, 3))
    assert problem.whitening is None


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("seed", range(3))
def test_written_problem_reads_back_bit_by_bit(tmp_path, suffix, seed):
    problem = random_problem(seed)
    path = tmp_path / f"problem.txt{suffix}"
    write_problem(problem, path)
    assert_same_bits(read_problem(path), problem)
    with OPENERS[suffix](path, "rb") as file:  # the name's suffix says the truth
        assert file.readline() == b"5 40 300\n"


def test_same_problem_writes_same_bytes(tmp_path):
    for name in ("a.txt.gz", "b.txt.gz"):
        write_bal(random_problem(0), tmp_path / name)
    assert (tmp_path / "a.txt.gz").read_bytes() == (tmp_path / "b.txt.gz").read_bytes()


def test_float32_and_jax_arrays_are_written_exactly(tmp_path):
    import jax.numpy as jnp

    problem = BundleProblem.create(
        np.full((1, 9), 0.1), np.full((1, 3), 0.2), [[0.3, 0.4]], [0], [0]
    )
    narrow = problem.replace(
        cameras=jnp.full((1, 9), 0.1, dtype=jnp.float32), camera_index=jnp.zeros(1, jnp.int32)
    )
    write_bal(narrow, tmp_path / "a.txt")
    np.testing.assert_array_equal(
        read_bal(tmp_path / "a.txt").cameras, np.full((1, 9), np.float32(0.1), np.float64)
    )


def test_whitening_is_not_written(tmp_path):
    problem = BundleProblem.create(
        np.ones((1, 9)), np.ones((1, 3)), [[1, 2]], [0], [0], weight=[4.0]
    )
    write_bal(problem, tmp_path / "a.txt")
    assert read_bal(tmp_path / "a.txt").whitening is None


def test_compression_is_recognised_by_content_whatever_the_name(tmp_path):
    problem = random_problem(0)
    for suffix in SUFFIXES[1:]:
        write_bal(problem, tmp_path / f"a{suffix}")
        assert_same_bits(
            read_bal((tmp_path / f"a{suffix}").rename(tmp_path / "plain.txt")), problem
        )


@pytest.mark.parametrize("suffix", SUFFIXES[1:])
def test_compressed_files_of_several_streams_are_one_text(tmp_path, suffix):
    path = tmp_path / f"a.txt{suffix}"
    whole = text_of({}).encode()
    for start in range(0, len(whole), 50):
        with OPENERS[suffix](path, "ab") as file:
            file.write(whole[start : start + 50])
    (tmp_path / "plain.txt").write_bytes(whole)
    assert_same_bits(read_bal(path), read_bal(tmp_path / "plain.txt"))


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("size", [1, 2, 3, 7, 64, 1000])
def test_where_blocks_are_cut_changes_nothing(tmp_path, monkeypatch, size, suffix):
    problem = random_problem(1, observations=50)
    good, bad, out = (tmp_path / f"{name}.txt{suffix}" for name in ("good", "bad", "out"))
    write_bal(problem, good)
    for path, changes in ((bad, {19: "1x"}), (out, {4: "0 3 1.25 2.25"})):
        with OPENERS[suffix](path, "wb") as file:
            file.write(text_of(changes).encode())
    monkeypatch.setattr("jaxba.io.text.BLOCK_BYTES", size)
    assert_same_bits(read_bal(good), problem)
    assert message_of(out).endswith(" line 4: '3' is outside 0..2 (point index of observation 2)")
    assert message_of(bad).endswith(
        "bad.txt" + suffix + " line 19: '1x' is not a number (translation y of camera 1)"
    )


@pytest.mark.parametrize("separator", [" ", "\t", "\r\n", "\n", "\v", "\f", " \n\n  \t"])
def test_any_whitespace_separates(tmp_path, separator):
    (tmp_path / "a.txt").write_text(text_of({}))
    (tmp_path / "b.txt").write_bytes(separator.join(["", *text_of({}).split(), ""]).encode())
    assert_same_bits(read_bal(tmp_path / "a.txt"), read_bal(tmp_path / "b.txt"))


NUMBER = "is not a number"
FINITE = "is not a finite number"
BAD_TEXTS = {
    "word among the indices": (
        {3: "abc 0 1 2"},
        f"line 3: 'abc' {NUMBER} (camera index of observation 1)",
    ),
    "word among the pixels": ({5: "1 2 0x1F 7"}, f"line 5: '0x1F' {NUMBER} (x of observation 3)"),
    "word among the cameras": ({6: "1_0"}, f"line 6: '1_0' {NUMBER} (rotation x of camera 0)"),
    "word among the points": ({32: "1.5.5"}, f"line 32: '1.5.5' {NUMBER} (z of point 2)"),
    "comma": ({2: "0 0 1.5, -2.5"}, f"line 2: '1.5,' {NUMBER} (x of observation 0)"),
    "two numbers in one word": (
        {2: "0 0 1.5-2.5"},
        f"line 2: '1.5-2.5' {NUMBER} (x of observation 0)",
    ),
    "lone sign": ({2: "0 0 - 1"}, f"line 2: '-' {NUMBER} (x of observation 0)"),
    "non-ASCII word": ({2: "0 0 \u0661 1"}, f"line 2: '\\xd9\\xa1' {NUMBER} (x of observation 0)"),
    "long word": ({2: "0 0 " + 50 * "z"}, f"line 2: '{37 * 'z'}...' {NUMBER} (x of observation 0)"),
    "nan": ({4: "0 1 nan 6"}, f"line 4: 'nan' {FINITE} (x of observation 2)"),
    "NAN(1)": ({4: "0 1 NAN(1) 6"}, f"line 4: 'NAN(1)' {FINITE} (x of observation 2)"),
    "minus infinity": ({14: "-Infinity"}, f"line 14: '-Infinity' {FINITE} (k2 of camera 0)"),
    "overflow": ({24: "1e400"}, f"line 24: '1e400' {FINITE} (x of point 0)"),
    "infinite index": ({4: "inf 1 5 6"}, f"line 4: 'inf' {FINITE} (camera index of observation 2)"),
    "camera out of range": (
        {3: "2 0 1 2"},
        "line 3: '2' is outside 0..1 (camera index of observation 1)",
    ),
    "point out of range": (
        {3: "1 3 1 2"},
        "line 3: '3' is outside 0..2 (point index of observation 1)",
    ),
    "negative index": (
        {2: "-1 0 1 2"},
        "line 2: '-1' is outside 0..1 (camera index of observation 0)",
    ),
    "huge index": (
        {2: "1e300 0 1 2"},
        "line 2: '1e300' is outside 0..1 (camera index of observation 0)",
    ),
    "index with a fraction": (
        {2: "0 1.5 1 2"},
        "line 2: '1.5' is not an integer (point index of observation 0)",
    ),
    "count with a fraction": ({1: "2 3.5 4"}, "line 1: '3.5' is not an integer (number of points)"),
    "word as a count": ({1: "two 3 4"}, f"line 1: 'two' {NUMBER} (number of cameras)"),
    "negative count": ({1: "-2 3 4"}, "line 1: '-2' is outside 1..2147483647 (number of cameras)"),
    "no points": ({1: "2 0 4"}, "line 1: '0' is outside 1..2147483647 (number of points)"),
    "no observations": (
        {1: "2 3 0"},
        "line 1: '0' is outside 1..2147483647 (number of observations)",
    ),
    "absurd count": (
        {1: "2 3 1e18"},
        "line 1: '1e18' is outside 1..2147483647 (number of observations)",
    ),
    "huge count of observations": (
        {1: "2 3 2147483647"},
        "line 10: '4' is outside 0..1 (camera index of observation 5)",
    ),
    "huge count of cameras": (
        {1: "2147483647 3 4"},
        "line 32: the file ends before the rotation x of camera 3",
    ),
    "huge count of points": (
        {1: "2 2147483647 4"},
        "line 32: the file ends before the x of point 3",
    ),
    "line left over": ({32: "108\n109"}, "line 33: '109' is left over after the last number"),
    "word left over": ({32: "108\n\n end"}, "line 34: 'end' is left over after the last number"),
    "number left out": ({20: None}, "line 31: the file ends before the z of point 2"),
    "word and later a left-over": (
        {8: "x", 32: "1 2 3"},
        f"line 8: 'x' {NUMBER} (rotation z of camera 0)",
    ),
    "bad index, then a bad word": ({2: "9 0 1 2", 3: "x"}, "line 2: '9' is outside 0..1"),
}


@pytest.mark.parametrize("suffix", ["", ".bz2"])
@pytest.mark.parametrize("case", BAD_TEXTS)
def test_bad_text_is_refused_by_line_and_field(tmp_path, case, suffix):
    changes, expected = BAD_TEXTS[case]
    path = tmp_path / f"bad.txt{suffix}"
    with OPENERS[suffix](path, "wb") as file:
        file.write(text_of(changes).encode())
    assert f"{path} {expected}" in message_of(path)


def test_every_truncation_between_numbers_is_refused(tmp_path):
    path = tmp_path / "short.txt"
    for count in range(1, len(LINES)):
        path.write_text("\n".join(LINES[:count]))
        assert f"line {count}: the file ends before the " in message_of(path)


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"\n",
        b"\0",
        b"\xff\xfe2\x00 \x003\x00",
        b"\x89PNG\r\n\x1a\n\0\0",
        b"2 3 \0 4",
        b"7" * 200_000,
        bytes(5000),
    ],
    ids=["empty", "blank", "nul", "utf-16", "png", "nul word", "one long word", "zeros"],
)
def test_a_file_that_is_no_text_of_numbers_is_refused(tmp_path, content):
    path = tmp_path / "garbage.txt"
    path.write_bytes(content)
    assert "line 1" in message_of(path)


def test_a_number_of_many_digits_is_rounded_correctly(tmp_path):
    exact = f"{2**-1074:.1074f}"  # all digits of the smallest subnormal
    (tmp_path / "a.txt").write_text(
        text_of({24: exact, 25: "1" + 300 * "0", 26: "0." + 400 * "0" + "1"})
    )
    assert read_bal(tmp_path / "a.txt").points[0].tolist() == [5e-324, 1e300, 0.0]


@pytest.mark.parametrize("suffix", SUFFIXES[1:])
def test_damaged_compressed_files_are_refused(tmp_path, suffix):
    good = tmp_path / f"good.txt{suffix}"
    bad = tmp_path / f"bad.txt{suffix}"
    write_bal(random_problem(0), good)
    whole = good.read_bytes()
    half = len(whole) // 2
    for content in (
        *(whole[:size] for size in (0, 1, 3, 6, 12, half, len(whole) - 1)),
        whole[:half] + bytes([whole[half] ^ 0xFF]) + whole[half + 1 :],
        whole + b"garbage",
        whole + whole[:20],
        b"no compressed file",
    ):
        bad.write_bytes(content)
        message_of(bad)


def test_a_folder_is_refused(tmp_path):
    assert "Is a directory" in message_of(tmp_path)


def test_a_missing_file_is_refused(tmp_path):
    assert "No such file" in message_of(tmp_path / "missing.txt")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
def test_a_pipe_is_read(tmp_path):
    write_bal(random_problem(0), tmp_path / "a.txt.gz")
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    writer = threading.Thread(target=lambda: pipe.write_bytes((tmp_path / "a.txt.gz").read_bytes()))
    writer.start()
    assert_same_bits(read_bal(pipe), random_problem(0))
    writer.join()


def test_a_name_of_control_characters_stays_on_one_line(tmp_path):
    with pytest.raises(ProblemError, match=r"a\\nb\\x00\\ud800"):
        read_bal(tmp_path / "a\nb\0\ud800.txt")


@pytest.mark.skipif(
    not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may read everything"
)
def test_an_unreadable_file_is_refused(tmp_path):
    path = tmp_path / "secret.txt"
    path.write_text(text_of({}))
    path.chmod(0)
    assert "Permission denied" in message_of(path)


def test_a_read_that_fails_is_refused(tmp_path, monkeypatch):
    def refuse(*_):
        raise PermissionError(13, "Permission denied")

    path = tmp_path / "secret.txt"
    path.write_text(text_of({}))
    monkeypatch.setattr("builtins.open", refuse)
    assert "Permission denied" in message_of(path)


def test_no_memory_is_set_aside_for_a_header_that_lies(tmp_path):
    path = tmp_path / "liar.txt"
    path.write_text("2147483647 2147483647 2147483647\n0 0 1 2\n")
    message_of(path)  # imports and caches do not count
    tracemalloc.start()
    message_of(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 4 * text.BLOCK_BYTES


def test_reading_and_writing_take_a_few_blocks_beyond_the_problem(tmp_path, monkeypatch):
    monkeypatch.setattr("jaxba.io.text.BLOCK_BYTES", 1 << 16)
    monkeypatch.setattr("jaxba.io.files._PIECE", 1 << 16)
    monkeypatch.setattr("jaxba.io.bal._BLOCK_ROWS", 1 << 11)
    problem = random_problem(0, cameras=200, points=20_000, observations=150_000)
    path = tmp_path / "a.txt.gz"
    write_bal(random_problem(1), path)
    read_bal(path)  # imports and caches do not count
    tracemalloc.start()
    write_bal(problem, path)
    written = tracemalloc.get_traced_memory()[1]
    tracemalloc.reset_peak()
    before = tracemalloc.get_traced_memory()[0]
    found = read_bal(path)
    read = tracemalloc.get_traced_memory()[1] - before
    tracemalloc.stop()
    arrays = (
        found.cameras,
        found.points,
        found.observations,
        found.camera_index,
        found.point_index,
    )
    own = sum(array.nbytes for array in arrays)
    assert_same_bits(found, problem)
    assert written < 40 * (1 << 16)
    assert read < own + 40 * (1 << 16)
    assert len(gzip.decompress(path.read_bytes())) > 100 * (1 << 16)


class TestWriting:
    """The file appears whole or not at all."""

    def test_a_failed_write_leaves_the_old_file_and_no_other(self, tmp_path, monkeypatch):
        path = tmp_path / "a.txt"
        path.write_text("old")

        def refuse(*_):
            raise OSError(28, "No space left on device")

        monkeypatch.setattr(os, "replace", refuse)
        with pytest.raises(ProblemError, match=r"a\.txt: No space left on device$"):
            write_bal(random_problem(0), path)
        assert path.read_text() == "old"
        assert os.listdir(tmp_path) == ["a.txt"]

    def test_an_interrupted_write_leaves_nothing(self, tmp_path):
        def interrupted() -> None:
            with files.open_output(tmp_path / "a.txt.gz") as file:
                file.write(b"half")
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            interrupted()
        assert os.listdir(tmp_path) == []

    @pytest.mark.skipif(not os.path.isdir("/dev/fd"), reason="no names of open streams here")
    def test_an_open_stream_is_written_from_where_it_stands(self, tmp_path):
        with open(tmp_path / "all.txt", "wb", buffering=0) as file:
            file.write(b"before\n")
            with files.open_output(f"/dev/fd/{file.fileno()}") as stream:
                stream.write(b"inside\n")
            file.write(b"after\n")
        assert (tmp_path / "all.txt").read_bytes() == b"before\ninside\nafter\n"

    def test_a_problem_that_could_not_be_read_back_is_not_written(self, tmp_path):
        problem = random_problem(0)
        with pytest.raises(ProblemError, match="not finite"):
            write_bal(problem.replace(points=np.full((40, 3), np.nan)), tmp_path / "a.txt")
        assert os.listdir(tmp_path) == []

    def test_an_existing_file_is_replaced_through_a_link(self, tmp_path):
        (tmp_path / "real.txt").write_text("old")
        (tmp_path / "link.txt").symlink_to("real.txt")
        write_bal(random_problem(0), tmp_path / "link.txt")
        assert (tmp_path / "link.txt").is_symlink()
        assert_same_bits(read_bal(tmp_path / "real.txt"), random_problem(0))

    def test_a_new_file_has_the_usual_permissions(self, tmp_path):
        (tmp_path / "usual").write_text("")
        write_bal(random_problem(0), tmp_path / "a.txt")
        assert stat.S_IMODE((tmp_path / "a.txt").stat().st_mode) == stat.S_IMODE(
            (tmp_path / "usual").stat().st_mode
        )

    @pytest.mark.skipif(
        not os.path.exists(os.devnull) or os.name != "posix", reason="needs device files"
    )
    def test_a_device_is_written_and_not_replaced(self):
        write_bal(random_problem(0), os.devnull)
        assert stat.S_ISCHR(os.stat(os.devnull).st_mode)

    @pytest.mark.parametrize("name", ["", "missing/a.txt", "a\0b.txt"])
    def test_an_impossible_target_is_refused(self, tmp_path, name):
        with pytest.raises(ProblemError, match=r"^cannot write ") as caught:
            write_bal(random_problem(0), tmp_path / name)
        assert str(caught.value).isprintable()
        assert os.listdir(tmp_path) == []


@needs_data
def test_real_problems_have_the_sizes_and_costs_of_the_reference():
    folder = Path(str(DATA))
    reference = json.loads((folder / "reference.json").read_text())
    paths = [
        path
        for path in sorted(folder.glob("bal*/*.txt.bz2"))
        if path.name[: -len(".txt.bz2")] in reference
    ]
    assert len(paths) >= 10
    for path in paths:
        expected = reference[path.name[: -len(".txt.bz2")]]
        problem = read_problem(path)
        sizes = (problem.num_cameras, problem.num_points, problem.num_observations)
        assert sizes == (expected["cameras"], expected["points"], expected["observations"])
        assert float(_cost(problem)) == pytest.approx(expected["initial"], rel=1e-9), path.name


@needs_data
def test_real_problem_round_trips(tmp_path):
    problem = read_problem(Path(str(DATA)) / "bal" / "problem-49-7776-pre.txt.bz2")
    write_problem(problem, tmp_path / "a.txt")
    assert_same_bits(read_problem(tmp_path / "a.txt"), problem)


def _cost(problem: BundleProblem) -> np.ndarray:
    """The cost by a rotation matrix per camera from the matrix exponential's series: independent of
    the package."""
    cameras = np.asarray(problem.cameras)
    points = np.asarray(problem.points)
    x, y, z = cameras[:, :3].T / 1024
    zero = np.zeros_like(x)
    skew = np.array([[zero, -z, y], [z, zero, -x], [-y, x, zero]]).transpose(2, 0, 1)
    rotation = np.tile(np.eye(3), (len(cameras), 1, 1))
    term = np.eye(3)
    for order in range(1, 12):
        term = term @ skew / order
        rotation = rotation + term
    for _ in range(10):
        rotation = rotation @ rotation
    camera = cameras[problem.camera_index]
    seen = (
        np.einsum("nij,nj->ni", rotation[problem.camera_index], points[problem.point_index])
        + camera[:, 3:6]
    )
    projected = -seen[:, :2] / seen[:, 2:]
    square = np.sum(projected**2, axis=1)
    pixels = (camera[:, 6] * (1 + camera[:, 7] * square + camera[:, 8] * square**2))[
        :, None
    ] * projected
    return 0.5 * np.sum((pixels - problem.observations) ** 2)
