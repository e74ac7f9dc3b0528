"""The binary files of a COLMAP model. Counts are held against what is left of a file before they
are used."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from jaxtyping import Bool, Int
from numpy.lib.stride_tricks import sliding_window_view

from jaxba.io.colmap import fields
from jaxba.io.colmap.fields import Fields
from jaxba.io.colmap.model import KEY, POINT, TRACK, Image, Model
from jaxba.io.files import read_bytes
from jaxba.problem.bundle_problem import ProblemError

_COUNT = struct.Struct("<Q")
_BLOCK_POINTS = 1 << 14  # points whose bytes are put in order at once
_LENGTH_AT = POINT.fields["length"][1] if POINT.fields else 0


class _Bytes:
    """The bytes of a file, taken one after the other."""

    def __init__(self, data: bytes, name: str, record: str):
        """`record` is what the file holds, such as "camera"."""
        self.data = data
        self.name = name
        self.at = 0
        self.record = record
        self.about = ""
        self._named = False

    @property
    def left(self) -> int:
        return len(self.data) - self.at

    def fail(self, complaint: str) -> NoReturn:
        raise ProblemError(f"{self.name}{'' if complaint.startswith('is ') else ':'} {complaint}")

    def unpack(self, layout: struct.Struct, where: str) -> tuple[Any, ...]:
        if self.left < layout.size:
            self.fail(f"is cut short in {where}")
        self.at += layout.size
        return layout.unpack_from(self.data, self.at - layout.size)

    def take(self, fields: Fields, what: str = "") -> tuple[Any, ...]:
        values = self.unpack(fields.struct, self.about)
        if not self._named:
            self.about = f"{self.record} {values[0]}"
            self._named = True
        if fields.kinds is not None:
            number = values[fields.codes.index("i")]
            (known, _, unknown) = fields.kinds
            if number not in known.values():
                self.fail(f"{self.about}{unknown.format(number)}")
        return values

    def count(self, field: str, each: Fields) -> int:
        (count,) = self.unpack(fields.COUNT.struct, self.about)
        what = f"{field.removeprefix('number of ')} of {self.about}"
        if count * each.struct.size > self.left:
            self.fail(f"is cut short: {count} {what} do not fit into {self.left} bytes")
        self.about = f"the {what}"
        return count

    def string(self) -> bytes:
        end = self.data.find(b"\0", self.at)
        if end < 0:
            self.fail(f"is cut short in the name of {self.about}")
        value = self.data[self.at : end]
        self.at = end + 1
        return value

    def array(self, dtype: np.dtype, where: str) -> np.ndarray:
        """A count, and as many items."""
        (count,) = self.unpack(_COUNT, f"the number of {where}")
        if count * dtype.itemsize > self.left:
            self.fail(
                f"is cut short: the {where} should have {count}, and {self.left} bytes follow"
            )
        values = np.frombuffer(self.data, dtype, count, self.at)
        self.at += values.nbytes
        return values

    def records(self, smallest: int) -> Iterator[str]:
        """The place of each record of the file, each of at least `smallest` bytes; with the last
        one the file ends."""
        count = self.begin(smallest)
        for number in range(count):
            self.about = f"{self.record} {number + 1} of {count}"
            self._named = False
            yield self.about
        self.end(count)

    def begin(self, smallest: int) -> int:
        """The number of the file's records, each of at least `smallest` bytes."""
        if not self.data:
            self.fail("is empty")
        (count,) = self.unpack(_COUNT, f"the number of {self.record}s")
        if count * smallest > self.left:
            self.fail(
                f"is cut short: {count} {self.record}s do not fit into its {len(self.data)} bytes"
            )
        return count

    def end(self, count: int) -> None:
        """Refuses bytes after the last record."""
        if self.left:
            plural = "" if self.left == 1 else "s"
            self.fail(f"is too long, by {self.left} byte{plural} after {count} {self.record}s")


def read(part: str, path: Path, name: str) -> dict[int, Any] | tuple[np.ndarray, np.ndarray]:
    """The records of a file by id, in its order; of `points3D` all points and tracks. `part` is the
    file's name without its ending; `name` is for messages. Raises ProblemError: the file is cut
    short or too long, or a record cannot be understood; one line that names the file and the
    record."""
    file = _Bytes(read_bytes(path, decompress=False), name, part.removesuffix("3D")[:-1])
    found = {}
    if part == "points3D":
        return _read_points(file)
    first = fields.FIRST[part]
    read_one = fields.READERS.get(part, _read_image)
    for _ in file.records(first.struct.size + (1 + _COUNT.size if first is fields.IMAGE else 0)):
        record = read_one(file)
        if record.id in found:
            file.fail(f"{file.record} {record.id} is there twice")
        found[record.id] = record
    return found


def _read_points(file: _Bytes) -> tuple[np.ndarray, np.ndarray]:
    data = file.data
    count = file.begin(POINT.itemsize)
    length_of = _COUNT.unpack_from
    lengths = np.empty(count, np.int64)
    end = file.at
    first = file.at
    for number in range(count):  # a track's length says where the next point is
        start = end
        if start + POINT.itemsize > len(data):
            file.fail(f"is cut short in {file.record} {number + 1} of {count}")
        (length,) = length_of(data, start + _LENGTH_AT)
        end = start + POINT.itemsize + TRACK.itemsize * length
        if end > len(data):
            file.fail(f"is cut short in the track of point {length_of(data, start)[0]}")
        lengths[number] = length
    file.at = end
    file.end(count)
    points = np.empty(count, POINT)
    tracks = np.empty(lengths.sum(), TRACK)
    for rows, elements, is_head in _blocks(lengths):
        codes = np.frombuffer(data, np.uint8, len(is_head), first)
        points[rows], tracks[elements] = codes[is_head].view(POINT), codes[~is_head].view(TRACK)
        first += len(is_head)
    return points, tracks


def _blocks(
    lengths: Int[np.ndarray, " points"],
) -> Iterator[tuple[slice, slice, Bool[np.ndarray, " bytes"]]]:
    """Some points after the other, given how long their tracks are: which points and track elements
    they are, and which of their bytes are the points', each before its track."""
    at = 0
    for start in range(0, len(lengths), _BLOCK_POINTS):
        length = lengths[start : start + _BLOCK_POINTS]
        size = POINT.itemsize + TRACK.itemsize * length
        is_head = np.zeros(size.sum(), bool)
        sliding_window_view(is_head, POINT.itemsize, writeable=True)[np.cumsum(size) - size] = True
        yield slice(start, start + len(length)), slice(at, at := at + int(length.sum())), is_head


def _read_image(file: _Bytes) -> Image:
    identity, *pose, camera = file.take(fields.IMAGE)
    image = Image(identity, tuple(pose), camera, file.string(), np.empty(0, KEY))
    return replace(image, keys=file.array(KEY, f"key-points of {image}"))


def encode(model: Model) -> Iterator[tuple[str, Iterable[bytes]]]:
    """Names and contents, in pieces, of the files of a model with rigs and frames."""
    for part, records in model.records.items():
        yield f"{part}.bin", chain([_COUNT.pack(len(records))], map(_packed, records.values()))
    yield "points3D.bin", chain([_COUNT.pack(len(model.points))], _packed_points(model))


def _packed(record: Any) -> bytes:
    parts = [of.struct.pack(*numbers) for of, numbers in fields.values(record)]
    if isinstance(record, Image):
        parts += [record.name, b"\0", _COUNT.pack(len(record.keys)), record.keys.tobytes()]
    return b"".join(parts)


def _packed_points(model: Model) -> Iterator[bytes]:
    assert model.tracks is not None
    for rows, elements, is_head in _blocks(model.points["length"].astype(np.int64)):
        codes = np.empty(len(is_head), np.uint8)
        codes[is_head] = np.frombuffer(model.points[rows].tobytes(), np.uint8)
        codes[~is_head] = np.frombuffer(model.tracks[elements].tobytes(), np.uint8)
        yield codes.tobytes()
