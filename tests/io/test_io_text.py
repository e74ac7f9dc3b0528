"""Text as other programs and editors write it, in every text reader; and what is implausible in
it."""

from __future__ import annotations

import numpy as np
import pytest
import support

from jaxba import write_bal
from jaxba.io import ProblemWarning, read_problem, write_bundler, write_problem
from jaxba.io.decimals import number
from jaxba.problem import geometry
from jaxba.problem.bundle_problem import BundleProblem, ProblemError
from jaxba.settings import configurations

ENCODINGS = {
    "UTF-8": lambda text: b"\xef\xbb\xbf" + text.encode(),
    "UTF-16 of Windows": lambda text: b"\xff\xfe" + text.encode("utf-16-le"),
    "UTF-16, big end first": lambda text: b"\xfe\xff" + text.encode("utf-16-be"),
    "UTF-32": lambda text: b"\xff\xfe\0\0" + text.encode("utf-32-le"),
}
LAYOUTS = {
    "Windows": lambda text: text.replace("\n", "\r\n"),
    "old Mac": lambda text: text.replace("\n", "\r"),
    "blanks and blank lines at ends": lambda text: text.replace("\n", " \t\n") + "\n \n\t\r\n\n",
    "no line end at the end": lambda text: text.rstrip("\n"),
    "Fortran": lambda text: text.replace("e-", "D-").replace("e+", "d+"),
}


@pytest.fixture(params=[".txt", ".out"])
def file(request, tmp_path):
    """A problem whose numbers have exponents, as a BAL file and as a Bundler model."""
    problem = support.tiny()
    path = tmp_path / f"a{request.param}"
    cameras = np.array(problem.cameras)
    cameras[:, 7:] = [1.25e-7, -3e-20]
    write_problem(problem.replace(cameras=cameras, points=1e20 * np.asarray(problem.points)), path)
    return path


def same(one: BundleProblem, other: BundleProblem) -> None:
    for left, right in zip(support.arrays(one), support.arrays(other), strict=True):
        np.testing.assert_array_equal(left, right)


@pytest.mark.parametrize("block", [3, 1 << 20])
@pytest.mark.parametrize("encoding", ENCODINGS)
def test_byte_order_marks_change_nothing(file, monkeypatch, encoding, block):
    expected = read_problem(file)
    file.write_bytes(ENCODINGS[encoding](file.read_text()))
    monkeypatch.setattr("jaxba.io.text.BLOCK_BYTES", block)
    same(read_problem(file), expected)


@pytest.mark.parametrize("block", [7, 1 << 20])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_the_layout_of_lines_and_the_letter_of_exponents_change_nothing(
    file, monkeypatch, layout, block
):
    expected = read_problem(file)
    text = file.read_text()
    assert layout != "Fortran" or "e-" in text
    file.write_bytes(LAYOUTS[layout](text).encode())
    monkeypatch.setattr("jaxba.io.text.BLOCK_BYTES", block)
    same(read_problem(file), expected)


@pytest.mark.parametrize(
    "ending", [".TXT", ".Bal", ".OUT", ".TXT.BZ2", ".out.GZ", ".Out.Xz", "", ".5"]
)
def test_endings_in_upper_case_are_those_in_lower_case(tmp_path, ending):
    write_problem(support.tiny(), tmp_path / f"a{ending}")
    data = (tmp_path / f"a{ending}").read_bytes()
    starts = {".bz2": b"BZh", ".gz": b"\x1f\x8b", ".xz": b"\xfd7zXZ", ".out": b"# Bundle"}
    last = "." + ending.lower().rpartition(".")[2]
    assert data.startswith(starts.get(last, data[:1]))
    assert read_problem(tmp_path / f"a{ending}").num_cameras == support.tiny().num_cameras


@pytest.mark.parametrize(
    "word",
    ["nan", "-nan", "-nan(ind)", "nan(0x1)", "1.#QNAN", "-1.#IND00", "1.#INF", "+Infinity", "inf"],
)
def test_numbers_that_are_not_finite_are_known_as_such_in_every_spelling(file, word):
    for at in (-1, 20):
        lines = file.read_text().split("\n")
        lines = [line for line in lines if line]
        words = lines[at].split(" ")
        words[-1] = word
        lines[at] = " ".join(words)
        copy = file.with_name("b" + file.suffix)
        copy.write_text("\n".join(lines) + "\n")
        with pytest.raises(ProblemError, match=r" is not a finite number \(") as caught:
            read_problem(copy)
        assert f"{word!r} is not a finite number" in str(caught.value)
        assert f"line {at % len(lines) + 1}:" in str(caught.value)
    assert np.isnan(number(word))


@pytest.mark.parametrize(
    "word",
    [
        "",
        "1_0",
        "0x10",
        "1,5",
        "\u0663",
        "1d",
        "d5",
        "1.#",
        "1.#QNANX",
        "nanx",
        "na",
        "--1",
        "1e5e5",
    ],
)
def test_other_words_are_no_numbers(word):
    with pytest.raises(ValueError, match="is no number"):
        number(word)


def test_text_that_breaks_off_in_its_encoding_is_refused(file):
    file.write_bytes(b"\xff\xfe" + file.read_text().encode("utf-16-le")[:-1])
    with pytest.raises(ProblemError, match="is not the text that its byte order mark announces"):
        read_problem(file)


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_configurations_may_have_byte_order_marks(tmp_path, encoding):
    path = tmp_path / "A.YAML"
    path.write_bytes(ENCODINGS[encoding]("seed: 3\r\nlast: 1\r\n"))
    assert configurations.read("train", str(path)) == {"seed": 3, "last": 1}


# Bundler's format written


def test_a_written_bundler_model_is_the_same_problem(tmp_path):
    problem = support.tiny()
    write_bundler(problem, tmp_path / "a.out")
    found = read_problem(tmp_path / "a.out")
    order = np.argsort(problem.point_index, kind="stable")
    for name in ("observations", "camera_index", "point_index"):
        np.testing.assert_array_equal(
            getattr(found, name), np.asarray(getattr(problem, name))[order]
        )
    np.testing.assert_array_equal(found.points, problem.points)
    np.testing.assert_array_equal(
        np.asarray(found.cameras)[:, 3:], np.asarray(problem.cameras)[:, 3:]
    )
    np.testing.assert_allclose(found.cameras, problem.cameras, rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(geometry.cost(found), geometry.cost(problem), rtol=1e-11)


def test_a_written_bundler_model_follows_the_manual(tmp_path):
    """Lines as the manual of Bundler describes them; a camera turned by 90 degrees about z."""
    camera = [0, 0, np.pi / 2, 1, 2, 3, 500, -0.1, 0.01]
    problem = BundleProblem.create(
        [camera], [[4, 5, -6], [7, 8, -9]], [[1.5, -2], [3, 4]], [0, 0], [1, 0]
    )
    write_bundler(problem, tmp_path / "a.out")
    lines = (tmp_path / "a.out").read_text().splitlines()
    assert lines[:3] == ["# Bundle file v0.3", "1 2", "500.0 -0.1 0.01"]
    np.testing.assert_allclose(
        [list(map(float, row.split())) for row in lines[3:6]],
        [[0, -1, 0], [1, 0, 0], [0, 0, 1]],
        atol=1e-15,
    )
    assert lines[6:10] == ["1.0 2.0 3.0", "4.0 5.0 -6.0", "192 192 192", "1 0 1 3.0 4.0"]
    assert lines[10:] == ["7.0 8.0 -9.0", "192 192 192", "1 0 0 1.5 -2.0"]


def test_what_bundler_s_format_cannot_say_is_not_written(tmp_path):
    camera = np.array([[0, 0, 0, 0, 0, 0, 0.0, 0, 0]])
    problem = BundleProblem.create(camera, [[0, 0, -1.0]], [[0, 0.0]], [0], [0])
    with pytest.raises(ProblemError, match="camera 0 has focal length 0"):
        write_bundler(problem, tmp_path / "a.out")
    assert not list(tmp_path.iterdir())


# What is implausible


@pytest.mark.parametrize("ending", [".txt", ".out"])
@pytest.mark.parametrize("flip", [1, -1])
def test_pixels_from_a_corner_are_noted(tmp_path, ending, flip):
    problem = support.tiny()
    pixels = np.asarray(problem.observations)
    shifted = (pixels - pixels.min(axis=0)) * [1, flip]
    write_problem(problem.replace(observations=shifted), tmp_path / f"a{ending}")
    with pytest.warns(
        ProblemWarning,
        match=rf"a{ending}: pixels seem to be measured from a corner of the image \(x in 0",
    ):
        read_problem(tmp_path / f"a{ending}")


def test_centred_pixels_are_not_noted(tmp_path):
    write_bal(support.tiny(), tmp_path / "a.txt")
    read_problem(tmp_path / "a.txt")  # warnings are errors
