"""The text files of a COLMAP model.

Comments, empty lines, byte order marks, Windows line ends and blanks at ends do not matter, and a
name is all that follows the ninth field of its line. Numbers are written with as many digits as
reading them back bit by bit needs."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from jaxba.io.colmap import fields
from jaxba.io.colmap.fields import Fields
from jaxba.io.colmap.model import KEY, NO_ID, NO_POINT, POINT, TRACK, Image, Model
from jaxba.io.decimals import number
from jaxba.io.encoding import read_text
from jaxba.io.text import shown_word
from jaxba.problem.bundle_problem import ProblemError

_NAME = len(fields.IMAGE.names)  # fields before the name of an image
_LONGEST = 30  # characters of an integer that is read exactly
_LARGEST = {"B": 255, "I": NO_ID, "Q": NO_POINT}


class _Line:
    """The words of a line, taken one after the other; every error names the line and the field."""

    def __init__(self, place: str, text: bytes, record: str):
        """`record` is what the line holds, such as "camera"."""
        self.place = place
        self.text = text
        self.record = record
        self.rest = text.split()
        self.about = ""  # the record with its id

    def fail(self, complaint: str) -> NoReturn:
        raise ProblemError(f"{self.place}: {self.about}{': ' if self.about else ''}{complaint}")

    def take(self, fields: Fields, what: str = "") -> tuple[Any, ...]:
        if what and len(self.rest) != len(fields.names):
            self.fail(f"{what} has {len(fields.names)} parameters, not {len(self.rest)}")
        return tuple(
            [
                self._value(name, code, fields)
                for name, code in zip(fields.names, fields.codes, strict=True)
            ]
        )

    def count(self, field: str, each: Fields) -> int:
        largest = len(self.rest)  # before the count itself is taken
        return self.numbers([self._word(field)], "I", field, largest)[0]

    def numbers(
        self, words: list[bytes], code: str, field: str, high: int | None = None
    ) -> list[Any]:
        """Words of this line as numbers: floats for the code `d`, which may be infinite or no
        number, else integers in 0..`high` (by default the largest of the code), where -1, COLMAP's
        word for nothing, means `high`."""
        try:
            if b"_" in self.text:  # Python takes 1_000 for a number
                raise ValueError
            values = list(map(float if code == "d" else int, words))
        except ValueError:
            values = [self._number(word, code, field) for word in words]
        if code == "d" or not values:
            return values
        high = _LARGEST[code] if high is None else high
        if min(values) < -1 or max(values) > high:
            bad = next(
                word for word, value in zip(words, values, strict=True) if not -1 <= value <= high
            )
            self.fail(f"{shown_word(bad)} is outside 0..{high} ({field})")
        return [high if value < 0 else value for value in values] if min(values) < 0 else values

    def _number(self, word: bytes, code: str, field: str) -> Any:
        text = word.decode("latin-1")
        if code != "d" and len(text) < _LONGEST and text.removeprefix("-").isdecimal():
            return int(text)  # exact, as those of points have to be
        try:
            value = number(text)
        except ValueError:
            self.fail(f"{shown_word(word)} is not a number ({field})")
        if code != "d" and not value.is_integer():
            self.fail(f"{shown_word(word)} is not an integer ({field})")
        return value if code == "d" else int(value)

    def _value(self, name: str, code: str, of: Fields) -> Any:
        word = self._word(name)
        if code == "i" and of.kinds is not None:
            kind = word.decode("latin-1")
            (known, unknown, _) = of.kinds
            return known[kind] if kind in known else self.fail(f"{kind!a} {unknown}")
        (value,) = self.numbers([word], code, name, of.largest)
        self.about = self.about or f"{self.record} {value}"
        return value

    def _word(self, field: str) -> bytes:
        if not self.rest:
            self.fail(f"the line ends before its {field}")
        return self.rest.pop(0)


def _lines(path: Path, name: str, record: str, *, empty: bool = False) -> Iterator[_Line]:
    """Lines of a file that are no comments, without blanks at their ends; also `empty` ones if
    asked for."""
    for at, line in enumerate(read_text(path).split(b"\n"), 1):
        text = line.strip()
        if (text or empty) and not text.startswith(b"#"):
            yield _Line(f"{name} line {at}", text, record)


def read(part: str, path: Path, name: str) -> dict[int, Any] | tuple[np.ndarray, np.ndarray]:
    """The records of a file by id, in its order; of `points3D` all points and tracks. The line of
    an image's key-points may be empty, and missing in the last. Arguments as for `binary.read`.
    Raises ProblemError: a line cannot be understood; one line that names the file, the line and the
    field."""
    lines = _lines(path, name, part.removesuffix("3D")[:-1], empty=part == "images")
    if part == "points3D":
        return _read_points(lines)
    found = {}
    for line, record in (
        _images(lines) if part == "images" else ((one, fields.READERS[part](one)) for one in lines)
    ):
        if line.rest:
            line.fail(f"{shown_word(line.rest[0])} is left over")
        if record.id in found:
            line.fail("is there twice")
        found[record.id] = record
    return found


def _read_points(lines: Iterator[_Line]) -> tuple[np.ndarray, np.ndarray]:
    heads = []
    tracks = []
    for line in lines:
        identity, x, y, z, red, green, blue, error = line.take(fields.POINT)
        if len(line.rest) % 2:
            line.fail(
                f"the track has {len(line.rest)} numbers, which are no pairs of IMAGE_ID and "
                "POINT2D_IDX"
            )
        track = line.numbers(line.rest, "I", "IMAGE_ID or POINT2D_IDX of the track")
        heads.append((identity, (x, y, z), (red, green, blue), error, len(track) // 2))
        tracks.extend(zip(track[::2], track[1::2], strict=True))
    return np.array(heads, POINT), np.array(tracks, TRACK)


def _images(lines: Iterator[_Line]) -> Iterator[tuple[_Line, Image]]:
    for line in lines:
        if not line.rest:
            continue
        identity, *pose, camera = line.take(fields.IMAGE)
        name = line.text.split(None, _NAME)[_NAME:]
        line.rest = []
        image = Image(identity, tuple(pose), camera, b"".join(name), np.empty(0, KEY))
        below = next(lines, None)
        if below is not None:
            below.about = str(image)
            image = replace(image, keys=_keys(below))
        yield line, image


def _keys(line: _Line) -> np.ndarray:
    words = line.rest
    if len(words) % 3:
        line.fail(f"{len(words)} numbers, which are no key-points of x, y and POINT3D_ID")
    keys = np.empty(len(words) // 3, KEY)
    keys["point"] = np.array(line.numbers(words[2::3], "Q", "POINT3D_ID of a key-point"), np.uint64)
    for axis, field in enumerate("xy"):
        keys["xy"][:, axis] = line.numbers(words[axis::3], "d", f"{field} of a key-point")
    return keys


def encode(model: Model) -> Iterator[tuple[str, Iterable[bytes]]]:
    """Names and contents, in pieces, of the files of a model with rigs and frames."""
    lines = {part: map(_joined, records.values()) for part, records in model.records.items()}
    for part, found in {**lines, "points3D": _point_lines(model)}.items():
        head = f"# {', '.join(fields.FIRST[part].names)}, ...".encode()
        yield f"{part}.txt", (line + b"\n" for line in chain([head], found))


def _joined(record: Any) -> bytes:
    words: list[str] = []
    for of, numbers in fields.values(record):
        kinds = (
            {number: word for word, number in of.kinds[0].items()} if of.kinds is not None else {}
        )
        words += [
            kinds[v] if code == "i" else str(v) for code, v in zip(of.codes, numbers, strict=True)
        ]
    text = " ".join(words).encode()
    if not isinstance(record, Image):
        return text
    x, y = record.keys["xy"].T.tolist()
    points = [-1 if point == NO_POINT else point for point in record.keys["point"].tolist()]
    keys = " ".join([f"{x} {y} {point}" for x, y, point in zip(x, y, points, strict=True)])
    return b"".join([text, b" ", record.name, b"\n", keys.encode()])


def _point_lines(model: Model) -> Iterator[bytes]:
    assert model.tracks is not None
    elements = [f" {image} {key}" for image, key in model.tracks.tolist()]
    at = 0
    columns = (model.points[field].tolist() for field in ("id", "xyz", "rgb", "error", "length"))
    for identity, (x, y, z), (red, green, blue), error, length in zip(*columns, strict=True):
        track = "".join(elements[at : at + length])
        yield f"{identity} {x} {y} {z} {red} {green} {blue} {error}{track}".encode()
        at += length
