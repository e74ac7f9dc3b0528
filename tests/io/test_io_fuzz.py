"""Whatever the bytes of a file are: a valid problem or a `ProblemError` of one line, and nothing
else."""

from __future__ import annotations

import bz2
import gzip
import json
import lzma
import warnings
from copy import deepcopy
from pathlib import Path

import numpy as np
import pytest
from foreign_scene import Lens, Scene, write_opensfm
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from jaxba.io import ProblemWarning, read_problem, write_problem
from jaxba.problem.bundle_problem import BundleProblem, ProblemError

BAL = b"2 3 4\n0 0 1.5 -2.5\n1 0 3.25 4e0\n0 1 -5 6\n1 2 .5 7.\n" + b"".join(
    b"%d.25\n" % i for i in range(27)
)
CAMERAS = (
    b"500.0 -0.1 0.01\n1 0 0\n0 1 0\n0 0 1\n0.1 0.2 0.3\n"
    b"600 0 0\n0 -1 0\n1 0 0\n0 0 1\n0.4 0.5 0.6\n0 0 0\n" + 4 * b"0 0 0\n"
)
POINTS = (
    b"1.0 2.0 -3.0\n255 0 7\n2 0 11 10.5 -20.5 1 12 30.5 40.5\n"
    b"4.0 5.0 -6.0\n0 0 0\n1 1 13 -1.5 1e1\n"
)
BUNDLER = b"# Bundle file v0.3\n3 2\n" + CAMERAS + POINTS
SEEDS = {"a.txt": BAL, "a.out": BUNDLER}
PACKERS = {
    "": bytes,
    ".bz2": bz2.compress,
    ".gz": lambda data: gzip.compress(data, mtime=0),
    ".xz": lzma.compress,
}
WORDS = [
    b"nan",
    b"-inf",
    b"1e999",
    b"1e308",
    b"1e200",
    b"1e-999",
    b"abc",
    b"",
    b"\0",
    b"\xff\xfe",
    b"-1",
    b"0",
    b"1.5",
    b"2147483647",
    b"1e18",
]
WORDS += [
    b"99999999999999999999",
    b"-",
    b"+",
    b".",
    b"1_0",
    b"0x10",
    b"1,5",
    b"\n",
    b"\x85",
    "\u0663".encode(),
    b"9" * 400,
]

fuzz = settings(
    deadline=None, max_examples=50, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


@st.composite
def damaged(draw: st.DrawFn, content: bytes) -> bytes:
    """The content after one to four flips, cuts, insertions, removals or exchanges of words."""
    for _ in range(draw(st.integers(1, 4))):
        at = draw(st.integers(0, max(0, len(content) - 1)))
        kind = draw(
            st.sampled_from(
                ["flip", "cut", "insert", "remove", "replace word", "swap words", "double"]
            )
        )
        words = content.split(b" ")
        word = draw(st.integers(0, len(words) - 1))
        if kind == "flip" and content:
            content = (
                content[:at] + bytes([content[at] ^ draw(st.integers(1, 255))]) + content[at + 1 :]
            )
        elif kind == "cut":
            content = content[:at]
        elif kind == "insert":
            content = (
                content[:at] + draw(st.sampled_from(WORDS) | st.binary(max_size=8)) + content[at:]
            )
        elif kind == "remove":
            content = content[:at] + content[at + draw(st.integers(1, 20)) :]
        elif kind == "replace word":
            words[word] = draw(st.sampled_from(WORDS))
            content = b" ".join(words)
        elif kind == "swap words":
            other = draw(st.integers(0, len(words) - 1))
            words[word], words[other] = words[other], words[word]
            content = b" ".join(words)
        else:
            content = content + content[at:]
    return content


def check(path: Path, content: bytes) -> None:
    """Reads the content from the path: a valid problem, which also round-trips, or a `ProblemError`
    of one line."""
    path.write_bytes(content)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.simplefilter("ignore", ProblemWarning)
        complaint = None
        problem = None
        try:
            problem = read_problem(path)
        except ProblemError as error:
            complaint = str(error)
        if problem is None:
            assert complaint is not None
            assert complaint.isprintable()
            assert path.name in complaint
            return
        arrays = (
            problem.cameras,
            problem.points,
            problem.observations,
            problem.camera_index,
            problem.point_index,
        )
        again = BundleProblem.create(*arrays)
        copy = path.with_name("copy.txt")
        write_problem(again, copy)
        np.testing.assert_array_equal(read_problem(copy).cameras, problem.cameras)


@fuzz
@given(data=st.data(), block=st.sampled_from([3, 17, 4096]))
@pytest.mark.parametrize("name", SEEDS)
def test_damaged_text_is_refused_or_still_a_problem(tmp_path, monkeypatch, name, data, block):
    monkeypatch.setattr("jaxba.io.text.BLOCK_BYTES", block)
    check(tmp_path / name, data.draw(damaged(SEEDS[name])))


@fuzz
@given(data=st.data())
@pytest.mark.parametrize("suffix", [".bz2", ".gz", ".xz"])
@pytest.mark.parametrize("name", SEEDS)
def test_damaged_compressed_bytes_are_refused_or_still_a_problem(tmp_path, name, suffix, data):
    check(tmp_path / (name + suffix), data.draw(damaged(PACKERS[suffix](SEEDS[name]))))


@fuzz
@given(data=st.data())
@pytest.mark.parametrize("suffix", [".bz2", ".gz", ".xz"])
@pytest.mark.parametrize("name", SEEDS)
def test_damaged_text_under_compression_is_refused_or_still_a_problem(tmp_path, name, suffix, data):
    check(tmp_path / (name + suffix), PACKERS[suffix](data.draw(damaged(SEEDS[name]))))


def foreign_seed(folder: Path, model: str = "brown") -> Path:
    """A file of OpenSfM; tracks are beside it."""
    return write_opensfm(
        folder, Scene([Lens(radial=(-0.1, 0.02, 0.01))], [0, 0, 0]), [model], version=1
    )


WRONG = [None, True, 0, -1, 1.5, 1e308, 1e200, 1e-300, 10**30]
WRONG += [float("nan"), float("inf"), "", "nan", "1e999", "\u0663", "x\n"]
WRONG += [[], {}, [[]], [1], {"key": 0}, [0, 0], [1.0, 2.0, 3.0], 2**31, 2**32 - 1, 2**53, -(2**63)]


@st.composite
def mutated(draw: st.DrawFn, value: object) -> object:
    """A JSON document after one to three replacements, removals or doublings of values at any
    depth."""
    value = json.loads(json.dumps(value))
    for _ in range(draw(st.integers(1, 3))):
        above = None
        key = None
        here = value
        for _ in range(draw(st.integers(1, 9))):
            if not (isinstance(here, (dict, list)) and here):
                break
            above = here
            key = draw(st.sampled_from(list(here) if isinstance(here, dict) else range(len(here))))
            here = above[key]
        if above is None:
            continue
        kind = draw(st.sampled_from(["replace", "replace", "remove", "double", "swap"]))
        if kind == "replace":
            above[key] = deepcopy(draw(st.sampled_from(WRONG) | st.floats() | st.integers()))
        elif kind == "remove":
            del above[key]
        elif kind == "double" and isinstance(above, list):
            above.append(json.loads(json.dumps(here)))
        elif isinstance(above, dict):
            other = draw(st.sampled_from(list(above)))
            above[key], above[other] = above[other], above[key]
    return value


def check_foreign(path: Path) -> None:
    """A valid problem of finite numbers or a `ProblemError` of one line, and no warning but those
    of readers."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.simplefilter("ignore", ProblemWarning)
        complaint = None
        problem = None
        try:
            problem = read_problem(path)
        except ProblemError as error:
            complaint = str(error)
    if problem is None:
        assert complaint is not None
        assert complaint.isprintable()
        assert str(path.parent) in complaint
        return
    assert all(
        np.isfinite(np.asarray(part)).all()
        for part in (problem.cameras, problem.points, problem.observations)
    )
    assert problem.whitening is None or np.isfinite(np.asarray(problem.whitening)).all()


@fuzz
@given(data=st.data())
@pytest.mark.parametrize("model", ["brown", "radial", "perspective"])
def test_mutated_json_is_refused_or_still_a_problem(tmp_path, model, data):
    path = foreign_seed(tmp_path, model)
    path.write_text(json.dumps(data.draw(mutated(json.loads(path.read_text())))))
    check_foreign(path)


@fuzz
@given(data=st.data())
@pytest.mark.parametrize("name", ["reconstruction.json", "tracks.csv"])
def test_damaged_bytes_of_json_and_tracks_are_refused_or_still_a_problem(tmp_path, name, data):
    path = foreign_seed(tmp_path)
    target = tmp_path / name
    target.write_bytes(data.draw(damaged(target.read_bytes())))
    check_foreign(path)


@fuzz
@given(
    content=st.binary(max_size=200),
    name=st.sampled_from(["a.txt", "a.out", "a.txt.gz", "a.bz2", "a.out.xz", "a.json"]),
)
def test_random_bytes_are_refused(tmp_path, content, name):
    check(tmp_path / name, content)


@fuzz
@given(
    gaps=st.lists(st.text(" \t\n\r\v\f", min_size=1, max_size=4), min_size=46, max_size=46),
    block=st.integers(1, 99),
)
def test_any_layout_of_whitespace_reads_the_same(tmp_path, monkeypatch, gaps, block):
    monkeypatch.setattr("jaxba.io.text.BLOCK_BYTES", block)
    words = BAL.decode().split()
    path = tmp_path / "a.txt"
    path.write_bytes("".join(gap + word for gap, word in zip(gaps, words, strict=True)).encode())
    found = read_problem(path)
    path.write_bytes(BAL)
    expected = read_problem(path)
    np.testing.assert_array_equal(found.cameras, expected.cameras)
    np.testing.assert_array_equal(found.points, expected.points)
    np.testing.assert_array_equal(found.observations, expected.observations)
    np.testing.assert_array_equal(found.camera_index, expected.camera_index)


@fuzz
@given(values=st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=14, max_size=14))
def test_every_finite_number_round_trips_bit_by_bit(tmp_path, values):
    problem = BundleProblem.create([values[:9]], [values[9:12]], [values[12:]], [0], [0])
    write_problem(problem, tmp_path / "a.txt")
    found = read_problem(tmp_path / "a.txt")
    for name in ("cameras", "points", "observations"):
        assert (
            np.asarray(getattr(found, name)).tobytes()
            == np.asarray(getattr(problem, name)).tobytes()
        )
