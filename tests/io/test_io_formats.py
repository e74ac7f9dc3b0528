"""Which format a name stands for, what is refused, and that messages name what is known."""

from __future__ import annotations

import io
import shutil
import tarfile

import numpy as np
import pytest
import support
from foreign_scene import Lens, Scene, write_opensfm

from jaxba.cli.solve import run
from jaxba.io import check_output, formats, read_problem, write_colmap, write_problem
from jaxba.problem.bundle_problem import ProblemError

WRITTEN = (
    "written are .txt, .bal (BAL), .out (Bundler), .ply (PLY), .json (nerfstudio's cameras), "
    "each also with .gz, .bz2 or .xz"
)


@pytest.mark.parametrize(
    "name", ["a.nvm", "a.zip", "a.SFM", "a.abc", "a.nvm.gz", "a.npz", "a.mat", "a.tar.gz"]
)
def test_endings_of_other_formats_are_not_written(name, tmp_path):
    with pytest.raises(ProblemError, match="are not written; ") as caught:
        write_problem(support.tiny(), tmp_path / name)
    assert WRITTEN in str(caught.value)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "name",
    [
        "a",
        "a.txt",
        "a.BAL",
        "a.OUT.xz",
        "a.ply",
        "a.json",
        "a.5",
        "/dev/stdout",
        "a.b.txt",
        "json",
        "a.txt.bz2",
    ],
)
def test_other_names_may_be_written(name):
    check_output(name)


@pytest.fixture
def tiny(tmp_path):
    path = tmp_path / "tiny.out"
    write_problem(support.tiny(), path)
    return path


@pytest.mark.parametrize("name", ["solved.nvm", "solved.sfm", "solved.zip"])
def test_an_output_of_another_format_is_refused_before_any_work(tiny, capsys, name):
    missing = tiny.with_name("missing.out")
    assert run([str(missing), "--output", str(tiny.with_name(name))]) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.count("\n") == 1
    assert WRITTEN in printed.err
    assert "missing" not in printed.err
    assert [path.name for path in tiny.parent.iterdir()] == ["tiny.out"]


def test_a_model_goes_from_bundler_to_bundler(tiny, capsys):
    assert (
        run([str(tiny), "--output", str(tiny.with_name("solved.OUT.GZ")), "--max-iterations", "2"])
        == 0
    )
    assert "note" not in capsys.readouterr().out
    solved = read_problem(tiny.with_name("solved.OUT.GZ"))
    assert solved.num_observations == support.tiny().num_observations


def test_a_name_whose_ending_says_nothing_is_bal_and_that_is_said(tiny, capsys):
    assert (
        run([str(tiny), "--output", str(tiny.with_name("solved.v5")), "--max-iterations", "1"]) == 0
    )
    assert "solved.v5 is a BAL file; written are" in capsys.readouterr().out


def test_what_readers_remark_is_printed_as_notes(tmp_path, capsys):
    path = write_opensfm(tmp_path, Scene([Lens(cx=0.0)], [0, 0, 0]), ["simple_radial"])
    assert run([str(path), "--max-iterations", "1", "--output", str(tmp_path / "a.txt")]) == 0
    printed = capsys.readouterr()
    assert printed.out.startswith(
        f"note: {path}: the principal point of camera v2 maker 0 lies at the edge"
    )
    assert (
        "note: that file cannot store: which images share a lens, which numbers of a lens are"
        in printed.out
    )
    assert printed.err == ""


def test_what_is_remarked_is_refused_if_asked(tmp_path):
    path = write_opensfm(tmp_path, Scene([Lens(cx=0.0)], [0, 0, 0]), ["simple_radial"])
    with pytest.raises(
        ProblemError, match=r"reconstruction\.json: the principal point of camera v2 maker 0 lies"
    ):
        read_problem(path, strict=True)
    assert run([str(path), "--strict", "--output", str(tmp_path / "a.txt")]) == 2
    assert not (tmp_path / "a.txt").exists()


@pytest.mark.parametrize("name", ["model", "model.txt", "model.dat"])
def test_a_file_is_recognised_by_its_first_bytes_where_the_name_says_nothing(tmp_path, name):
    scene = Scene([Lens(cx=800.0, cy=600.0)], [0, 0, 0])
    json = read_problem(write_opensfm(tmp_path, scene, ["perspective"]))
    plain = support.tiny()
    write_problem(plain, tmp_path / "a.out")
    for source, expected in (("reconstruction.json", json), ("a.out", plain)):
        shutil.copy(tmp_path / source, tmp_path / name)
        np.testing.assert_allclose(read_problem(tmp_path / name).points, expected.points)


@pytest.mark.parametrize(
    "content",
    [b"\x89HDF\r\n", b"ply\nformat ascii 1.0\n", b"<xml/>", b"cameras 3\n", bytes(range(256))],
)
def test_what_is_not_read_names_what_is(tmp_path, content):
    path = tmp_path / "a.bin"
    path.write_bytes(content)
    with pytest.raises(ProblemError) as caught:
        read_problem(path)
    assert str(caught.value).isprintable()
    assert formats.formats_read() in str(caught.value)
    for name in ("BAL", "Bundler", "OpenSfM", "COLMAP"):
        assert name in str(caught.value)


def _tar(mode):
    file = io.BytesIO()
    with tarfile.open(fileobj=file, mode=mode) as archive:
        archive.addfile(tarfile.TarInfo("model/images.txt"), io.BytesIO())
    return file.getvalue()


OTHERS = [
    ("cameras.bin", lambda: bytes(64), "give the folder that holds it, "),
    (
        "points3D.txt",
        lambda: b"# 3D point list with one line of data per point:\n",
        "give the folder of the model",
    ),
    (
        "renamed.txt",
        lambda: b"# Image list with two lines of data per image:\n1 1 0 0 0 0 0 0 1 a\n",
        "a COLMAP model",
    ),
    ("database.db", lambda: b"SQLite format 3\0" + bytes(100), "a COLMAP data base (SQLite)"),
    ("renamed.out", lambda: b"SQLite format 3\0" + bytes(100), "a COLMAP data base (SQLite)"),
    ("a.zip", lambda: b"PK\x03\x04" + bytes(40), "an archive: unpack it"),
    ("a.tar", lambda: _tar("w"), "an archive: unpack it"),
    ("a.tar.gz", lambda: _tar("w:gz"), "an archive: unpack it"),
    ("a.tgz", lambda: _tar("w:gz"), "an archive: unpack it"),
    (
        "transforms.json",
        lambda: b'{"fl_x": 1, "frames": [{"transform_matrix": []}]}',
        "nerfstudio's transforms.json",
    ),
    ("a.npz", lambda: b"PK\x03\x04" + bytes(40), "an archive"),
    (
        "000000.png",
        lambda: b"\x89PNG\r\n\x1a\n" + bytes(40),
        "a binary file of no format that is known here; read are",
    ),
    (
        "problem.html",
        lambda: b"<!DOCTYPE html>\n<html></html>",
        "'<!DOCTYPE' is not a number",
    ),
    ("points.xyz", lambda: b"0.5 1 2\n", "files with .xyz are not read; read are BAL"),
]


@pytest.mark.parametrize(
    ("name", "content", "message"), OTHERS, ids=[name for name, _, _ in OTHERS]
)
def test_a_file_of_another_program_is_named_for_what_it_is(name, content, message, tmp_path):
    path = tmp_path / name
    path.write_bytes(content())
    with pytest.raises(ProblemError) as caught:
        read_problem(path)
    assert message in str(caught.value)
    assert str(caught.value).startswith(str(path))
    assert str(caught.value).isprintable()
    assert "\\x" not in str(caught.value)


def test_a_file_of_a_model_names_the_folder_to_give(tmp_path):
    write_colmap(support.tiny(), tmp_path / "model")
    with pytest.raises(
        ProblemError, match=r"a file of a COLMAP model: give the folder that holds it, .*model$"
    ):
        read_problem(tmp_path / "model" / "images.bin")


def test_a_point_cloud_is_not_read(tmp_path):
    write_problem(support.tiny(), tmp_path / "a.ply")
    with pytest.raises(ProblemError, match="PLY is only written; read are BAL"):
        read_problem(tmp_path / "a.ply")


def test_errors_in_a_bal_file_stay_what_they_are(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("1 1 1\n0 0 x 2\n")
    with pytest.raises(ProblemError) as caught:
        read_problem(path)
    assert str(caught.value) == f"{path} line 2: 'x' is not a number (x of observation 0)"
