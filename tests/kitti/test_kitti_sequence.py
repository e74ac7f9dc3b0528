"""Sequence folders: what is read, and that everything wrong with one is said in a line."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from jaxba.io.frames import Calibration, Poses, poses_of, read_poses
from jaxba.kitti.sequence import read_calibration, read_sequence
from jaxba.problem.bundle_problem import ProblemError

DATA = os.environ.get("JAXBA_DATA")
needs_data = pytest.mark.skipif(DATA is None, reason="JAXBA_DATA names no folder of real problems")

CALIBRATION = """P0: 700 0 600.5 0 0 700 180.25 0 0 0 1 0
P1: 700 0 600.5 -350 0 700 180.25 0 0 0 1 0
Tr: 1 0 0 0 0 1 0 0 0 0 1 0
"""


@pytest.fixture
def folder(tmp_path) -> Path:
    """A sequence of ten empty images, numbered from 5."""
    (tmp_path / "image_0").mkdir()
    for number in range(5, 15):
        (tmp_path / "image_0" / f"{number:06d}.png").touch()
    (tmp_path / "calib.txt").write_text(CALIBRATION)
    return tmp_path


def test_frames_carry_the_numbers_of_their_files(folder):
    sequence = read_sequence(folder, "6:12:2")
    assert sequence.numbers == (6, 8, 10)
    assert [path.name for path in sequence.images] == ["000006.png", "000008.png", "000010.png"]
    assert sequence.calibration == Calibration(700.0, 700.0, 600.5, 180.25)
    assert read_sequence(folder).numbers == tuple(range(5, 15))


def test_the_second_camera_stands_beside_the_first(folder):
    """`P1 = K [I | b]` maps a point X of camera 0 to K (X + b): camera 1 stands at -b."""
    calibration = read_calibration(folder, 1)
    assert calibration.offset == pytest.approx((-0.5, 0, 0))
    # x of the camera is -z of the world
    turned = np.array([[0.0, 0, 1, 10], [0, 1, 0, 20], [-1, 0, 0, 30]])[None]
    poses = Poses(turned, "poses")
    np.testing.assert_allclose(poses_of(poses, (0,), calibration)[0, :, 3], [10, 20, 29.5])


def test_a_matrix_alone_is_a_calibration(folder):
    (folder / "calib.txt").unlink()
    (folder / "K.txt").write_text("7.1e2 0 6.0e2\n0 7.2e2 1.8e2\n0 0 1\n")
    assert read_sequence(folder).calibration == Calibration(710.0, 720.0, 600.0, 180.0)


def test_a_byte_order_mark_is_no_trouble(folder):
    (folder / "calib.txt").write_text(CALIBRATION, encoding="utf-8-sig")
    assert read_sequence(folder).calibration == Calibration(700.0, 700.0, 600.5, 180.25)


def test_rays_of_pixels_are_the_inverse_of_the_matrix():
    calibration = Calibration(700.0, 650.0, 600.0, 180.0)
    place = np.array([0.3, -0.2, 2.0])
    pixel = np.array([[700.0, 0.0, 600.0], [0.0, 650.0, 180.0], [0.0, 0.0, 1.0]]) @ place
    np.testing.assert_allclose(
        calibration.rays(pixel[None, :2] / pixel[2])[0], place[:2] / place[2]
    )


@pytest.mark.parametrize(
    ("frames", "words"),
    [
        ("0:200", "ends after the last frame, 14"),
        ("7:8", "leaves 1 of frames 5 to 14"),
        ("0:4", "leaves 0 of frames 5 to 14"),
        ("12:6", "leaves 0"),
        ("abc", "must be first:end"),
        ("-3:5", "must be first:end"),
        ("0:5:0", "must be first:end"),
        ("5", "must be first:end"),
    ],
)
def test_a_range_outside_of_the_sequence_is_refused(folder, frames, words):
    with pytest.raises(ProblemError, match=words):
        read_sequence(folder, frames)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("P1: 1 2 3\n", "no line P0"),
        ("P0: 1 2 3\n", "P0: has 3 numbers instead of 12"),
        (CALIBRATION.replace("700", "seven", 1), "P0: 'seven' is not a number"),
        (CALIBRATION.replace("700", "nan", 1), "not a finite number"),
        (CALIBRATION.replace("700", "-700", 1), "is not"),
        (CALIBRATION.replace("700 0", "700 3", 1), "is not"),
        ("1 2\n", "has 2 numbers"),
        ("", "neither lines"),
    ],
)
def test_a_malformed_calibration_is_refused(folder, text, words):
    (folder / "calib.txt").write_text(text)
    with pytest.raises(ProblemError, match=rf"calib\.txt.*{words}") as caught:
        read_sequence(folder)
    assert "\n" not in str(caught.value)


def test_what_is_missing_is_named(folder, tmp_path):
    with pytest.raises(ProblemError, match="no such folder"):
        read_sequence(tmp_path / "nowhere")
    with pytest.raises(ProblemError, match="has no folder image_2"):
        read_sequence(folder, camera=2)
    (folder / "image_1").mkdir()
    with pytest.raises(ProblemError, match="image_1: holds no images"):
        read_sequence(folder, camera=1)
    (folder / "calib.txt").unlink()
    with pytest.raises(ProblemError, match="has no calibration"):
        read_sequence(folder)
    with pytest.raises(ProblemError, match=r"cannot read .*: No such file"):
        read_sequence(folder, calibration=folder / "other.txt")


def test_an_image_without_a_number_is_refused(folder):
    (folder / "image_0" / "first.png").touch()
    (folder / "image_0" / ".second.png").touch()
    with pytest.raises(
        ProblemError, match=r"first\.png: the name of an image must be its frame's number"
    ):
        read_sequence(folder)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "holds no poses"),
        ("1 0 0 0 0 1 0 0 0 0 1\n", "line 1: has 11 numbers instead of 12"),
        (
            "1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0 0 0 2 0 0 0 0 1 0\n",
            "line 2: the left 3 x 3 numbers are no rotation",
        ),
        ("1 0 0 0 0 1 0 0 0 0 -1 0\n", "are no rotation"),
        ("1 0 0 0 0 1 0 0 0 0 1 x\n", "not a number"),
    ],
)
def test_malformed_poses_are_refused(tmp_path, text, words):
    path = tmp_path / "poses.txt"
    path.write_text(text)
    with pytest.raises(ProblemError, match=words):
        read_poses(path)


def test_poses_are_read_row_by_row_and_made_exact(tmp_path):
    path = tmp_path / "poses.txt"
    path.write_text("0 0 1 5 0 1 0 6 -1 0 0 7\n" * 3)
    poses = read_poses(path)
    np.testing.assert_allclose(
        poses.matrices[1], [[0, 0, 1, 5], [0, 1, 0, 6], [-1, 0, 0, 7]], atol=1e-15
    )
    with pytest.raises(ProblemError, match="has 3 poses, none for frame 3"):
        poses_of(poses, (1, 3), Calibration(1.0, 1.0, 0.0, 0.0))


# Layouts of other releases and habits of other programs


def test_hidden_files_are_no_images(folder):
    for name in ("._000005.png", ".000099.png", "._notes.jpg"):
        (folder / "image_0" / name).write_bytes(b"Mac OS X")
    assert read_sequence(folder).numbers == tuple(range(5, 15))


def test_a_folder_of_hidden_files_holds_no_images(folder):
    (folder / "image_1").mkdir()
    (folder / "image_1" / "._000005.png").touch()
    with pytest.raises(
        ProblemError, match=r"image_1: holds no images .*; images are in image_0: use --camera 0$"
    ):
        read_sequence(folder, camera=1)


def test_where_only_coloured_images_are_there_the_option_is_named(folder):
    (folder / "image_0").rename(folder / "image_2")
    with pytest.raises(ProblemError, match=r"image_0; images are in image_2: use --camera 2$"):
        read_sequence(folder)
    (folder / "image_2").rename(folder / "image_3")
    with pytest.raises(ProblemError, match=r"; images are in image_3: use --camera 3$"):
        read_sequence(folder)


BARE = "700 0 600.5 0 0 700 180.25 0 0 0 1 0\n700 0 600.5 -350 0 700 180.25 0 0 0 1 0\n"


@pytest.mark.parametrize(
    "change", [lambda text: text, lambda text: "\ufeff" + text.replace("\n", "\r\n\r\n")]
)
def test_bare_rows_of_twelve_numbers_are_the_cameras_from_the_left_grey_one(folder, change):
    (folder / "calib.txt").write_bytes(change(BARE).encode())
    assert read_calibration(folder, 0) == Calibration(700.0, 700.0, 600.5, 180.25)
    assert read_calibration(folder, 1).offset == pytest.approx((-0.5, 0, 0))
    with pytest.raises(ProblemError, match="has 2 lines of 12 numbers, none for camera 2"):
        read_calibration(folder, 2)


def test_a_matrix_of_three_rows_of_four_is_a_calibration(folder):
    (folder / "calib.txt").write_text("7.0D+02 0 600.5 -350\n0 700 180.25 0\n0 0 1 0\n")
    assert read_calibration(folder) == Calibration(700.0, 700.0, 600.5, 180.25, (-0.5, 0.0, 0.0))


IDENTITY = "1 0 0 5 0 1 0 6 0 0 1 7"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (f"1 {IDENTITY}", "line 1: has 13 numbers instead of 12"),
        (f"{IDENTITY}\n\n{IDENTITY} x", "line 3: 'x' is not a number"),
        (
            f"{IDENTITY}\n\n{IDENTITY.replace('7', '-nan(ind)')}",
            r"line 3: '-nan\(ind\)' is not a finite number",
        ),
        (f"{IDENTITY}\n{IDENTITY.replace('7', '1_0')}", "line 2: '1_0' is not a number"),
    ],
)
def test_malformed_poses_are_refused_by_the_line_of_the_file(tmp_path, text, words):
    path = tmp_path / "poses.txt"
    path.write_text(text)
    with pytest.raises(ProblemError, match=rf"poses\.txt:? ?{words}"):
        read_poses(path)


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_byte_order_marks_are_no_trouble_in_poses(folder, encoding):
    (folder / "poses.txt").write_text(f"{IDENTITY}\r{IDENTITY}\r", encoding=encoding, newline="")
    assert len(read_poses(folder / "poses.txt").matrices) == 2


@needs_data
def test_the_real_sequence_has_200_frames_and_poses_for_each():
    assert DATA is not None
    root = Path(DATA) / "kitti"
    sequence = read_sequence(root / "seq00", "0:200")
    assert len(sequence) == 200
    assert sequence.calibration.fx == pytest.approx(718.856)
    poses = poses_of(read_poses(root / "poses" / "00.txt"), sequence.numbers, sequence.calibration)
    turn = poses[:, :, :3] @ poses[:, :, :3].transpose(0, 2, 1)
    np.testing.assert_allclose(turn, np.broadcast_to(np.eye(3), turn.shape), atol=1e-14)
