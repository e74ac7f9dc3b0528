"""Small inputs of every kind that commands read, and the commands that read them."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from jaxba.damping import make_policy
from jaxba.damping.learned import LearnedPolicy
from jaxba.damping.policy_file import save_policy
from jaxba.io import write_problem
from jaxba.io.colmap.write import write_colmap
from jaxba.problem import geometry
from jaxba.scenes import SceneConfig, random_scene
from jaxba.settings import configurations

SCENE = random_scene(SceneConfig(6, 40, 160), 0)
IMAGES = 4
IMAGE_SIZE = (160, 96)
FOCAL = 120.0
SPEED = 0.15


@dataclass(frozen=True)
class Input:
    """A kind of input."""

    name: str
    """Name in the table."""

    make: Callable[[Path], object]
    """Writes an undamaged one into an empty folder."""

    command: str
    """The command that reads it."""

    arguments: tuple[str, ...]
    """Its arguments; IN is the folder that was made, OUT an empty one."""

    weight: int = 1
    """How often it is taken, relative to the others."""


def _problem(name: str) -> Callable[[Path], None]:
    return lambda folder: write_problem(SCENE, folder / name)


def _colmap(folder: Path, binary: bool = False) -> None:
    """A model as COLMAP writes it."""
    import pycolmap

    write_colmap(SCENE, folder / "model")
    model = pycolmap.Reconstruction(str(folder / "model"))
    shutil.rmtree(folder / "model")
    (folder / "model").mkdir()
    (model.write_binary if binary else model.write_text)(str(folder / "model"))


def _views() -> list[tuple[int, int, float, float]]:
    """Image, point and pixel of every observation; y points down."""
    pixels = np.asarray(geometry.project(SCENE)) * [1, -1]
    return list(
        zip(
            SCENE.camera_index.tolist(), SCENE.point_index.tolist(), *pixels.T.tolist(), strict=True
        )
    )


def _opensfm(folder: Path) -> None:
    flip = np.diag([1.0, -1.0, -1.0])  # z to the front and y down
    rotations = np.asarray(
        geometry.angle_axis(flip @ np.asarray(geometry.rotation_matrices(SCENE.cameras[:, :3])))
    )
    translations = np.asarray(SCENE.cameras[:, 3:6]) @ flip
    lens = {
        "projection_type": "perspective",
        "width": 1000,
        "height": 800,
        "focal": 0.7,
        "k1": 0.0,
        "k2": 0.0,
    }
    shots = {
        f"{i}.jpg": {"camera": "a", "rotation": r.tolist(), "translation": t.tolist()}
        for i, (r, t) in enumerate(zip(rotations, translations, strict=True))
    }
    points = {str(j): {"coordinates": x} for j, x in enumerate(SCENE.points.tolist())}
    (folder / "reconstruction.json").write_text(
        json.dumps([{"cameras": {"a": lens}, "shots": shots, "points": points}])
    )
    rows = [
        f"{i}.jpg\t{j}\t{k}\t{x / 1000}\t{y / 1000}\t1\t2\t3"
        for k, (i, j, x, y) in enumerate(_views())
    ]
    (folder / "tracks.csv").write_text("\n".join(rows) + "\n")


def _kitti(folder: Path) -> None:
    """A textured plane, oblique to the camera, which drives towards it."""
    from jaxba.kitti.opencv import cv2

    rng = np.random.default_rng(0)
    texture = cv2.GaussianBlur(rng.uniform(0, 255, (600, 600)), (0, 0), 1.5)
    texture = np.clip(128 + 4 * (texture - 128), 0, 255).astype(np.uint8)
    calibration = np.array(
        [[FOCAL, 0, IMAGE_SIZE[0] / 2], [0, FOCAL, IMAGE_SIZE[1] / 2], [0, 0, 1]]
    )
    # from texture to camera 0
    plane = np.array([[0.02, 0, -6.0], [0, 0.02, -6.0], [0.008, 0.004, 2.4]])
    (folder / "image_0").mkdir(parents=True)
    poses = []
    for frame in range(IMAGES):
        center = np.array([0.4, 0.1, 1.0]) * SPEED * frame
        homography = calibration @ (plane - np.outer(center, [0, 0, 1]))
        cv2.imwrite(
            str(folder / "image_0" / f"{frame:06d}.png"),
            cv2.warpPerspective(texture, homography, IMAGE_SIZE),
        )
        poses.append(" ".join(f"{x:.9e}" for x in np.column_stack([np.eye(3), center]).ravel()))
    row = " ".join(f"{x:.9e}" for x in np.column_stack([calibration, np.zeros(3)]).ravel())
    (folder / "calib.txt").write_text("".join(f"P{k}: {row}\n" for k in range(4)))
    (folder / "times.txt").write_text("".join(f"{0.1 * k:e}\n" for k in range(IMAGES)))
    (folder / "poses.txt").write_text("\n".join(poses) + "\n")


def _policy(folder: Path) -> None:
    policy = make_policy("learned")
    assert isinstance(policy, LearnedPolicy)
    save_policy(folder / "a.safetensors", policy, {"jaxba": "0"})
    write_problem(SCENE, folder.parent / "scene.txt")  # not to be damaged


SOLVE = ("--max-iterations", "2", "--output", "OUT/o.txt", "--log", "OUT/log.json")


def _solved(name: str, make: Callable[[Path], None], file: str, weight: int = 1) -> Input:
    return Input(name, make, "solve", (f"IN/{file}", *SOLVE), weight)


def _read(
    name: str, kind: configurations.Kind, configuration: str, option: str, weight: int
) -> Input:
    def make(folder):
        return (folder / "a.yaml").write_bytes(
            configurations.find(kind, configuration).read_bytes()
        )

    return Input(name, make, kind, (option, "IN/a.yaml", "--out", "OUT/run"), weight)


def real(path: Path) -> Input:
    """A file or folder of another program, for `jaxba-solve`."""

    def make(folder: Path) -> None:
        files = [path] if path.is_file() else sorted(path.iterdir())
        target = folder if path.is_file() else folder / path.name
        target.mkdir(exist_ok=True)
        for file in files:
            (target / file.name).write_bytes(file.read_bytes())

    return _solved(f"{path.parent.name}/{path.name}", make, path.name)


INPUTS = (
    _solved("BAL", _problem("a.txt"), "a.txt", 4),
    _solved("BAL, compressed", _problem("a.txt.gz"), "a.txt.gz"),
    _solved("Bundler", _problem("a.out"), "a.out", 4),
    _solved("COLMAP, binary", lambda folder: _colmap(folder, binary=True), "model", 6),
    _solved("COLMAP, text", _colmap, "model", 6),
    _solved("OpenSfM", _opensfm, "reconstruction.json", 2),
    Input(
        "KITTI",
        _kitti,
        "kitti",
        (
            "IN",
            "--poses",
            "IN/poses.txt",
            "--start",
            "poses",
            "--keyframes",
            "all",
            "--out",
            "OUT/o.txt",
        ),
        3,
    ),
    Input(
        "policy file",
        _policy,
        "solve",
        ("IN/../scene.txt", "--policy", "IN/a.safetensors", *SOLVE),
        3,
    ),
    _read("configuration of a training", "train", "default", "--config", 3),
    _read("configuration of a benchmark", "bench", "synthetic", "--suite", 2),
)
