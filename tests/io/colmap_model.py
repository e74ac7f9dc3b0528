"""A small COLMAP model as lines of text, written by hand here and not by the package, so that tests
can damage it."""

from __future__ import annotations

import struct
import warnings
from pathlib import Path

import numpy as np
import pytest
import support
from scipy.spatial.transform import Rotation

from jaxba import BundleProblem, ProblemError, ProblemWarning, read_colmap
from jaxba.problem import geometry

LENS = (700.0, 640.0, 480.0, -0.03)
FIRST_POINT = 11  # ids of points count from here, those of images from 1, and of the camera it is 7


class TextModel:
    """Lines of the files, without their ends. One SIMPLE_RADIAL camera, six images, forty
    points."""

    def __init__(self) -> None:
        scene = support.tiny()
        cameras = scene.cameras.copy()
        cameras[:, 6:] = LENS[0], LENS[3], 0.0
        self.scene = scene.replace(cameras=cameras)
        pixels = geometry.project(self.scene) * [1, -1] + LENS[1:3]
        flip = np.diag([1.0, -1.0, -1.0])
        quaternions = Rotation.from_matrix(
            flip @ geometry.rotation_matrices(cameras[:, :3])
        ).as_quat()[:, [3, 0, 1, 2]]
        keys = [np.flatnonzero(scene.camera_index == image) for image in range(6)]
        place = {
            int(view): (image + 1, k) for image, of in enumerate(keys) for k, view in enumerate(of)
        }
        self.cameras = ["# cameras", "7 SIMPLE_RADIAL 1280 960 " + " ".join(map(str, LENS))]
        self.heads = [
            " ".join(
                map(
                    str,
                    [
                        image + 1,
                        *quaternions[image].tolist(),
                        *(flip @ cameras[image, 3:6]).tolist(),
                        7,
                    ],
                )
            )
            + f" view{image}.jpg"
            for image in range(6)
        ]
        self.keys = [
            [
                [*map(str, pixels[view].tolist()), str(scene.point_index[view] + FIRST_POINT)]
                for view in of
            ]
            for of in keys
        ]
        self.points = []
        for point, position in enumerate(scene.points.tolist()):
            track = [place[view] for view in np.flatnonzero(scene.point_index == point)]
            words = [point + FIRST_POINT, *position, 1, 2, 3, 0.5, *np.ravel(track).tolist()]
            self.points.append(list(map(str, words)))

    def files(self) -> dict[str, list[str]]:
        """The lines of each file."""
        images = ["# images"]
        for head, keys in zip(self.heads, self.keys, strict=True):
            images += [head, " ".join(word for key in keys for word in key)]
        points = ["# points", *(" ".join(point) for point in self.points)]
        return {"cameras.txt": self.cameras, "images.txt": images, "points3D.txt": points}

    def write(self, folder: Path) -> Path:
        """Writes the files."""
        folder.mkdir(parents=True, exist_ok=True)
        for name, lines in self.files().items():
            (folder / name).write_text("\n".join([*lines, ""]))
        return folder

    def write_binary(self, folder: Path) -> Path:
        """Writes binary files of the same content, without rigs and frames."""
        folder.mkdir(parents=True, exist_ok=True)
        images = []
        points = []
        for head, keys in zip(self.heads, self.keys, strict=True):
            identity, *pose, camera, name = head.split(None, 9)
            seen = [
                struct.pack("<ddQ", float(x), float(y), int(point) % 2**64) for x, y, point in keys
            ]
            pose = struct.pack("<7d", *map(float, pose))
            start = struct.pack("<I", int(identity)) + pose + struct.pack("<I", int(camera))
            images.append(
                start + name.encode() + b"\0" + struct.pack("<Q", len(seen)) + b"".join(seen)
            )
        for (
            identity,
            x,
            y,
            z,
            *rgb,
            error,
        ) in (point[:8] for point in self.points):
            head = struct.pack(
                "<Q3d3Bd", int(identity), float(x), float(y), float(z), *map(int, rgb), float(error)
            )
            points.append(head)
        for number, point in enumerate(self.points):
            track = list(map(int, point[8:]))
            points[number] += struct.pack(f"<Q{len(track)}I", len(track) // 2, *track)
        camera = struct.pack("<IiQQ4d", 7, 2, 1280, 960, *LENS)
        for part, records in (("cameras", [camera]), ("images", images), ("points3D", points)):
            (folder / f"{part}.bin").write_bytes(
                struct.pack("<Q", len(records)) + b"".join(records)
            )
        return folder


def noted(folder: Path) -> tuple[BundleProblem, list[str]]:
    """The problem of a model, and the notes on it without the folder's name."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        problem = read_colmap(folder)
    assert all(issubclass(one.category, ProblemWarning) for one in caught)
    lines = [str(one.message) for one in caught]
    assert all(line.startswith(f"{folder}/") and line.isprintable() for line in lines)
    return problem, [line.replace(f"{folder}/", "") for line in lines]


def refusal(folder: Path) -> str:
    """Why a model is refused, without the folder's name."""
    with pytest.raises(ProblemError) as caught:
        read_colmap(folder)
    assert str(caught.value).isprintable()
    assert str(folder) in str(caught.value)
    return str(caught.value).replace(f"{folder}/", "")


def swap(file: str, old: str, new: str):
    def damage(folder: Path) -> None:
        text = (folder / file).read_text()
        assert old in text
        (folder / file).write_text(text.replace(old, new, 1))

    return damage


def head_with(field: int, word: str):
    """Image 4 with another word."""

    def damage(folder: Path) -> None:
        lines = (folder / "images.txt").read_text().split("\n")
        words = lines[7].split(" ")
        words[field] = word
        lines[7] = " ".join(words)
        (folder / "images.txt").write_text("\n".join(lines))

    return damage
