"""Reader of the binary files of a COLMAP model. Counts are held against what is left of a file before they are used.

Source: COLMAP, src/colmap/scene/reconstruction_io_binary.cc.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any, NoReturn

import numpy as np

from jaxba.io.colmap.records import (
    CAMERA_MODELS,
    KEY,
    POINT,
    SENSORS,
    TRACK,
    Camera,
    Frame,
    Image,
    Points,
    Pose,
    Record,
    Rig,
    Sensor,
    pose_of,
)
from jaxba.problem.bundle_problem import ProblemError

_COUNT = struct.Struct("<Q")
_CAMERA = struct.Struct("<IiQQ")  # id, model, width, height
_IMAGE = struct.Struct("<I7dI")  # id, pose, camera
_RIG = struct.Struct("<II")  # id, number of sensors
_SENSOR = struct.Struct("<iI")  # type, id
_POSE = struct.Struct("<7d")
_FRAME = struct.Struct("<II7dI")  # id, rig, pose, number of data
_DATA = struct.Struct("<iIQ")  # type and id of the sensor, id of the datum

_NAMES = {model.number: name for name, model in CAMERA_MODELS.items()}
_LENGTH_AT = POINT.fields["length"][1] if POINT.fields else 0


class _Bytes:
    """The bytes of a file, taken one after the other."""

    def __init__(self, data: bytes, name: str, record: str):
        """`record` is what the file holds, such as "camera"."""
        self.data, self.name, self.at = data, name, 0
        self.record = record

    @property
    def left(self) -> int:
        return len(self.data) - self.at

    def fail(self, complaint: str) -> NoReturn:
        raise ProblemError(f"{self.name}{'' if complaint.startswith('is ') else ':'} {complaint}")

    def take(self, layout: struct.Struct, where: str) -> tuple[Any, ...]:
        if self.left < layout.size:
            self.fail(f"is cut short in {where}")
        values = layout.unpack_from(self.data, self.at)
        self.at += layout.size
        return values

    def array(self, dtype: Any, count: int, where: str) -> np.ndarray:
        dtype = np.dtype(dtype)
        if count * dtype.itemsize > self.left:
            self.fail(f"is cut short: {where} should have {count}, and {self.left} bytes follow")
        values = np.frombuffer(self.data, dtype, count, self.at)
        self.at += values.nbytes
        return values

    def string(self, where: str) -> bytes:
        end = self.data.find(b"\0", self.at)
        if end < 0:
            self.fail(f"is cut short in the name of {where}")
        value = self.data[self.at : end]
        self.at = end + 1
        return value

    def count(self, smallest: int) -> int:
        """Number of records, each of at least `smallest` bytes."""
        if not self.data:
            self.fail("is empty")
        (count,) = self.take(_COUNT, f"the number of {self.record}s")
        if count * smallest > self.left:
            self.fail(f"is cut short: {count} {self.record}s do not fit into its {len(self.data)} bytes")
        return count

    def finish(self, count: int) -> None:
        if self.left:
            plural = "" if self.left == 1 else "s"
            self.fail(f"is too long, by {self.left} byte{plural} after {count} {self.record}s")


def read_cameras(data: bytes, name: str) -> dict[int, Camera]:
    """Cameras by id, in the order of the file.

    Raises:
        ProblemError: as all readers here: the file is cut short or too long, or a record cannot be understood; one
            line that names the file and the record.
    """
    return _records(_Bytes(data, name, "camera"), _CAMERA.size, _camera)


def read_images(data: bytes, name: str) -> dict[int, Image]:
    """Images by id, in the order of the file."""
    return _records(_Bytes(data, name, "image"), _IMAGE.size + 1 + _COUNT.size, _image)


def read_rigs(data: bytes, name: str) -> dict[int, Rig]:
    """Rigs by id, in the order of the file."""
    return _records(_Bytes(data, name, "rig"), _RIG.size, _rig)


def read_frames(data: bytes, name: str) -> dict[int, Frame]:
    """Frames by id, in the order of the file."""
    return _records(_Bytes(data, name, "frame"), _FRAME.size, _frame)


def read_points(data: bytes, name: str) -> Points:
    """All points and tracks."""
    rest = _Bytes(data, name, "point")
    count = rest.count(POINT.itemsize)
    at, end, length_of = rest.at, len(data), _COUNT.unpack_from
    starts = []
    for number in range(count):  # a track's length says where the next point is
        if at + POINT.itemsize > end:
            rest.fail(f"is cut short in point {number + 1} of {count}")
        starts.append(at)
        at += POINT.itemsize + TRACK.itemsize * length_of(data, at + _LENGTH_AT)[0]
        if at > end:
            rest.fail(f"is cut short in the track of point {length_of(data, starts[-1])[0]}")
    rest.at = at
    rest.finish(count)
    ends = [*starts[1:], at]
    heads = b"".join([data[start : start + POINT.itemsize] for start in starts])
    tracks = b"".join([data[start + POINT.itemsize : end] for start, end in zip(starts, ends, strict=False)])
    return Points(np.frombuffer(heads, POINT), np.frombuffer(tracks, TRACK))


def _records(rest: _Bytes, smallest: int, read: Callable[[_Bytes, str], Record]) -> dict[int, Record]:
    found: dict[int, Record] = {}
    count = rest.count(smallest)
    for number in range(count):
        record = read(rest, f"{rest.record} {number + 1} of {count}")
        if record.id in found:
            rest.fail(f"{rest.record} {record.id} is there twice")
        found[record.id] = record
    rest.finish(count)
    return found


def _camera(rest: _Bytes, where: str) -> Camera:
    identity, number, width, height = rest.take(_CAMERA, where)
    if number not in _NAMES:
        rest.fail(f"camera {identity} has an unknown model, number {number}")
    model = _NAMES[number]
    params = rest.array("<f8", CAMERA_MODELS[model].size, f"the parameters of camera {identity} ({model})")
    return Camera(identity, model, width, height, tuple(params.tolist()))


def _image(rest: _Bytes, where: str) -> Image:
    identity, *pose, camera = rest.take(_IMAGE, where)
    name = rest.string(f"image {identity}")
    image = Image(identity, pose_of(pose), camera, name, np.empty(0, KEY))
    (count,) = rest.take(_COUNT, f"the number of key-points of {image}")
    return Image(identity, image.pose, camera, name, rest.array(KEY, count, f"the key-points of {image}"))


def _rig(rest: _Bytes, where: str) -> Rig:
    identity, count = rest.take(_RIG, where)
    if count * _SENSOR.size > rest.left:
        rest.fail(f"is cut short: {count} sensors of rig {identity} do not fit into {rest.left} bytes")
    return Rig(identity, tuple(_sensor(rest, identity, reference=not number) for number in range(count)))


def _sensor(rest: _Bytes, rig: int, reference: bool) -> Sensor:
    where = f"the sensors of rig {rig}"
    kind, identity = _known(rest, rest.take(_SENSOR, where), where)
    pose: Pose | None = None
    if not reference and any(rest.take(struct.Struct("B"), where)):
        pose = pose_of(rest.take(_POSE, where))
    return Sensor(kind, identity, pose)


def _frame(rest: _Bytes, where: str) -> Frame:
    identity, rig, *pose, count = rest.take(_FRAME, where)
    where = f"the data of frame {identity}"
    if count * _DATA.size > rest.left:
        rest.fail(f"is cut short: {where}, {count}, do not fit into {rest.left} bytes")
    data = [_known(rest, rest.take(_DATA, where), where) for _ in range(count)]
    return Frame(identity, rig, pose_of(pose), tuple(data))


def _known(rest: _Bytes, values: Any, where: str) -> Any:
    if values[0] not in SENSORS.values():
        rest.fail(f"{where}: {values[0]} is the number of no type of sensors")
    return values
