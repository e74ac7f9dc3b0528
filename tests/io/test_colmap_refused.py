"""COLMAP models whose structure is damaged are refused in one line."""

from __future__ import annotations

import struct
import tracemalloc

import numpy as np
import pytest
import support
from colmap_model import TextModel, head_with, noted, refusal, swap

from jaxba import BundleProblem, read_colmap, write_colmap


@pytest.fixture(scope="module")
def healthy(tmp_path_factory) -> BundleProblem:
    return noted(TextModel().write(tmp_path_factory.mktemp("healthy")))[0]


REFUSED = {
    "NaN pose": (head_with(1, "nan"), "images.txt: image 4 (view3.jpg): qvec is not finite: nan "),
    "NaN of Windows": (
        head_with(6, "-nan(ind)"),
        "images.txt: image 4 (view3.jpg): tvec is not finite: ",
    ),
    "overflowing pose": (
        head_with(7, "1e999"),
        "images.txt: image 4 (view3.jpg): tvec is not finite: ",
    ),
    "missing camera": (head_with(8, "8"), "images.txt: image 4 (view3.jpg): camera 8 is not in "),
    "word in a pose": (
        head_with(3, "1,5"),
        "images.txt line 8: image 4: '1,5' is not a number (qy)",
    ),
    "number with underscores": (
        head_with(5, "1_0"),
        "images.txt line 8: image 4: '1_0' is not a number (tx)",
    ),
    "id with a fraction": (
        head_with(0, "4.5"),
        "images.txt line 8: '4.5' is not an integer (IMAGE_ID)",
    ),
    "id below -1": (
        head_with(0, "-2"),
        "images.txt line 8: '-2' is outside 0..4294967295 (IMAGE_ID)",
    ),
    "id of nothing": (head_with(0, "-1"), "images.txt: 4294967295 is the id of no image"),
    "image twice": (head_with(0, "3"), "images.txt line 8: image 3: is there twice"),
    "cut line": (
        swap("images.txt", " view3.jpg", "x"),
        "images.txt line 8: image 4: '7x' is not a number (CAMERA_ID)",
    ),
    "unknown model": (
        swap("cameras.txt", "SIMPLE_RADIAL", "FISHEYE_2"),
        "cameras.txt line 2: camera 7: 'FISHEYE_2' is an unknown camera model",
    ),
    "another number of parameters": (
        swap("cameras.txt", "SIMPLE_RADIAL", "RADIAL"),
        "cameras.txt line 2: camera 7: RADIAL has 5 parameters, not 4",
    ),
    "negative focal length": (
        swap("cameras.txt", "700.0", "-700.0"),
        "cameras.txt: camera 7 has impossible parameters: -700, 640, 480, -0.03 (SIMPLE_RADIAL)",
    ),
    "point twice": (
        swap("points3D.txt", "\n12 ", "\n11 "),
        "points3D.txt: point 11 is there twice",
    ),
    "colour": (
        swap("points3D.txt", " 1 2 3 ", " 1 256 3 "),
        "points3D.txt line 2: point 11: '256' is outside 0..255 (green)",
    ),
    "half a pair": (
        swap("points3D.txt", " 0.5 ", " 0.5 1 "),
        "points3D.txt line 2: point 11: the track has ",
    ),
    "half a 16-bit text": (
        lambda folder: (folder / "images.txt").write_bytes(
            (folder / "images.txt").read_text().encode("utf-16")[:-1]
        ),
        "images.txt: is not the text that its byte order mark announces",
    ),
    "missing file": (lambda folder: (folder / "points3D.txt").unlink(), "points3D.txt is missing"),
    "folder for a file": (
        lambda folder: ((folder / "images.txt").unlink(), (folder / "images.txt").mkdir()),
        "images.txt is no file",
    ),
    "rigs without frames": (
        lambda folder: (folder / "rigs.txt").write_text("7 1 CAMERA 7\n"),
        "frames.txt is missing",
    ),
}


@pytest.mark.parametrize("damage", REFUSED)
def test_damage_of_the_structure_is_refused_in_one_line(tmp_path, damage):
    change, message = REFUSED[damage]
    folder = TextModel().write(tmp_path / "m")
    change(folder)
    assert refusal(folder).startswith(message)


def test_a_quaternion_of_zeros_is_refused_and_one_of_any_other_norm_is_not(tmp_path, healthy):
    for scale in (0.0, 1e-300, 1e-5, 3.0, 1e300):
        model = TextModel()
        identity, *quaternion, x, y, z, camera, name = model.heads[3].split()
        model.heads[3] = " ".join(
            [identity, *(str(scale * float(w)) for w in quaternion), x, y, z, camera, name]
        )
        folder = model.write(tmp_path / f"{scale}")
        if scale:
            np.testing.assert_allclose(
                read_colmap(folder).cameras, healthy.cameras, rtol=1e-12, atol=1e-13
            )
        else:
            assert (
                refusal(folder)
                == "images.txt: image 4 (view3.jpg): qvec is zero, which is no rotation"
            )


NAN = 0x7FF8 << 48  # the bits of a NaN
BINARY = {
    "no points at all": ("points3D.bin", 0, b"", "points3D.bin is empty"),
    "half a count": (
        "points3D.bin",
        0,
        b"\1\0\0",
        "points3D.bin is cut short in the number of points",
    ),
    "number of points": (
        "points3D.bin",
        0,
        2**63,
        f"points3D.bin is cut short: {2**63} points do not",
    ),
    "number of images": (
        "images.bin",
        0,
        2**64 - 1,
        f"images.bin is cut short: {2**64 - 1} images do not",
    ),
    "NaN pose": (
        "images.bin",
        12,
        NAN,
        "images.bin: image 1 (view0.jpg): qvec is not finite: nan ",
    ),
    "NaN lens": ("cameras.bin", 32, NAN, "cameras.bin: camera 7 has impossible parameters: nan,"),
    "number of cameras": (
        "cameras.bin",
        0,
        2**40,
        f"cameras.bin is cut short: {2**40} cameras do not",
    ),
    "one camera too many": ("cameras.bin", 0, 2, "cameras.bin is cut short in camera 2 of 2"),
    "length of a track": (
        "points3D.bin",
        51,
        2**60,
        "points3D.bin is cut short in the track of point 11",
    ),
    "key-points": (
        "images.bin",
        82,
        2**60,
        f"images.bin is cut short: the key-points of image 1 (view0.jpg) should have {2**60}",
    ),
    "model": (
        "cameras.bin",
        12,
        b"\x63\0\0\0",
        "cameras.bin: camera 7 has an unknown model, number 99",
    ),
    "point of no id": (
        "points3D.bin",
        8,
        2**64 - 1,
        f"points3D.bin: {2**64 - 1} is the id of no point",
    ),
    "no name ends": ("images.bin", 72, b"x" * 10**4, "images.bin"),
}


@pytest.mark.parametrize("damage", BINARY)
def test_counts_that_do_not_fit_are_refused_in_little_memory(tmp_path, damage):
    file, at, value, message = BINARY[damage]
    folder = TextModel().write_binary(tmp_path / "m")
    data = (folder / file).read_bytes()
    if isinstance(value, int):
        data = data[:at] + struct.pack("<Q", value) + data[at + 8 :]
    elif len(value) == 4:
        data = data[:at] + value + data[at + 4 :]
    else:
        data = data[:at] + value
    (folder / file).write_bytes(data)
    tracemalloc.start()
    assert refusal(folder).startswith(message)
    assert tracemalloc.get_traced_memory()[1] < 2**26
    tracemalloc.stop()


def test_every_cut_of_a_binary_file_is_refused(tmp_path):
    folder = tmp_path / "m"
    write_colmap(support.tiny(), folder)
    for file in ("cameras.bin", "frames.bin", "images.bin", "points3D.bin", "rigs.bin"):
        data = (folder / file).read_bytes()
        for end in [*range(0, min(150, len(data))), *range(150, len(data), 397)]:
            (folder / file).write_bytes(data[:end])
            assert refusal(folder).startswith((f"{file} is cut short", f"{file} is empty"))
        (folder / file).write_bytes(data + b"\0")
        assert refusal(folder).startswith(f"{file} is too long, by 1 byte after ")
        (folder / file).write_bytes(data)
    read_colmap(folder)
