"""A small scene as other programs write it, with projections by each program's published formula,
in NumPy alone."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

SIZE = (1600, 1200)


@dataclass(frozen=True)
class Lens:
    """Brown's or the fisheye's model in pixels; x to the right, y down, from the corner of the
    image."""

    fx: float = 1200.0
    fy: float = 1200.0
    cx: float = 810.0
    cy: float = 590.0
    radial: tuple[float, ...] = ()
    tangential: tuple[float, float] = (0.0, 0.0)
    fisheye: bool = False

    def project(self, local: np.ndarray) -> np.ndarray:
        x, y = (local[:, :2] / local[:, 2:]).T
        r = np.hypot(x, y)
        if self.fisheye:
            t = np.arctan(r)
            s = (t + sum(k * t ** (2 * i + 3) for i, k in enumerate(self.radial))) / r
            x = s * x
            y = s * y
        else:
            d = 1 + sum(k * r ** (2 * i + 2) for i, k in enumerate(self.radial))
            p1, p2 = self.tangential
            x, y = (
                d * x + 2 * p1 * x * y + p2 * (r**2 + 2 * x**2),
                d * y + 2 * p2 * x * y + p1 * (r**2 + 2 * y**2),
            )
        return np.stack([self.fx * x + self.cx, self.fy * y + self.cy], axis=1)


@dataclass
class Scene:
    """Five images of thirty points, with errors of half a pixel."""

    lenses: list[Lens]
    lens_of: list[int]
    seed: int = 0
    noise: float = 0.5
    rotations: np.ndarray = field(init=False)
    centers: np.ndarray = field(init=False)
    points: np.ndarray = field(init=False)
    seen: list[tuple[int, int]] = field(init=False)
    predicted: np.ndarray = field(init=False)
    pixels: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        random = np.random.default_rng(self.seed)
        count = len(self.lens_of)
        self.rotations = Rotation.from_rotvec(
            random.normal(scale=0.15, size=(count, 3))
        ).as_matrix()
        self.centers = random.uniform(-1.5, 1.5, (count, 3))
        self.points = random.uniform([-3, -2, 6], [3, 2, 12], (30, 3))
        self.seen = [(i, j) for j in range(30) for i in range(count) if random.uniform() < 0.8]
        predicted = []
        for i, j in self.seen:
            local = self.rotations[i] @ (self.points[j] - self.centers[i])
            predicted.append(self.lenses[self.lens_of[i]].project(local[None])[0])
        self.predicted = np.array(predicted)
        self.pixels = self.predicted + self.noise * random.standard_normal(self.predicted.shape)

    @property
    def cost(self) -> float:
        """Half the sum of the squared distances of observations from projections, pixels
        squared."""
        return 0.5 * float(np.sum((self.pixels - self.predicted) ** 2))


def write_opensfm(folder: Path, scene: Scene, models: list[str], version: int = 2) -> Path:
    """`reconstruction.json` and `tracks.csv`."""
    width, height = SIZE
    side = max(SIZE)
    cameras = {}
    for at, (lens, model) in enumerate(zip(scene.lenses, models, strict=True)):
        camera: dict[str, object] = {"projection_type": model, "width": width, "height": height}
        if model in ("perspective", "fisheye"):
            camera["focal"] = lens.fx / side
        else:
            camera |= {"focal_x": lens.fx / side, "focal_y": lens.fy / side}
            camera |= {"c_x": (lens.cx - width / 2) / side, "c_y": (lens.cy - height / 2) / side}
        camera |= {f"k{i}": k for i, k in enumerate(lens.radial, 1)}
        if model == "brown":
            camera |= {"p1": lens.tangential[0], "p2": lens.tangential[1]}
        cameras[f"v2 maker {at}"] = camera
    shots = {}
    for i, rotation in enumerate(scene.rotations):
        turn = Rotation.from_matrix(rotation).as_rotvec().tolist()
        shift = (-rotation @ scene.centers[i]).tolist()
        shots[f"a shot {i}.jpg"] = {
            "camera": f"v2 maker {scene.lens_of[i]}",
            "rotation": turn,
            "translation": shift,
        }
    points = {
        str(100 + j): {"coordinates": p.tolist(), "color": [1, 2, 3]}
        for j, p in enumerate(scene.points)
    }
    path = folder / "reconstruction.json"
    path.write_text(json.dumps([{"cameras": cameras, "shots": shots, "points": points}]))
    lines = [] if version == 0 else [f"OPENSFM_TRACKS_VERSION_v{version}"]
    middle, end = {0: ([], []), 1: (["0.004"], []), 2: (["0.004"], ["-1", "-1"])}[version]
    for at, ((i, j), (x, y)) in enumerate(zip(scene.seen, scene.pixels.tolist(), strict=True)):
        spot = [repr((x - width / 2) / side), repr((y - height / 2) / side)]
        lines.append(
            "\t".join(
                [f"a shot {i}.jpg", str(100 + j), str(at), *spot, *middle, "1", "2", "3", *end]
            )
        )
    lines.append(lines[-1].replace("a shot", "another shot"))
    (folder / "tracks.csv").write_text("\n".join(lines) + "\n")
    return path
