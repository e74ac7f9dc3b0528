"""The bytes of the files of a COLMAP model.

Numbers in text have as many digits as reading them back bit by bit needs. Source: COLMAP, doc/format.rst.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator

from jaxba.io.colmap.records import CAMERA_MODELS, NO_POINT, POINT, SENSORS, TRACK, Frame, Model, Pose, Rig

_SENSOR_NAMES = {number: name for name, number in SENSORS.items()}
_HEADERS = {
    "cameras": "CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]",
    "images": "IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME; next line: POINTS2D[] as (X, Y, POINT3D_ID)",
    "points3D": "POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)",
    "rigs": "RIG_ID, NUM_SENSORS, REF_SENSOR_TYPE, REF_SENSOR_ID, SENSORS[] as (TYPE, ID, HAS_POSE, [POSE])",
    "frames": "FRAME_ID, RIG_ID, QW, QX, QY, QZ, TX, TY, TZ, NUM_DATA, DATA[] as (SENSOR_TYPE, SENSOR_ID, DATA_ID)",
}


def encode(model: Model, suffix: str) -> Iterator[tuple[str, bytes]]:
    """Names and contents of the files of a model with rigs and frames.

    Args:
        model: the model.
        suffix: `.bin` or `.txt`.
    """
    parts = {".bin": _binary, ".txt": _text}[suffix](model)
    return ((part + suffix, content) for part, content in parts)


def _binary(model: Model) -> Iterator[tuple[str, bytes]]:
    rigs, frames = model.rigs or {}, model.frames or {}
    cameras = [
        struct.pack("<IiQQ", one.id, CAMERA_MODELS[one.model].number, one.width, one.height)
        + struct.pack(f"<{len(one.params)}d", *one.params)
        for one in model.cameras.values()
    ]
    images = [
        struct.pack("<I7dI", one.id, *_numbers(one.pose), one.camera)
        + b"".join([one.name, b"\0", struct.pack("<Q", len(one.keys)), one.keys.tobytes()])
        for one in model.images.values()
    ]
    yield "cameras", _counted(cameras)
    yield "images", _counted(images)
    yield "points3D", _binary_points(model)
    yield "rigs", _counted([struct.pack("<II", one.id, len(one.sensors)) + _sensors(one) for one in rigs.values()])
    yield "frames", _counted(list(map(_binary_frame, frames.values())))


def _counted(records: list[bytes]) -> bytes:
    return b"".join([struct.pack("<Q", len(records)), *records])


def _binary_points(model: Model) -> bytes:
    heads, tracks = model.points.heads.tobytes(), model.points.tracks.tobytes()
    parts, at = [struct.pack("<Q", len(model.points.heads))], 0
    for number, length in enumerate(model.points.heads["length"].tolist()):
        end = at + length * TRACK.itemsize
        parts += [heads[number * POINT.itemsize : (number + 1) * POINT.itemsize], tracks[at:end]]
        at = end
    return b"".join(parts)


def _binary_frame(frame: Frame) -> bytes:
    head = struct.pack("<II7dI", frame.id, frame.rig, *_numbers(frame.pose), len(frame.data))
    return b"".join([head, *(struct.pack("<iIQ", *datum) for datum in frame.data)])


def _sensors(rig: Rig) -> bytes:
    parts = []
    for number, one in enumerate(rig.sensors):
        parts.append(struct.pack("<iI", one.type, one.id))
        if number:
            parts.append(struct.pack("<B", one.from_rig is not None))
            parts.append(struct.pack("<7d", *_numbers(one.from_rig)) if one.from_rig else b"")
    return b"".join(parts)


def _numbers(pose: Pose) -> tuple[float, ...]:
    return (*pose.qvec, *pose.tvec)


def _text(model: Model) -> Iterator[tuple[str, bytes]]:
    lines: dict[str, Iterator[bytes]] = {
        "cameras": (_joined(o.id, o.model, o.width, o.height, *o.params) for o in model.cameras.values()),
        "images": _text_images(model),
        "points3D": _text_points(model),
        "rigs": (_joined(o.id, len(o.sensors), *_sensor_words(o)) for o in (model.rigs or {}).values()),
        "frames": map(_text_frame, (model.frames or {}).values()),
    }
    for part, found in lines.items():
        yield part, b"\n".join([f"# {_HEADERS[part]}".encode(), *found, b""])


def _text_images(model: Model) -> Iterator[bytes]:
    for image in model.images.values():
        yield _joined(image.id, *_numbers(image.pose), image.camera) + b" " + image.name
        x, y = image.keys["xy"].T.tolist()
        points = [-1 if point == NO_POINT else point for point in image.keys["point"].tolist()]
        yield " ".join([f"{x} {y} {point}" for x, y, point in zip(x, y, points, strict=True)]).encode()


def _text_points(model: Model) -> Iterator[bytes]:
    images, keys = model.points.tracks["image"].tolist(), model.points.tracks["key"].tolist()
    elements = [f" {image} {key}" for image, key in zip(images, keys, strict=True)]
    at = 0
    fields = (model.points.heads[field].tolist() for field in ("id", "xyz", "rgb", "error", "length"))
    for identity, (x, y, z), (red, green, blue), error, length in zip(*fields, strict=True):
        track = "".join(elements[at : at + length])
        yield f"{identity} {x} {y} {z} {red} {green} {blue} {error}{track}".encode()
        at += length


def _sensor_words(rig: Rig) -> Iterator[object]:
    for number, one in enumerate(rig.sensors):
        yield from (_SENSOR_NAMES[one.type], one.id)
        if number:
            yield int(one.from_rig is not None)
            yield from _numbers(one.from_rig) if one.from_rig else ()


def _text_frame(frame: Frame) -> bytes:
    data = [word for kind, sensor, datum in frame.data for word in (_SENSOR_NAMES[kind], sensor, datum)]
    return _joined(frame.id, frame.rig, *_numbers(frame.pose), len(frame.data), *data)


def _joined(*words: object) -> bytes:
    return " ".join(map(str, words)).encode()
