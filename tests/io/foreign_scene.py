"""A small scene as other programs write it, with projections by each program's published formula, in NumPy alone."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

SIZE = (1600, 1200)


@dataclass(frozen=True)
class Lens:
    """Brown's or the fisheye's model in pixels; x to the right, y down, from the corner of the image."""

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
            x, y = s * x, s * y
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
        self.rotations = Rotation.from_rotvec(random.normal(scale=0.15, size=(count, 3))).as_matrix()
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
        """Half the sum of the squared distances of observations from projections, pixels squared."""
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
        turn, shift = Rotation.from_matrix(rotation).as_rotvec().tolist(), (-rotation @ scene.centers[i]).tolist()
        shots[f"a shot {i}.jpg"] = {"camera": f"v2 maker {scene.lens_of[i]}", "rotation": turn, "translation": shift}
    points = {str(100 + j): {"coordinates": p.tolist(), "color": [1, 2, 3]} for j, p in enumerate(scene.points)}
    path = folder / "reconstruction.json"
    path.write_text(json.dumps([{"cameras": cameras, "shots": shots, "points": points}]))
    lines = [] if version == 0 else [f"OPENSFM_TRACKS_VERSION_v{version}"]
    middle, end = {0: ([], []), 1: (["0.004"], []), 2: (["0.004"], ["-1", "-1"])}[version]
    for at, ((i, j), (x, y)) in enumerate(zip(scene.seen, scene.pixels.tolist(), strict=True)):
        spot = [repr((x - width / 2) / side), repr((y - height / 2) / side)]
        lines.append("\t".join([f"a shot {i}.jpg", str(100 + j), str(at), *spot, *middle, "1", "2", "3", *end]))
    lines.append(lines[-1].replace("a shot", "another shot"))
    (folder / "tracks.csv").write_text("\n".join(lines) + "\n")
    return path


def write_openmvg(path: Path, scene: Scene, models: list[str]) -> Path:
    """`sfm_data.json` of version 0.3; classes that come again have no name."""
    count = len(scene.lens_of)
    view = lambda i, intrinsic, pose: {
        "key": i,
        "value": {
            "polymorphic_id": 1 << 30,
            "ptr_wrapper": {
                "id": (1 << 31) + i + 1,
                "data": {
                    "local_path": "",
                    "filename": f"{i}.jpg",
                    "width": SIZE[0],
                    "height": SIZE[1],
                    "id_view": i,
                    "id_intrinsic": intrinsic,
                    "id_pose": pose,
                },
            },
        },
    }
    views = [view(i, scene.lens_of[i], i + 10) for i in range(count)] + [view(count, 0, 2**32 - 1)]
    intrinsics, met = [], []
    for at, (lens, model) in enumerate(zip(scene.lenses, models, strict=True)):
        again = model in met
        met += [] if again else [model]
        named = {"polymorphic_id": met.index(model) + 1}
        if not again:
            named = {"polymorphic_id": (1 << 31) + met.index(model) + 1, "polymorphic_name": model}
        data = {"width": SIZE[0], "height": SIZE[1], "focal_length": lens.fx, "principal_point": [lens.cx, lens.cy]}
        key = {"pinhole_radial_k1": "disto_k1", "pinhole_radial_k3": "disto_k3", "pinhole_brown_t2": "disto_t2"}
        if model != "pinhole":
            tangential = list(lens.tangential) if model == "pinhole_brown_t2" else []
            data[key.get(model, model)] = [*lens.radial, *tangential]
        intrinsics.append({"key": at, "value": {**named, "ptr_wrapper": {"id": (1 << 31) + 100 + at, "data": data}}})
    poses = [
        {"key": i + 10, "value": {"rotation": r.tolist(), "center": c.tolist()}}
        for i, (r, c) in enumerate(zip(scene.rotations, scene.centers, strict=True))
    ]
    structure = []
    for j, point in enumerate(scene.points.tolist()):
        seen = [(i, x) for (i, other), x in zip(scene.seen, scene.pixels.tolist(), strict=True) if other == j]
        observations = [{"key": i, "value": {"id_feat": 7, "x": x}} for i, x in seen]
        structure.append({"key": j + 1000, "value": {"X": point, "observations": observations}})
    contents = {"sfm_data_version": "0.3", "root_path": "", "views": views, "intrinsics": intrinsics}
    contents |= {"extrinsics": poses, "structure": structure, "control_points": []}
    path.write_text(json.dumps(contents))
    return path


def write_alicevision(path: Path, scene: Scene, types: list[str], version: tuple[int, int, int]) -> Path:
    """A scene of AliceVision; numbers are texts."""
    width, height = SIZE
    text = lambda numbers: [repr(float(x)) for x in numbers]
    views = [
        {"viewId": str(i), "poseId": str(i + 10), "intrinsicId": str(scene.lens_of[i]), "path": f"{i}.jpg"}
        for i in range(len(scene.lens_of))
    ]
    intrinsics = []
    for at, (lens, kind) in enumerate(zip(scene.lenses, types, strict=True)):
        value: dict[str, object] = {"intrinsicId": str(at), "width": str(width), "height": str(height), "locked": "0"}
        distortion = [*lens.radial, *(lens.tangential if kind == "brown" else ())]
        value |= {"type": kind, "distortionParams": text(distortion) if distortion else ""}
        if version >= (1, 2, 6):
            value |= {
                "type": "pinhole",
                "distortionType": kind.replace("radial", "radialk"),
                "undistortionType": "none",
            }
        center = [lens.cx, lens.cy] if version < (1, 2, 1) else [lens.cx - width / 2, lens.cy - height / 2]
        value["principalPoint"] = text(center)
        if version < (1, 2, 0):
            value["pxFocalLength"] = repr(lens.fx)
        elif version < (1, 2, 2):
            value["pxFocalLength"] = text([lens.fx, lens.fy])
        else:
            ratio = lens.fx / lens.fy if version < (1, 2, 5) else lens.fy / lens.fx
            value |= {"sensorWidth": "24", "focalLength": repr(24 * lens.fx / width), "pixelRatio": repr(ratio)}
        intrinsics.append(value)
    poses = [
        {
            "poseId": str(i + 10),
            "pose": {"transform": {"rotation": text(r.T.ravel()), "center": text(c)}, "locked": "0"},
        }
        for i, (r, c) in enumerate(zip(scene.rotations, scene.centers, strict=True))
    ]
    structure = []
    for j, point in enumerate(scene.points):
        seen = [(i, x) for (i, other), x in zip(scene.seen, scene.pixels, strict=True) if other == j]
        observations = [{"observationId": str(i), "featureId": "7", "x": text(x)} for i, x in seen]
        structure.append({"landmarkId": str(j), "descType": "sift", "X": text(point), "observations": observations})
    contents = {"version": [str(x) for x in version], "views": views, "intrinsics": intrinsics, "poses": poses}
    path.write_text(json.dumps(contents | {"structure": structure}))
    return path
