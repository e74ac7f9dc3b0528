"""Reader of the text files of a COLMAP model.

Comments, empty lines, byte order marks, Windows line ends and blanks at ends do not matter, and a name is all that
follows the ninth field of its line. Source: COLMAP, src/colmap/scene/reconstruction_io_text.cc.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import numpy as np

from jaxba.io.colmap.records import (
    CAMERA_MODELS,
    KEY,
    NO_ID,
    NO_POINT,
    SENSORS,
    Camera,
    Frame,
    Image,
    Points,
    Pose,
    Record,
    Rig,
    Sensor,
    make_points,
    pose_of,
)
from jaxba.io.colmap.words import Words, lines

_UNIT = 0.1  # how far the norm of a quaternion may be from 1, if that is to tell a pose from pixels
_POSE = ("qw", "qx", "qy", "qz", "tx", "ty", "tz")
_NAME = 9  # fields before the name of an image: id, pose, camera


def read_cameras(data: bytes, name: str) -> dict[int, Camera]:
    """Cameras by id, in the order of the file.

    Raises:
        ProblemError: as all readers here: a line cannot be understood; one line that names the file, the line and the
            field.
    """
    return _records(map(_camera, lines(data, name)))


def read_images(data: bytes, name: str) -> dict[int, Image]:
    """Images by id, in the order of the file. The line of key-points may be empty or missing."""
    return _records(_images(lines(data, name, empty=True)))


def read_rigs(data: bytes, name: str) -> dict[int, Rig]:
    """Rigs by id, in the order of the file."""
    return _records(map(_rig, lines(data, name)))


def read_frames(data: bytes, name: str) -> dict[int, Frame]:
    """Frames by id, in the order of the file."""
    return _records(map(_frame, lines(data, name)))


def read_points(data: bytes, name: str) -> Points:
    """All points and tracks."""
    heads, tracks = [], []
    for line in lines(data, name):
        identity = line.integer("POINT3D_ID", NO_POINT)
        line.about = f"point {identity}"
        xyz = line.floats("x", "y", "z")
        rgb = [line.integer(colour, 255) for colour in ("red", "green", "blue")]
        (error,) = line.floats("error")
        if len(line.rest) % 2:
            line.fail(f"the track has {len(line.rest)} numbers, which are no pairs of IMAGE_ID and POINT2D_IDX")
        track = line.to_integers(line.rest, "IMAGE_ID or POINT2D_IDX of the track", NO_ID)
        heads.append((identity, xyz, rgb, error, len(track) // 2))
        tracks.extend(zip(track[::2], track[1::2], strict=True))
    return make_points(heads, tracks)


def _records(records: Iterator[tuple[Words, Record]]) -> dict[int, Record]:
    found: dict[int, Record] = {}
    for line, record in records:
        if record.id in found:
            line.fail("is there twice")
        found[record.id] = record
    return found


def _camera(line: Words) -> tuple[Words, Camera]:
    identity = line.integer("CAMERA_ID", NO_ID)
    line.about = f"camera {identity}"
    model = line.word("model").decode("latin-1")
    if model not in CAMERA_MODELS:
        line.fail(f"{model!a} is an unknown camera model")
    width, height = (line.integer(field, NO_POINT) for field in ("width", "height"))
    count = CAMERA_MODELS[model].size
    if len(line.rest) != count:
        line.fail(f"{model} has {count} parameters, not {len(line.rest)}")
    return line, Camera(
        identity, model, width, height, tuple(line.floats(*(f"parameter {k + 1}" for k in range(count))))
    )


def _images(file: Iterator[Words]) -> Iterator[tuple[Words, Image]]:
    line = next(file, None)
    while line is not None:
        if not line.rest:
            line = next(file, None)
            continue
        identity = line.integer("IMAGE_ID", NO_ID)
        line.about = f"image {identity}"
        pose = _pose(line)
        camera = line.integer("CAMERA_ID", NO_ID)
        image = Image(identity, pose, camera, line.after(_NAME), np.empty(0, KEY))
        below = next(file, None)
        if below is not None and not _starts_image(below):
            below.about = str(image)
            yield line, Image(identity, pose, camera, image.name, _keys(below))
            below = next(file, None)
        else:
            yield line, image
        line = below


def _starts_image(line: Words) -> bool:
    """Whether a line where key-points are due is that of the next image."""
    words = line.rest
    if len(words) <= _NAME or not _all(int, [words[0], words[_NAME - 1]]) or not _all(float, words[1 : _NAME - 1]):
        return False
    if not abs(math.hypot(*map(float, words[1:5])) - 1) < _UNIT:  # pixels of a damaged line are no unit quaternion
        return False
    return len(words) % 3 != 0 or not _all(float, words)


def _all(convert: Callable[[bytes], object], words: list[bytes]) -> bool:
    try:
        return bool([convert(word) for word in words])
    except ValueError:
        return False


def _keys(line: Words) -> np.ndarray:
    words = line.rest
    if len(words) % 3:
        line.fail(f"{len(words)} numbers, which are no key-points of x, y and POINT3D_ID")
    keys = np.empty(len(words) // 3, KEY)
    keys["point"] = np.array(line.to_integers(words[2::3], "POINT3D_ID of a key-point", NO_POINT), np.uint64)
    for axis, field in enumerate("xy"):
        keys["xy"][:, axis] = line.to_floats(words[axis::3], f"{field} of a key-point")
    return keys


def _pose(line: Words) -> Pose:
    return pose_of(line.floats(*_POSE))


def _rig(line: Words) -> tuple[Words, Rig]:
    identity = line.integer("RIG_ID", NO_ID)
    line.about = f"rig {identity}"
    sensors = []
    for number in range(line.integer("number of sensors", len(line.rest))):
        kind, sensor = _sensor(line)
        pose = number and line.integer("whether there is a pose", 1)
        sensors.append(Sensor(kind, sensor, _pose(line) if pose else None))
    line.finish()
    return line, Rig(identity, tuple(sensors))


def _frame(line: Words) -> tuple[Words, Frame]:
    identity = line.integer("FRAME_ID", NO_ID)
    line.about = f"frame {identity}"
    rig, pose = line.integer("RIG_ID", NO_ID), _pose(line)
    count = line.integer("number of data", len(line.rest))
    data = tuple((*_sensor(line), line.integer("id of a datum", NO_POINT)) for _ in range(count))
    line.finish()
    return line, Frame(identity, rig, pose, data)


def _sensor(line: Words) -> tuple[int, int]:
    kind = line.word("type of a sensor").decode("latin-1")
    if kind not in SENSORS:
        line.fail(f"{kind!a} is no type of sensors")
    return SENSORS[kind], line.integer("id of a sensor", NO_ID)
