"""Files of ground control points as OpenDroneMap has them: `gcp_list.txt`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxba.io.encoding import read_characters
from jaxba.io.files import StrPath, display_name
from jaxba.io.geodesy import system_of
from jaxba.io.tables import cells_of, file_joined, is_file, is_value, separator_of, value_of
from jaxba.problem.bundle_problem import ProblemError

FIELDS = ("x", "y", "z", "pixel x", "pixel y")  # the numbers at the beginning of each line
LOCAL = "local"  # first line of a file whose coordinates are those of the scene's frame
NO_HEIGHT = "nan"  # what a line without a height is read as


class ControlPoints(NamedTuple):
    """Surveyed points, and where images show them."""

    crs: str  # coordinate system; empty: that of the scene
    names: list[str]  # of points
    # east, north, height, or longitude, latitude (degrees), height; or NaN
    places: Float[np.ndarray, "points 3"]
    point: Int[np.ndarray, " pixels"]  # the point at each pixel
    images: list[str]  # the image of each pixel
    pixels: Float[np.ndarray, "pixels 2"]  # from the upper left corner, x to the right, y down


def read_control_points(path: StrPath) -> ControlPoints:
    """Reads a file: the coordinate system, then lines `x y z px py image [name]` between blanks,
    tabs, semicolons or commas; `#` begins comments. Lines without a name are of one point if their
    places are the same. What is missing of a place is NaN. Source: docs.opendronemap.org/gcp.
    Raises ProblemError: it cannot be read, or a line is malformed; one line that names the file and
    line."""
    file = display_name(path)
    lines = enumerate(read_characters(path, otherwise="cp1252").split("\n"), 1)
    given = [
        (number, line.strip())
        for number, line in lines
        if line.strip() and not line.lstrip().startswith("#")
    ]
    if len(given) < 2:
        raise ProblemError(f"{file}: has no points")
    (number, first), *given = given
    if len(first.split()) > len(FIELDS) and first[0] in "-.0123456789":
        raise ProblemError(f"{file} line {number}: is no coordinate system, such as EPSG:32632")
    names: dict[str, int] = {}
    seen: set[tuple[int, str]] = set()
    places = []
    point = []
    images = []
    pixels = []
    for number, line in given:
        where = f"{file} line {number}"
        words = _words(line)
        if number == given[0][0] and not any(map(is_value, words)):
            continue  # names of columns
        if len(words) <= len(FIELDS):
            raise ProblemError(f"{where}: has {len(words)} words, not x y z px py image [name]")
        *place, x, y = (
            value_of(word, field, where) for word, field in zip(words, FIELDS, strict=False)
        )
        if not np.isfinite([x, y]).all():
            raise ProblemError(f"{where}: has no pixel")
        name = words[6] if len(words) > 6 and words[6] else " ".join(words[:3])
        at = names.setdefault(name, len(names))
        places += [place] if at == len(places) else []
        if not np.array_equal(places[at], place, equal_nan=True):
            raise ProblemError(f"{where}: {name} has another place than before")
        if (at, words[5]) in seen:
            raise ProblemError(f"{where}: {name} is in {display_name(words[5])} twice")
        seen.add((at, words[5]))
        point.append(at)
        images.append(words[5])
        pixels.append([x, y])
    if not images:
        raise ProblemError(f"{file}: has no points")
    crs = "" if first.lower() == LOCAL else system_of(first) or first
    return ControlPoints(
        crs, list(names), np.array(places), np.array(point), images, np.array(pixels)
    )


def _words(line: str) -> list[str]:
    """The words of a line, of which the sixth is the image; one without a height gets
    `NO_HEIGHT`."""
    separator = (
        separator_of(line) if separator_of(line) != "," or len(line.split()) < len(FIELDS) else ""
    )
    words = cells_of(line, separator)
    if _numbers(words) == len(FIELDS) - 1 < len(words) and is_file(words[len(FIELDS) - 1]):
        words.insert(2, NO_HEIGHT)
    return words if separator else file_joined(words, len(FIELDS))


def _numbers(words: Sequence[str]) -> int:
    """With how many numbers, also missing ones, words begin."""
    return next((at for at, word in enumerate(words) if not is_value(word)), len(words))
