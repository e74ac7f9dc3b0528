"""Random surveys as users have them: a COLMAP model, a log, control points with marks, check
points, depth maps, YAML.

What is true is made here, without the library: its projection, its coordinates on the earth (by
pyproj) and its files. Scenes of a shape share their sizes, so that few programs are compiled."""

from __future__ import annotations

import functools
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pyproj
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

import jaxba
from jaxba.problem.similarity import Similarity, transformed

VIEWS = 5
MARK_VIEWS = 4
"""Images that see each point, and each mark."""

CONTROLS = 6
CHECKS = 3
"""Marks of each kind."""


@dataclass(frozen=True)
class Shape:
    """What scenes of a shape have in common."""

    images: int
    points: int
    lens: str  # a camera model of COLMAP
    # surveys that it is for, words of `Survey.content` with blanks between
    contents: tuple[str, ...]
    size: tuple[int, int]  # of images, pixels


SHAPES = {
    "block": Shape(12, 240, "SIMPLE_RADIAL", ("log", "marks", "log marks"), (4000, 3000)),
    "strip": Shape(10, 200, "OPENCV", ("log marks",), (5472, 3648)),
    "facade": Shape(14, 300, "PINHOLE", ("marks",), (6000, 4000)),
    "room": Shape(8, 150, "PINHOLE", ("log depths",), (640, 480)),
}
"""Aerial blocks and strips, an arc around a facade, and a walk through a room with depth maps."""

OF_LENS = {
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "OPENCV": ("f", "f", "cx", "cy", "k1", "k2", "p1", "p2"),
    "PINHOLE": ("f", "f", "cx", "cy"),
}
"""Parameters of camera models. Source: COLMAP, src/colmap/sensor/models.h."""

PREFIXES = ("IMG_", "DJI_", "DSC0", "GOPR")


@dataclass
class Survey:
    """A survey, which a gross error changes before it is written."""

    shape: str
    content: tuple[str, ...]
    seed: int
    names: list[str]
    lens: dict[str, float]
    size: tuple[int, int]
    turns: Float[np.ndarray, "images 3 3"]
    centres: Float[np.ndarray, "images 3"]  # true, metres in the frame of the scene
    points: Float[np.ndarray, "points 3"]  # true
    seen: Int[np.ndarray, "points views"]  # images that see each point
    pixels: Float[np.ndarray, "points views 2"]  # measured
    origin: tuple[float, float, float]  # longitude, latitude and height
    crs: str  # of coordinates on the earth; empty: the frame of the scene is that of the survey
    local: bool  # whether coordinates are those of the scene, as a total station has them
    log: Float[np.ndarray, "images 3"] = field(default_factory=lambda: np.zeros((0, 3)))
    log_header: str = ""
    log_stddev: float = 0.0
    mark_names: list[str] = field(default_factory=list)
    marks: Float[np.ndarray, "marks 3"] = field(default_factory=lambda: np.zeros((0, 3)))
    mark_system: str = ""  # first line of the file
    mark_seen: Int[np.ndarray, "marks views"] = field(default_factory=lambda: np.zeros((0, 0), int))
    mark_pixels: Float[np.ndarray, "marks views 2"] = field(
        default_factory=lambda: np.zeros((0, 0, 2))
    )
    checks: list[str] = field(default_factory=list)
    maps: list[np.ndarray] = field(default_factory=list)

    @property
    def heading(self) -> str:
        """What the survey is, for people."""
        return f"{self.shape} ({', '.join(self.content)}), seed {self.seed}"


def draw(shape: str, content: str, seed: int) -> Survey:
    """A random survey without gross errors.

    Args:
        shape: a key of `SHAPES`.
        content: one of its contents.
        seed: of all that is random.

    Returns:
        The survey, whose measurements have noise of their standard deviations."""
    rng = np.random.default_rng([seed, list(SHAPES).index(shape)])
    kind = SHAPES[shape]
    width, height = kind.size
    focal = width * rng.uniform(0.7, 0.9)
    lens = {"f": focal, "cx": width / 2, "cy": height / 2}
    if kind.lens != "PINHOLE":
        lens["k1"] = rng.uniform(-0.03, 0.03)
    if kind.lens == "OPENCV":
        lens |= {
            "k2": rng.uniform(-0.01, 0.01),
            "p1": rng.normal(0, 1e-4),
            "p2": rng.normal(0, 1e-4),
        }
    turns, centres, sample = _AT[shape](kind, rng, width / focal)
    seen, _ = _pattern(shape)
    candidates = sample(60 * kind.points, rng)
    every, visible = _visible(kind.size, lens, turns, centres, candidates)
    chosen = _first_of(_fitting(visible, seen))
    points = candidates[chosen]
    pixels = np.take_along_axis(every[chosen], seen[..., None], axis=1)
    pixels = pixels + rng.uniform(0.3, 1.0) * rng.normal(size=pixels.shape)
    prefix = str(rng.choice(PREFIXES))
    first = int(rng.integers(1, 800))
    local = shape in ("facade", "room") and "log" not in content
    longitude = rng.uniform(-120, 150)
    latitude = rng.uniform(25, 60) * rng.choice([-1, 1])
    zone = int((longitude + 180) // 6) + 1
    survey = Survey(
        shape=shape,
        content=tuple(content.split()),
        seed=seed,
        names=[f"{prefix}{first + number:04d}.JPG" for number in range(kind.images)],
        lens=lens,
        size=kind.size,
        turns=turns,
        centres=centres,
        points=points,
        seen=seen,
        pixels=pixels,
        origin=(longitude, latitude, rng.uniform(20, 900)),
        crs=f"EPSG:{326 if latitude > 0 else 327}{zone:02d}",
        local=local,
    )
    if "log" in survey.content:
        _add_log(survey, rng)
    if "marks" in survey.content:
        _add_marks(survey, sample(1500, rng), rng)
    if "depths" in survey.content:
        relative = rng.uniform(0.5, 3.0)
        size = kind.size if rng.random() < 0.5 else (kind.size[0] // 2, kind.size[1] // 2)
        survey.maps = depth_maps(survey, size, lambda depth: relative * depth, rng)
    return survey


def _block(kind: Shape, rng: np.random.Generator, view: float, strips: int = 3) -> tuple:
    height = rng.uniform(60, 140)
    wide = height * view
    per_strip = kind.images // strips
    overlap = 0.8 if strips > 1 else 0.88
    along, across = np.meshgrid(
        np.arange(per_strip) * (1 - overlap) * wide, np.arange(strips) * 0.3 * wide
    )
    centres = np.stack([along.ravel(), across.ravel(), np.full(kind.images, height)], axis=1)
    if strips == 1:  # a corridor that bends
        centres[:, 1] = 0.3 * wide * np.sin(np.linspace(0, np.pi, kind.images))
    centres += 0.012 * height * rng.normal(size=centres.shape)
    down = np.diag([1.0, -1.0, -1.0])
    spin = np.repeat(np.arange(strips) % 2 * np.pi, per_strip) + rng.normal(0, 0.05, kind.images)
    tilts = np.column_stack([rng.normal(0, 0.05, (kind.images, 2)), spin])
    turns = Rotation.from_rotvec(tilts).as_matrix() @ down
    low = centres.min(axis=0)[:2] - 0.3 * wide
    high = centres.max(axis=0)[:2] + 0.3 * wide
    relief = rng.uniform(0.03, 0.12) * height
    phase = rng.uniform(0, 6, 2)

    def sample(count: int, rng: np.random.Generator) -> np.ndarray:
        flat = rng.uniform(low, high, (count, 2))
        up = relief * np.sin(flat[:, 0] / 30 + phase[0]) * np.cos(flat[:, 1] / 40 + phase[1])
        return np.column_stack([flat, up + rng.normal(0, 0.1 * relief, count)])

    return _turned(turns, centres, sample, rng)


def _strip(kind: Shape, rng: np.random.Generator, view: float) -> tuple:
    return _block(kind, rng, view, strips=1)


def _turned(turns: np.ndarray, centres: np.ndarray, sample, rng: np.random.Generator) -> tuple:
    """The same, flown in any direction."""
    azimuth = Rotation.from_rotvec([0, 0, rng.uniform(0, 2 * np.pi)])

    def turned_sample(count: int, rng: np.random.Generator) -> np.ndarray:
        return azimuth.apply(sample(count, rng))

    return turns @ azimuth.as_matrix().T, azimuth.apply(centres), turned_sample


def _facade(
    kind: Shape, rng: np.random.Generator, view: float, width: float = 40.0, deep: float = 3.0
) -> tuple:
    distance = 0.9 * width / view
    angles = np.linspace(-0.7, 0.7, kind.images) + rng.normal(0, 0.03, kind.images)
    heights = width * rng.uniform(0.03, 0.35, kind.images)
    centres = np.column_stack([distance * np.sin(angles), -distance * np.cos(angles), heights])
    middle = np.array([0.0, 0.0, 0.2 * width]) + rng.normal(0, 0.02 * width, (kind.images, 3))
    turns = np.stack([_looking(ahead) for ahead in middle - centres])

    def sample(count: int, rng: np.random.Generator) -> np.ndarray:
        return rng.uniform([-0.5 * width, -deep, 0.0], [0.5 * width, deep, 0.4 * width], (count, 3))

    return _turned(turns, centres, sample, rng)


def _room(kind: Shape, rng: np.random.Generator, view: float) -> tuple:
    width = 5.0
    turns, centres, sample = _facade(kind, rng, view, width, deep=0.0)
    phase = rng.uniform(0, 6, 2)

    def surface(count: int, rng: np.random.Generator) -> np.ndarray:
        """One wall that waves: neighbours in an image have nearly the same depth, as in a map."""
        places = sample(count, rng)
        places[:, 2] += 0.2 * np.sin(2 * places[:, 0] + phase[0])
        ahead = places - centres.mean(axis=0)
        waves = 1 + 0.2 * np.sin(1.5 * places[:, :1] + phase[0]) * np.cos(
            1.5 * places[:, 2:] + phase[1]
        )
        return centres.mean(axis=0) + ahead * waves

    return turns, centres, surface


_AT = {"block": _block, "strip": _strip, "facade": _facade, "room": _room}


def _looking(ahead: np.ndarray) -> np.ndarray:
    """The rotation from the world to a camera (x to the right, y down) that looks in a
    direction."""
    ahead = ahead / np.linalg.norm(ahead)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right = right / np.linalg.norm(right)
    return np.stack([right, np.cross(ahead, right), ahead])


def projected(
    lens: dict[str, float], turns: np.ndarray, centres: np.ndarray, points: np.ndarray
) -> tuple[Float[np.ndarray, "points images 2"], Float[np.ndarray, "points images"]]:
    """Pixels from the upper left corner, and depths. Source: OpenCV's camera model."""
    inside = np.einsum("cij,pcj->pci", turns, points[:, None] - centres)
    x, y = np.moveaxis(inside[..., :2] / inside[..., 2:], -1, 0)
    k1, k2, p1, p2 = (lens.get(name, 0.0) for name in ("k1", "k2", "p1", "p2"))
    square = x * x + y * y
    radial = 1 + k1 * square + k2 * square**2
    u = x * radial + 2 * p1 * x * y + p2 * (square + 2 * x * x)
    v = y * radial + 2 * p2 * x * y + p1 * (square + 2 * y * y)
    pixels = np.stack([lens["f"] * u + lens["cx"], lens["f"] * v + lens["cy"]], axis=-1)
    return pixels, inside[..., 2]


@functools.cache
def _pattern(shape: str) -> tuple[Int[np.ndarray, "points views"], Int[np.ndarray, "marks views"]]:
    """Which images see each point and mark of every scene of a shape, so that all of them have the
    same sizes."""
    kind = SHAPES[shape]
    rng = np.random.default_rng(0)
    turns, centres, sample = _AT[shape](kind, rng, 1.25)
    lens = {"f": kind.size[0] / 1.25, "cx": kind.size[0] / 2, "cy": kind.size[1] / 2}
    candidates = sample(40 * kind.points, rng)
    _, visible = _visible(kind.size, lens, turns, centres, candidates, 0.15)
    some = np.flatnonzero(visible.sum(axis=1) >= VIEWS)[: kind.points]
    assert len(some) == kind.points
    spread = _spread(
        candidates[:1000], [visible[:1000].sum(axis=1) >= MARK_VIEWS] * (CONTROLS + CHECKS)
    )
    return _chosen(visible[some], VIEWS, rng), _chosen(visible[spread], MARK_VIEWS, rng)


def _chosen(visible: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """Random ones of the images that see each point."""
    order = np.where(visible, rng.random(visible.shape), 2.0)
    return np.sort(np.argsort(order, axis=1)[:, :count], axis=1)


def _fitting(
    visible: Bool[np.ndarray, "candidates images"], seen: Int[np.ndarray, "n views"]
) -> Bool[np.ndarray, "n candidates"]:
    """Which candidates all images of each row see."""
    return np.all(visible[:, seen], axis=2).T


def _first_of(fitting: Bool[np.ndarray, "n candidates"]) -> Int[np.ndarray, " n"]:
    """A candidate for each row, each once; rows with few to choose from come first."""
    left = fitting.copy()
    chosen = np.zeros(len(left), int)
    for row in np.argsort(fitting.sum(axis=1), kind="stable"):
        if not left[row].any():
            raise ValueError("too few points are seen by the images of a row")
        chosen[row] = np.argmax(left[row])
        left[:, chosen[row]] = False
    return chosen


def _spread(candidates: np.ndarray, fitting: Sequence[np.ndarray]) -> list[int]:
    """A candidate for each row, far from those before: surveyors spread control points."""
    chosen: list[int] = []
    middle = candidates.mean(axis=0, keepdims=True)
    for row in fitting:
        others = candidates[chosen] if chosen else middle
        away = np.linalg.norm(candidates[:, None] - others, axis=2).min(axis=1)
        chosen.append(int(np.argmax(np.where(row, away, -1.0))))
        if not row[chosen[-1]]:
            raise ValueError("no mark is seen by the images of a row")
    return chosen


def _visible(
    size: tuple[int, int],
    lens: dict[str, float],
    turns: np.ndarray,
    centres: np.ndarray,
    points: np.ndarray,
    margin: float = 0.01,
) -> tuple[np.ndarray, np.ndarray]:
    """Pixels of points, and which images see them, not within a margin, a share of the width."""
    pixels, depths = projected(lens, turns, centres, points)
    inside = (pixels > margin * size[0]) & (pixels < np.array(size) - margin * size[0])
    return pixels, inside.all(axis=-1) & (depths > 0)


def on_earth(
    survey: Survey, places: Float[np.ndarray, "n 3"], crs: str
) -> Float[np.ndarray, "n 3"]:
    """Metres east, north and up of the origin in a coordinate system, in the order east, north,
    height."""
    longitude, latitude, height = survey.origin
    pipeline = (
        f"+proj=pipeline +step +inv +proj=topocentric +ellps=WGS84 +lon_0={longitude} "
        f"+lat_0={latitude} "
        f"+h_0={height} +step +inv +proj=cart +ellps=WGS84 +step +proj=unitconvert +xy_in=rad "
        "+xy_out=deg"
    )
    found = pyproj.Transformer.from_pipeline(pipeline).transform(*places.T)
    target = pyproj.CRS(crs).to_3d()
    return np.stack(
        pyproj.Transformer.from_crs("EPSG:4979", target, always_xy=True).transform(*found), axis=1
    )


def _add_log(survey: Survey, rng: np.random.Generator) -> None:
    survey.log_stddev = float(rng.choice([0.03, 0.5, 2.0])) if survey.shape != "room" else 0.02
    measured = survey.centres + rng.normal(0, survey.log_stddev, survey.centres.shape)
    if rng.random() < 0.5:
        survey.log = on_earth(survey, measured, "EPSG:4326")[:, [1, 0, 2]]
        survey.log_header = "image,latitude,longitude,altitude"
    else:
        survey.log = on_earth(survey, measured, survey.crs)
        survey.log_header = "image,x,y,z"


def _add_marks(survey: Survey, candidates: np.ndarray, rng: np.random.Generator) -> None:
    count = CONTROLS + CHECKS
    _, survey.mark_seen = _pattern(survey.shape)
    pixels, visible = _visible(survey.size, survey.lens, survey.turns, survey.centres, candidates)
    chosen = _spread(candidates, list(_fitting(visible, survey.mark_seen)))
    places = candidates[chosen]
    pixels = np.take_along_axis(pixels[chosen], survey.mark_seen[..., None], axis=1)
    survey.mark_pixels = pixels + 0.5 * rng.normal(size=pixels.shape)
    survey.mark_names = [f"gcp{number + 1}" for number in range(count)]
    survey.checks = survey.mark_names[CONTROLS:]
    measured = places + rng.normal(0, 0.02, places.shape)
    survey.marks = measured if survey.local else on_earth(survey, measured, survey.crs)
    survey.mark_system = "local" if survey.local else survey.crs


def depth_maps(
    survey: Survey, size: tuple[int, int], value, rng: np.random.Generator
) -> list[np.ndarray]:
    """A map for each image with `value(depth)` at the nearest of its points, and noise of 2
    percent."""
    scale = np.array(size) / survey.size
    _, depths = projected(survey.lens, survey.turns, survey.centres, survey.points)
    columns, rows = np.meshgrid(np.arange(size[0]), np.arange(size[1]))
    cells = np.stack([columns.ravel(), rows.ravel()], axis=1) + 0.5
    maps = []
    for image in range(len(survey.names)):
        point, view = np.nonzero(survey.seen == image)
        pixels = survey.pixels[point, view] * scale
        values = value(depths[point, image]) * (1 + 0.02 * rng.normal(size=len(point)))
        nearest = KDTree(pixels).query(cells)[1]
        maps.append(values[nearest].reshape(size[1], size[0]).astype(np.float32))
    return maps


def write(survey: Survey, folder: Path, *, bent: bool = True) -> Path:
    """Writes the model `model`, in a frame of its own, and the files of the survey; its YAML file.
    Unless it is to be `bent`, as images alone bend it, the model is true."""
    rng = np.random.default_rng([survey.seed, 7])
    _write_model(survey, folder / "true")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", jaxba.ProblemWarning)
        _write_start(folder, rng, bent)
    text = [] if survey.local else [f"crs: {survey.crs}"]
    if len(survey.log):
        geographic = "latitude" in survey.log_header
        system = "" if geographic else f", crs: {survey.crs}"
        text.append(f"position_priors: {{file: log.csv, stddev: {survey.log_stddev}{system}}}")
        rows = [
            f"{name},{','.join(map(repr, row))}"
            for name, row in zip(survey.names, survey.log.tolist(), strict=True)
        ]
        (folder / "log.csv").write_text("\n".join([survey.log_header, *rows, ""]))
    if len(survey.marks):
        checks = f", check: [{', '.join(survey.checks)}]" if survey.checks else ""
        text.append(f"control_points: {{file: gcp_list.txt, stddev: 0.02, pixels: 0.5{checks}}}")
        lines = [survey.mark_system]
        for mark, name in enumerate(survey.mark_names):
            place = " ".join(map(repr, survey.marks[mark].tolist()))
            for image, (x, y) in zip(
                survey.mark_seen[mark], survey.mark_pixels[mark].tolist(), strict=True
            ):
                lines.append(f"{place} {x:.2f} {y:.2f} {survey.names[image]} {name}")
        (folder / "gcp_list.txt").write_text("\n".join([*lines, ""]))
    if survey.maps:
        text.append("depths: {folder: depths, stddev: 0.03}")
        (folder / "depths").mkdir()
        for name, depths in zip(survey.names, survey.maps, strict=True):
            np.save(folder / "depths" / f"{Path(name).stem}.npy", depths)
    (folder / "survey.yaml").write_text("\n".join([*text, ""]))
    return folder / "survey.yaml"


def _write_model(survey: Survey, folder: Path) -> None:
    """The true scene as a model of COLMAP's text. Source: colmap.github.io/format.html."""
    folder.mkdir(parents=True)
    kind = SHAPES[survey.shape].lens
    parameters = " ".join(repr(float(survey.lens[name])) for name in OF_LENS[kind])
    (folder / "cameras.txt").write_text(
        f"1 {kind} {survey.size[0]} {survey.size[1]} {parameters}\n"
    )
    lines = []
    tracks = [[] for _ in survey.points]
    for image, name in enumerate(survey.names):
        x, y, z, w = Rotation.from_matrix(survey.turns[image]).as_quat().tolist()
        shift = (-survey.turns[image] @ survey.centres[image]).tolist()
        lines.append(f"{image + 1} {w!r} {x!r} {y!r} {z!r} {' '.join(map(repr, shift))} 1 {name}")
        keys = []
        for at, (point, view) in enumerate(np.argwhere(survey.seen == image).tolist()):
            u, v = survey.pixels[point, view].tolist()
            keys.append(f"{u!r} {v!r} {point + 1}")
            tracks[point].append(f"{image + 1} {at}")
        lines.append(" ".join(keys))
    (folder / "images.txt").write_text("\n".join([*lines, ""]))
    rows = []
    for point, place in enumerate(survey.points.tolist()):
        rows.append(
            f"{point + 1} {' '.join(map(repr, place))} 128 128 128 0.5 {' '.join(tracks[point])}"
        )
    (folder / "points3D.txt").write_text("\n".join([*rows, ""]))


def _write_start(folder: Path, rng: np.random.Generator, bent: bool) -> None:
    """What structure from motion makes of the images alone: the minimum without the survey, in a
    frame of its own."""
    found = jaxba.read_colmap(folder / "true")
    if bent:
        points = np.asarray(found.points)
        start = points + 0.002 * np.ptp(points) * rng.normal(size=points.shape)
        found = jaxba.solve(found.replace(points=start)).problem
    turn = Rotation.from_rotvec(rng.normal(size=3)).as_matrix()
    frame = Similarity(float(10 ** rng.uniform(-2, 1)), turn, 5 * rng.normal(size=3))
    jaxba.write_colmap(transformed(found, frame), folder / "model", like=folder / "true")
