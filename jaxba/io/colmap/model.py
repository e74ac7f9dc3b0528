"""What the files of a COLMAP model hold, with the model's own ids and names, and the checks of its
structure.

Source: COLMAP, doc/format.rst and doc/cameras.rst; numbers of models and sensors as in COLMAP
4.2."""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any, NoReturn

import numpy as np
from jaxtyping import Shaped

from jaxba.io.colmap.poses import Pose
from jaxba.io.files import display_name
from jaxba.problem.bundle_problem import ProblemError
from jaxba.problem.camera_models import CAMERA_MODELS

PARTS = ("cameras", "images", "points3D")  # files that every model has
RIG_PARTS = ("rigs", "frames")  # files that models have since COLMAP 3.12, both or none
_LONGEST_NAME = 60  # of an image in messages


MODELS = (
    *(
        "SIMPLE_PINHOLE",
        "PINHOLE",
        "SIMPLE_RADIAL",
        "RADIAL",
        "OPENCV",
        "OPENCV_FISHEYE",
        "FULL_OPENCV",
        "FOV",
    ),
    *(
        "SIMPLE_RADIAL_FISHEYE",
        "RADIAL_FISHEYE",
        "THIN_PRISM_FISHEYE",
        "RAD_TAN_THIN_PRISM_FISHEYE",
    ),
    *("SIMPLE_DIVISION", "DIVISION", "SIMPLE_FISHEYE", "FISHEYE", "EUCM", "EQUIRECTANGULAR"),
)
"""Camera models of COLMAP, of which each has its place as its number in a binary file."""

NO_ID = 2**32 - 1  # COLMAP's id of no camera, image, rig or frame, and its index of no key-point
NO_POINT = 2**64 - 1  # COLMAP's id of no point; -1 in a text file
LARGEST_RATIO = 1e6  # of the focal lengths of a lens; a larger one is damage
CAMERA_SENSOR = 0  # number of the sensor type of cameras
SENSORS = {"CAMERA": CAMERA_SENSOR, "IMU": 1}  # numbers of sensor types by name
# a key-point: pixels, and the id of its point or `NO_POINT`
KEY = np.dtype([("xy", "<f8", 2), ("point", "<u8")])

POINT = np.dtype(
    [("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("length", "<u8")]
)
"""A point, with the number of elements of its track. As in a binary file, where the track
follows."""

# an element of a track: an image, and which of its key-points
TRACK = np.dtype([("image", "<u4"), ("key", "<u4")])


@dataclass(frozen=True)
class Camera:
    """A lens, which images share."""

    id: int
    model: str
    width: int
    height: int
    params: tuple[float, ...]

    @property
    def focals(self) -> list[float]:
        """Its focal lengths; none of a panorama."""
        return [self.params[k] for k in CAMERA_MODELS[self.model].focal]

    @property
    def principal_point(self) -> tuple[float, float]:
        """Its pixel; not of a model without focal lengths."""
        x, y = CAMERA_MODELS[self.model].principal_point
        return self.params[x], self.params[y]

    @property
    def impossible(self) -> str | None:
        """Its parameters for a message, if they are not finite, focal lengths not positive or too
        different."""
        focals = self.focals
        if np.isfinite(self.params).all() and (
            not focals or 0 < max(focals) <= LARGEST_RATIO * min(focals)
        ):
            return None
        return f"{', '.join(f'{value:g}' for value in self.params)} ({self.model})"


@dataclass(frozen=True)
class Image:
    """An image, its pose and its key-points."""

    id: int
    pose: Pose
    camera: int
    name: bytes
    keys: Shaped[np.ndarray, " keys"]  # of type `KEY`

    def __str__(self) -> str:
        name = display_name(self.name.decode("utf-8", "backslashreplace"))
        return (
            f"image {self.id} "
            f"({name if len(name) <= _LONGEST_NAME else name[: _LONGEST_NAME - 3] + '...'})"
        )


@dataclass(frozen=True)
class Sensor:
    """A sensor of a rig."""

    type: int
    id: int
    from_rig: Pose | None  # None for the reference sensor, or where it is not known


@dataclass(frozen=True)
class Rig:
    """Sensors that move together; the first is the reference, whose pose is that of the rig."""

    id: int
    sensors: tuple[Sensor, ...]


@dataclass(frozen=True)
class Frame:
    """What the sensors of a rig took at one moment, and the pose of the rig."""

    id: int
    rig: int
    pose: Pose
    # type and id of the sensor, and of what it took (a camera: the image)
    data: tuple[tuple[int, int, int], ...]

    @property
    def images(self) -> list[tuple[int, int]]:
        """Ids of camera and image of what cameras took."""
        return [(sensor, image) for kind, sensor, image in self.data if kind == CAMERA_SENSOR]


@dataclass(frozen=True)
class Model:
    """A COLMAP model. Records are in the order of the files."""

    folder: str  # or what else messages call it, without a suffix
    suffix: str  # `.bin` or `.txt`; of a model in memory empty
    cameras: dict[int, Camera]
    images: dict[int, Image]
    points: Shaped[np.ndarray, " points"]  # of type `POINT`
    # of type `TRACK`, point after point; None if they were not read
    tracks: Shaped[np.ndarray, " elements"] | None
    rigs: dict[int, Rig] | None  # None before COLMAP 3.12, where all images are registered
    frames: dict[int, Frame] | None

    @property
    def records(self) -> dict[str, dict[int, Any]]:
        """Records of each file but that of the points, by their ids."""
        rigs = self.rigs or {}
        frames = self.frames or {}
        return {"cameras": self.cameras, "images": self.images, "rigs": rigs, "frames": frames}

    @cached_property
    def frame_of(self) -> dict[int, Frame]:
        """Frames by the ids of their images."""
        return {image: frame for frame in (self.frames or {}).values() for _, image in frame.images}

    def file(self, part: str) -> str:
        """Name of a file for messages; of a model in memory its own."""
        return file_name(self.folder, part + self.suffix) if self.suffix else self.folder


def file_name(folder: str, file: str) -> str:
    """Name of a file of a model for messages."""
    return display_name(os.path.join(folder, file))


def check_model(model: Model) -> None:
    """Refuses a damaged structure. Raises ProblemError: an id stands for none or is there twice, an
    image names no camera or a frame no rig, a pose is not finite or has no rotation; one line that
    names the file and the record."""
    rigs = model.rigs or {}
    frames = model.frames or {}
    for part, records in model.records.items():
        if NO_ID in records:
            _fail(model, part, f"{NO_ID} is the id of no {part[:-1]}")
    ids, counts = np.unique(model.points["id"], return_counts=True)
    if (counts > 1).any():
        _fail(model, "points3D", f"point {ids[counts.argmax()]} is there twice")
    if len(ids) and ids[-1] == NO_POINT:
        _fail(model, "points3D", f"{NO_POINT} is the id of no point")
    for image in model.images.values():
        if image.camera not in model.cameras:
            _fail(
                model, "images", f"{image}: camera {image.camera} is not in {model.file('cameras')}"
            )
        _check_pose(model, "images", str(image), image.pose)
    for rig in rigs.values():
        for sensor in rig.sensors:
            if sensor.type == CAMERA_SENSOR and sensor.id not in model.cameras:
                _fail(
                    model,
                    "rigs",
                    f"rig {rig.id}: camera {sensor.id} is not in {model.file('cameras')}",
                )
            if sensor.from_rig is not None:
                _check_pose(model, "rigs", f"rig {rig.id}, sensor {sensor.id}", sensor.from_rig)
    _check_frames(model, rigs, frames)


def _check_frames(model: Model, rigs: dict[int, Rig], frames: dict[int, Frame]) -> None:
    sensors = {
        rig.id: {(sensor.type, sensor.id) for sensor in rig.sensors} for rig in rigs.values()
    }
    for frame in frames.values():
        if frame.rig not in rigs:
            _fail(
                model, "frames", f"frame {frame.id}: rig {frame.rig} is not in {model.file('rigs')}"
            )
        for kind, sensor, datum in frame.data:
            if (kind, sensor) not in sensors[frame.rig]:
                _fail(
                    model,
                    "frames",
                    f"frame {frame.id}: rig {frame.rig} has no sensor {sensor} of datum {datum}",
                )
        for camera, identity in frame.images:
            image = model.images.get(identity)
            if image is not None and image.camera != camera:
                _fail(
                    model,
                    "frames",
                    f"frame {frame.id}: {image} is of camera {image.camera}, not {camera}",
                )
        seen = [str(model.images[image]) for _, image in frame.images[:1] if image in model.images]
        _check_pose(model, "frames", " of ".join([f"frame {frame.id}", *seen]), frame.pose)
    ids = sorted(image for frame in frames.values() for _, image in frame.images)
    twice = next((one for one, other in pairwise(ids) if one == other), None)
    if twice is not None:
        _fail(model, "frames", f"image {twice} is in two frames")


def _check_pose(model: Model, part: str, record: str, pose: Pose) -> None:
    for field, values in (("qvec", pose[:4]), ("tvec", pose[4:])):
        if not np.isfinite(values).all():
            _fail(
                model,
                part,
                f"{record}: {field} is not finite: {' '.join(f'{value:g}' for value in values)}",
            )
    if not any(pose[:4]):
        _fail(model, part, f"{record}: qvec is zero, which is no rotation")


def _fail(model: Model, part: str, complaint: str) -> NoReturn:
    raise ProblemError(f"{model.file(part)}: {complaint}")
