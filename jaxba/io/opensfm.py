"""OpenSfM's reconstructions: `reconstruction.json`, and the observations in `tracks.csv` beside it.

Coordinates of images are normalised: the origin is the middle, y grows downwards, the larger side
is 1. Focal lengths
and principal points are in the same unit, so all are multiplied by the larger side. Source:
OpenSfM, doc/source/dataset.rst and geometry.rst; map/src/tracks_manager.cc for the three versions
of tracks."""

from __future__ import annotations

from collections.abc import Container
from pathlib import Path

import numpy as np

from jaxba.io.encoding import read_characters
from jaxba.io.files import StrPath, display_name
from jaxba.io.json_records import Record
from jaxba.io.notes import note, note_unused
from jaxba.io.opensfm_lenses import Lens, assemble, lens
from jaxba.io.text import finite_numbers
from jaxba.problem.bundle_problem import BundleProblem, ProblemError
from jaxba.problem.geometry import are_rotations

RECONSTRUCTION = "reconstruction.json"  # file by which a folder of OpenSfM is known
TRACKS = tuple(f"tracks.csv{ending}" for ending in ("", ".gz", ".bz2", ".xz"))
# begins the first line of tracks; files of version 0 have no such line
TRACKS_HEADER = "OPENSFM_TRACKS_VERSION_v"
# fields of a line of tracks by version: image, track, key-point, x, y, ...
FIELDS = {0: 8, 1: 9, 2: 11}

PARTS = (
    "cameras",
    "shots",
    "points",
    "rig_cameras",
    "rig_instances",
    "biases",
    "reference_lla",
    "reference",
)
"""Parts of a reconstruction that are read, or that say nothing without measured positions."""

# files of control points beside a reconstruction
CONTROL_POINTS = ("ground_control_points.json", "gcp_list.txt")


def recognises(document: Record) -> bool:
    """Whether a JSON document is a list of reconstructions, or one of them."""
    first = (
        document.value[0] if isinstance(document.value, list) and document.value else document.value
    )
    return isinstance(first, dict) and "shots" in first and "cameras" in first


@np.errstate(over="ignore", invalid="ignore")  # what is not finite then is refused or left out
def from_document(document: Record, path: StrPath) -> BundleProblem:
    """The problem of the first reconstruction of a file, which is the largest, and of the tracks
    beside it.

    `perspective`, `simple_radial` and `radial` cameras are optimised; intrinsics of `brown`,
    `fisheye` and `fisheye_opencv` stay as they are. Images share the lens of their camera. Images
    and tracks that are not reconstructed are ignored, images that see no point are left out; of
    repeated observations the last one counts. Raises ProblemError: tracks are missing or malformed,
    a camera model is not one of `MODELS`, or images are of a rig; one line that names the file, the
    record and the field."""
    if isinstance(document.value, list):
        if not document.value:
            document.fail("holds no reconstruction")
        if len(document.value) > 1:
            note(path, f"only the first of {len(document.value)} reconstructions is read")
        document = Record(document.value[0], document.name)
    _refuse_rigs(document)
    from scipy.spatial.transform import Rotation

    cameras = dict(document.get("cameras").entries("camera"))
    lenses: dict[str, Lens] = {}  # of the cameras that shots name
    shots = {}
    rotations = []
    translations = []
    for key, shot in document.get("shots").entries("shot"):
        camera = shot.get("camera").text()
        if camera not in cameras:
            shot.fail(f"names camera {display_name(camera)}, which is not there")
        if camera not in lenses:
            lenses[camera] = lens(cameras[camera])
        shots[key] = camera
        rotations.append(Rotation.from_rotvec(shot.get("rotation").vector(3)).as_matrix())
        if not are_rotations(rotations[-1][None])[0]:
            shot.fail("has a rotation that is none")
        translations.append(shot.get("translation").vector(3))
    if not document.has("points"):
        document.fail("has no points, only cameras and shots")
    entries = document.get("points").entries("point")
    points = {key: point.get("coordinates").vector(3) for key, point in entries}
    if not shots or not points:
        document.fail(f"has no {'points' if shots else 'shots'}")
    seen, unused = _read_tracks(_tracks_beside(path), shots, points)
    note_unused(path, document.unknown(PARTS) | _unused(document, path) | unused)
    shot_at, point_at = ({key: at for at, key in enumerate(keys)} for keys in (shots, points))
    kept, camera_index = np.unique([shot_at[image] for image, _ in seen], return_inverse=True)
    if len(kept) < len(shots):
        note(path, f"{len(shots) - len(kept)} of {len(shots)} images left out: they see no point")
    names = [list(shots.values())[at] for at in kept]
    used = list(dict.fromkeys(names))
    lens_of = np.array([used.index(name) for name in names])
    size = np.array([lenses[name].size for name in names])[camera_index]
    return assemble(
        path,
        [lenses[name] for name in used],
        lens_of,
        np.array(rotations)[kept],
        np.array(translations)[kept],
        np.array(list(points.values())),
        size.max(axis=1, keepdims=True) * np.array(list(seen.values())) + size / 2,
        camera_index,
        np.array([point_at[track] for _, track in seen]),
    )


def _unused(document: Record, path: StrPath) -> dict[str, int]:
    """What OpenSfM optimises with and this package does not: measured positions, priors of cameras,
    control points."""
    positions = [
        shot.value.get("gps_position") for _, shot in document.get("shots").entries("shot")
    ]
    keys = [
        camera.value if isinstance(camera.value, dict) else ()
        for _, camera in document.get("cameras").entries("")
    ]
    beside = [name for name in CONTROL_POINTS if (Path(path).parent / name).is_file()]
    return {
        "measured positions": sum(isinstance(one, list) and any(one) for one in positions),
        "priors of cameras": sum(any(key.endswith("_prior") for key in camera) for camera in keys),
        **{f"{name} beside it": 1 for name in beside},
    }


def _refuse_rigs(document: Record) -> None:
    if not document.has("rig_instances"):
        return
    for _, instance in document.get("rig_instances").entries("rig instance"):
        shots = (
            list(instance.get("rig_camera_ids").entries("shot"))
            if instance.has("rig_camera_ids")
            else []
        )
        if len(shots) > 1:
            instance.fail(
                "is of a rig of several cameras, whose poses depend on it; rigs are not read"
            )


def _tracks_beside(path: StrPath) -> Path:
    there = [file for name in TRACKS if (file := Path(path).parent / name).is_file()]
    if not there:
        raise ProblemError(
            f"{display_name(path)}: there is no {TRACKS[0]} beside it, which has OpenSfM's "
            "observations"
        )
    return there[0]


def _read_tracks(
    path: StrPath, shots: Container[str], points: Container[str]
) -> tuple[dict[tuple[str, str], tuple[float, float]], dict[str, int]]:
    """The pixels of reconstructed images and points by image and track, and what else the file
    holds."""
    name = display_name(path)
    lines = read_characters(path).split("\n")
    version = 0
    first = 0
    if lines[0].startswith(TRACKS_HEADER):
        stated = lines[0].removeprefix(TRACKS_HEADER).strip()
        version = int(stated) if stated in ("1", "2") else -1
        first = 1
        if version < 0:
            raise ProblemError(
                f"{name} line 1: version {stated!a} of tracks is not read; 1 and 2 are"
            )
    found: dict[tuple[str, str], tuple[float, float]] = {}
    scales: set[str] = set()
    for at, line in enumerate(lines[first:], first + 1):
        if not line.strip():
            continue
        words = line.rstrip().split("\t")
        if len(words) != FIELDS[version]:
            count = f"{len(words)} fields, separated by tabs, instead of {FIELDS[version]}"
            raise ProblemError(f"{name} line {at}: has {count}")
        image, track = words[:2]
        if image not in shots or track not in points:
            continue
        scales.update(words[5:6] if version else ())
        x, y = finite_numbers([word.strip() for word in words[3:5]], "xy", f"{name} line {at}")
        found[image, track] = x, y
    if not found:
        raise ProblemError(f"{name}: no image of the reconstruction sees a point of it")
    # OpenSfM divides residuals by scales
    return found, {"scales of key-points": len(found)} if len(scales) > 1 else {}
