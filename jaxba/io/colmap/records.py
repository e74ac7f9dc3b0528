"""What the files of a COLMAP model hold, with the model's own ids and names.

Source: COLMAP, doc/format.rst and doc/cameras.rst; numbers of models and sensors as in COLMAP 4.2.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeVar

import numpy as np
from jaxtyping import Float, Shaped

from jaxba.io.files import display_name

PARTS = ("cameras", "images", "points3D")
"""Files that every model has."""

RIG_PARTS = ("rigs", "frames")
"""Files that models have since COLMAP 3.12, both or none."""


_LONGEST_NAME = 60  # of an image in messages


class CameraModel(NamedTuple):
    """A kind of lens."""

    number: int  # in a binary file
    size: int  # number of parameters
    focals: int  # how many of them, from the first, are focal lengths


CAMERA_MODELS = {
    "SIMPLE_PINHOLE": CameraModel(0, 3, 1),
    "PINHOLE": CameraModel(1, 4, 2),
    "SIMPLE_RADIAL": CameraModel(2, 4, 1),
    "RADIAL": CameraModel(3, 5, 1),
    "OPENCV": CameraModel(4, 8, 2),
    "OPENCV_FISHEYE": CameraModel(5, 8, 2),
    "FULL_OPENCV": CameraModel(6, 12, 2),
    "FOV": CameraModel(7, 5, 2),
    "SIMPLE_RADIAL_FISHEYE": CameraModel(8, 4, 1),
    "RADIAL_FISHEYE": CameraModel(9, 5, 1),
    "THIN_PRISM_FISHEYE": CameraModel(10, 12, 2),
    "RAD_TAN_THIN_PRISM_FISHEYE": CameraModel(11, 16, 2),
    "SIMPLE_DIVISION": CameraModel(12, 4, 1),
    "DIVISION": CameraModel(13, 5, 2),
    "SIMPLE_FISHEYE": CameraModel(14, 3, 1),
    "FISHEYE": CameraModel(15, 4, 2),
    "EUCM": CameraModel(16, 6, 2),
    "EQUIRECTANGULAR": CameraModel(17, 2, 0),
}
"""All camera models by name. The principal point follows the focal lengths, if there are any."""

NO_ID = 2**32 - 1
"""COLMAP's id of no camera, image, rig or frame, and its index of no key-point."""

NO_POINT = 2**64 - 1
"""COLMAP's id of no point; -1 in a text file."""

CAMERA_SENSOR = 0
"""Number of the sensor type of cameras."""

SENSORS = {"CAMERA": CAMERA_SENSOR, "IMU": 1}
"""Numbers of sensor types by name."""

KEY = np.dtype([("xy", "<f8", 2), ("point", "<u8")])
"""A key-point: pixels, and the id of its point or `NO_POINT`."""

POINT = np.dtype(
    [("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("length", "<u8")],
)
"""A point, with the number of elements of its track. As in a binary file, where the track follows."""

TRACK = np.dtype([("image", "<u4"), ("key", "<u4")])
"""An element of a track: id of an image, and index of one of its key-points."""


WXYZ = [3, 0, 1, 2]
"""From the order of a quaternion in `jaxba.problem.geometry` to COLMAP's."""

XYZW = [1, 2, 3, 0]
"""And back."""


@dataclass(frozen=True)
class Camera:
    """A lens, which images share."""

    id: int
    model: str
    width: int
    height: int
    params: tuple[float, ...]


@dataclass(frozen=True)
class Pose:
    """A transform from the world (of a sensor: from its rig)."""

    qvec: tuple[float, float, float, float]
    """Quaternion wxyz, of any norm."""

    tvec: tuple[float, float, float]


@dataclass(frozen=True)
class Image:
    """An image, its pose and its key-points."""

    id: int
    pose: Pose
    camera: int
    name: bytes
    keys: Shaped[np.ndarray, " keys"]
    """Of type `KEY`."""

    def __str__(self) -> str:
        name = display_name(self.name.decode("utf-8", "backslashreplace"))
        return f"image {self.id} ({name if len(name) <= _LONGEST_NAME else name[: _LONGEST_NAME - 3] + '...'})"


@dataclass(frozen=True)
class Sensor:
    """A sensor of a rig."""

    type: int
    id: int
    from_rig: Pose | None
    """None for the reference sensor, or where it is not known."""


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
    data: tuple[tuple[int, int, int], ...]
    """Type and id of the sensor, and id of what it took (of a camera: of the image)."""

    @property
    def images(self) -> list[tuple[int, int]]:
        """Ids of camera and image of what cameras took."""
        return [(sensor, image) for kind, sensor, image in self.data if kind == CAMERA_SENSOR]


Record = TypeVar("Record", Camera, Image, Rig, Frame)
"""A record with an id."""


@dataclass(frozen=True)
class Points:
    """All points and their tracks."""

    heads: Shaped[np.ndarray, " points"]
    """Of type `POINT`."""

    tracks: Shaped[np.ndarray, " elements"]
    """Of type `TRACK`: those of the first point, then those of the second, and so on."""


@dataclass(frozen=True)
class Model:
    """A COLMAP model. Records are in the order of the files."""

    folder: str
    suffix: str
    """`.bin` or `.txt`."""

    cameras: dict[int, Camera]
    images: dict[int, Image]
    points: Points
    rigs: dict[int, Rig] | None
    """None in models of COLMAP before 3.12, whose images are all registered."""

    frames: dict[int, Frame] | None

    def file(self, part: str) -> str:
        """Name of a file for messages."""
        return file_name(self.folder, part + self.suffix)


def file_name(folder: str, file: str) -> str:
    """Name of a file of a model for messages."""
    return display_name(os.path.join(folder, file))


def make_points(heads: Any, tracks: Any) -> Points:
    """Points of any sequences of tuples like `POINT` and `TRACK`."""
    return Points(np.array(heads, POINT), np.array(tracks, TRACK))


def pose_of(numbers: Any) -> Pose:
    """A pose of seven numbers, quaternion first."""
    w, x, y, z, *tvec = map(float, numbers)
    return Pose((w, x, y, z), (tvec[0], tvec[1], tvec[2]))


def quaternions(poses: list[Pose]) -> Float[np.ndarray, "n 4"]:
    """Quaternions wxyz of poses, scaled by a power of two where their norm could over- or underflow."""
    found = np.array([pose.qvec for pose in poses]).reshape(-1, 4)
    _, exponents = np.frexp(np.abs(found).max(axis=1, initial=0.0, keepdims=True))
    return np.ldexp(found, np.where(np.abs(exponents) > _LARGEST_EXPONENT, -exponents, 0))


_LARGEST_EXPONENT = 500  # squares of larger numbers overflow float64, whose exponents end at 1023
