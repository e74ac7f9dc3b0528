"""The fields of a COLMAP model's records, from which its text and its binary files are read and
written.

Both forms have the same fields in the same order. A file of either has two methods, which raise
ProblemError: `take(fields, what="")` gives the next values, which with `what` are all that is left
of a record that is called so; `count(field, each)` gives the next value as the number of records of
the fields `each` that follow.

Source: COLMAP, doc/format.rst, and src/colmap/scene/
reconstruction_io_binary.cc and reconstruction_io_text.cc."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from jaxba.io.colmap.model import MODELS, SENSORS, Camera, Frame, Image, Rig, Sensor
from jaxba.problem.camera_models import CAMERA_MODELS

Kinds = tuple[Mapping[str, int], str, str]
"""Numbers in a binary file by their words in text, and what messages say of another word and
another number."""


class Fields:
    """Fields that follow one another."""

    def __init__(
        self, names: str, codes: str, kinds: Kinds | None = None, largest: int | None = None
    ):
        """Names are separated by commas; codes are those of `struct`, of which `i` is one of the
        `kinds`; `largest` is that of integers in text, where it is not their type's."""
        self.names = names.split(", ")
        self.codes = codes
        self.kinds = kinds
        self.largest = largest
        self.struct = struct.Struct(f"<{codes}")


_POSE_NAMES = "qw, qx, qy, qz, tx, ty, tz"
_NUMBERS = {name: number for number, name in enumerate(MODELS)}

CAMERA = Fields(
    "CAMERA_ID, model, width, height",
    "IiQQ",
    (_NUMBERS, "is an unknown camera model", " has an unknown model, number {}"),
)
PARAMETERS = {
    name: Fields(", ".join(f"parameter {k + 1}" for k in range(size)), size * "d")
    for name, size in ((name, len(CAMERA_MODELS[name])) for name in MODELS)
}
POSE = Fields(_POSE_NAMES, 7 * "d")
IMAGE = Fields(f"IMAGE_ID, {_POSE_NAMES}, CAMERA_ID", f"I{7 * 'd'}I")
POINT = Fields("POINT3D_ID, x, y, z, red, green, blue, error", "QdddBBBd")
COUNT = Fields("number of what follows", "I")
RIG = Fields("RIG_ID", "I")
SENSOR = Fields(
    "type of a sensor, id of a sensor",
    "iI",
    (SENSORS, "is no type of sensors", ": {} is the number of no type of sensors"),
)
PLACED = Fields("whether there is a pose", "B", largest=1)
FRAME = Fields(f"FRAME_ID, RIG_ID, {_POSE_NAMES}", f"II{7 * 'd'}")
DATUM = Fields("type of a sensor, id of a sensor, id of a datum", "iIQ", SENSOR.kinds)


def _read_camera(file: Any) -> Camera:
    identity, number, width, height = file.take(CAMERA)
    return Camera(
        identity,
        MODELS[number],
        width,
        height,
        file.take(PARAMETERS[MODELS[number]], MODELS[number]),
    )


def _read_rig(file: Any) -> Rig:
    (identity,) = file.take(RIG)
    sensors = []
    for number in range(file.count("number of sensors", SENSOR)):
        kind, sensor = file.take(SENSOR)
        placed = number and any(file.take(PLACED))
        sensors.append(Sensor(kind, sensor, file.take(POSE) if placed else None))
    return Rig(identity, tuple(sensors))


def _read_frame(file: Any) -> Frame:
    identity, rig, *pose = file.take(FRAME)
    return Frame(
        identity,
        rig,
        tuple(pose),
        tuple(file.take(DATUM) for _ in range(file.count("number of data", DATUM))),
    )


READERS: dict[str, Callable[[Any], Any]] = {
    "cameras": _read_camera,
    "rigs": _read_rig,
    "frames": _read_frame,
}
"""What reads a record of the files that are read alike in both forms."""

FIRST = {"cameras": CAMERA, "images": IMAGE, "points3D": POINT, "rigs": RIG, "frames": FRAME}
"""The fields with which a record of each file begins."""

# fields and their values, one group after the other
Values = Iterator[tuple[Fields, tuple[Any, ...]]]


def values(record: Camera | Image | Rig | Frame) -> Values:
    """The values of a record; those of an image without its name and key-points."""
    match record:
        case Camera():
            yield CAMERA, (record.id, _NUMBERS[record.model], record.width, record.height)
            yield PARAMETERS[record.model], record.params
        case Image():
            yield IMAGE, (record.id, *record.pose, record.camera)
        case Rig():
            yield RIG, (record.id,)
            yield COUNT, (len(record.sensors),)
            for number, one in enumerate(record.sensors):
                yield SENSOR, (one.type, one.id)
                if number:
                    yield PLACED, (int(one.from_rig is not None),)
                if number and one.from_rig is not None:
                    yield POSE, one.from_rig
        case Frame():
            yield FRAME, (record.id, record.rig, *record.pose)
            yield COUNT, (len(record.data),)
            for datum in record.data:
                yield DATUM, datum
