"""AliceVision's and Meshroom's scenes (`.sfm`, `.json`): views, intrinsics, poses and structure, numbers as texts.

A camera at c maps X to `diag(fx, fy) d((R (X - c)).xy / z) + principal point`, pixels from the corner of the image; R
is written column by column. Source: AliceVision, sfmDataIO/jsonIO.cpp, and for the versions CHANGES.md beside it."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from jaxba.io.files import StrPath
from jaxba.io.foreign.cameras import BROWN, FISHEYE, UNDEFINED, ForeignLens, Landmark, build, checked_pose, part
from jaxba.io.foreign.json_records import Record
from jaxba.io.notes import note, note_unused
from jaxba.problem.bundle_problem import BundleProblem

DISTORTIONS = {
    "pinhole": 0,
    "none": 0,
    "radial1": 1,
    "radialk1": 1,
    "radial3": 3,
    "radialk3": 3,
    "brown": 5,
    "fisheye4": 4,
}
"""Models that are read, as `type` calls them and as `distortionType` does, and how many coefficients they have."""

SENSOR_WIDTH = 36.0  # millimetres, where a file does not say. Source: `loadIntrinsic`

PARTS = ("version", "featuresFolders", "matchesFolders", "views", "intrinsics", "poses", "structure")
"""Parts of a file that are read, or say where features are."""

LOCKS = ("scaleLocked", "offsetLocked", "distortionLocked")  # flags that hold parts; `locked`, of all, is read

_PROGRAM = "AliceVision"


def recognises(document: Record) -> bool:
    """Whether a JSON document is of AliceVision."""
    return (
        isinstance(document.value, dict)
        and isinstance(document.value.get("version"), list)
        and "views" in document.value
    )


def from_document(document: Record, path: StrPath) -> BundleProblem:
    """The problem of a scene of AliceVision.

    Cameras are the views that have a pose and see a point; they share the lens of their intrinsic. Intrinsics without
    distortion, with `radial1`, and with `radial3` where k3 is 0 are optimised unless the file locks them. Those of the
    others in `DISTORTIONS` stay as they are. Raises ProblemError: the file lacks a part, names a model that is not in
    `DISTORTIONS`, or views are of a rig; one line that names the file, the record and the field."""
    version = tuple(row.integer() for row in document.get("version").rows())
    views = {}
    for number, value in part(document, "views", _PROGRAM).numbered("viewId", "view"):
        independent = value.get("isPoseIndependant", True).flag()
        rig, pose, intrinsic = (value.get(key, UNDEFINED).integer() for key in ("rigId", "poseId", "intrinsicId"))
        if rig >= 0 and rig != UNDEFINED and not independent:
            value.fail("is of a rig of several cameras, whose poses depend on it; rigs are not read")
        views[number] = pose, intrinsic
    intrinsics = dict(part(document, "intrinsics", _PROGRAM).numbered("intrinsicId", "intrinsic"))
    poses, locked = {}, 0
    for number, value in part(document, "poses", _PROGRAM).numbered("poseId", "pose"):
        pose = value.get("pose")
        inside = pose.get("transform") if pose.has("transform") else pose
        rotation = np.array(inside.get("rotation").vector(9)).reshape(3, 3).T
        poses[number] = checked_pose(value, rotation, inside.get("center").vector(3))
        locked += pose.get("locked", False).flag()
    if locked:
        note(path, f"{locked} of {len(poses)} poses are locked in the file, but are optimised here")
    landmarks = list(_landmarks(part(document, "structure", _PROGRAM)))
    unused = document.unknown(PARTS)
    for lock in LOCKS:
        unused[lock] = sum(one.get(lock, False).flag() for one in intrinsics.values())
    scales = [scale for _, of_landmark in landmarks for scale in of_landmark]
    if len(set(scales)) > 1:  # AliceVision divides residuals by them
        unused["scales of key-points"] = len(scales)
    note_unused(path, unused)
    lens = lambda number: _lens(intrinsics[number], version)
    return build(path, views, poses, intrinsics, lens, [landmark for landmark, _ in landmarks])


def _lens(value: Record, version: tuple[int, ...]) -> ForeignLens:
    """The lens of an intrinsic in pixels from the corner of the image, whatever the version of the file."""
    kind = value.get("type").text()
    model = value.get("distortionType", kind).text() if kind == "pinhole" else kind
    undistortion = value.get("undistortionType", "none").text()
    for name in (model, undistortion if undistortion != "none" else model):
        if name not in DISTORTIONS:
            value.fail(f"is of the model {name!a}, which is not read; read are {', '.join(DISTORTIONS)}")
    count = DISTORTIONS[model]
    given = value.has("distortionParams") and value.get("distortionParams").value not in ("", [])
    numbers = value.get("distortionParams").vector(count) if count and given else [0.0] * count
    width, height = value.get("width").number(), value.get("height").number()
    x, y = value.get("principalPoint").vector(2)
    if version >= (1, 2, 1):
        x, y = x + width / 2, y + height / 2
    fisheye = model == "fisheye4"
    distortion = dict(zip(FISHEYE if fisheye else BROWN, numbers, strict=False))
    size, free = (width, height), not value.get("locked", False).flag()
    return ForeignLens(value.where, _focal(value, version, width), (x, y), distortion, fisheye, size, free)


def _focal(value: Record, version: tuple[int, ...], width: float) -> tuple[float, float]:
    """Focal lengths in pixels."""
    if version < (1, 2, 0):
        focal = value.get("pxFocalLength").number()
        return focal, focal
    if version < (1, 2, 2):
        x, y = value.get("pxFocalLength").vector(2)
        return x, y
    sensor, ratio = value.get("sensorWidth", SENSOR_WIDTH).number(), value.get("pixelRatio", 1.0).number()
    if not (sensor > 0 and ratio > 0):
        value.fail("has a sensorWidth or pixelRatio that is not positive")
    focal = value.get("focalLength").number() / sensor * width
    return focal, focal * ratio if version >= (1, 2, 5) else focal / ratio


def _landmarks(structure: Record) -> Iterator[tuple[Landmark, list[float]]]:
    """The points, and the scales of their key-points where the file has them."""
    for number, value in structure.numbered("landmarkId", "landmark"):
        views, pixels, scales = [], [], []
        observations = value.get("observations")
        for view, seen in observations.numbered("observationId", f"landmark {number}: observation in view"):
            if not seen.has("x"):
                seen.fail("has no x: have AliceVision write observations with their features")
            views.append(view)
            pixels.append(seen.get("x").vector(2))
            if seen.has("scale"):
                scales.append(seen.get("scale").number())
        yield (value.get("X").vector(3), views, pixels), scales
