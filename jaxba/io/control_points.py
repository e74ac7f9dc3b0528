"""Files of ground control points as OpenDroneMap has them: `gcp_list.txt`."""

from __future__ import annotations

import re
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxba.io.encoding import read_characters
from jaxba.io.files import StrPath, display_name
from jaxba.io.text import finite_numbers
from jaxba.problem.bundle_problem import ProblemError

FIELDS = ("x", "y", "z", "pixel x", "pixel y")  # the numbers at the beginning of each line
LOCAL = "local"  # first line of a file whose coordinates are those of the scene's frame

_UTM = re.compile(r"WGS\s*84\s+UTM\s+(\d{1,2})([NS])?", re.IGNORECASE)


class ControlPoints(NamedTuple):
    """Surveyed points, and where images show them."""

    crs: str  # coordinate system; empty: that of the scene
    names: list[str]  # of points
    places: Float[np.ndarray, "points 3"]  # east, north and height, or longitude, latitude (degrees) and height
    point: Int[np.ndarray, " pixels"]  # the point at each pixel
    images: list[str]  # the image of each pixel
    pixels: Float[np.ndarray, "pixels 2"]  # from the upper left corner, x to the right, y down


def read_control_points(path: StrPath) -> ControlPoints:
    """Reads a file: the coordinate system, then lines `x y z px py image [name]`; `#` begins comments. Lines without a
    name are of one point if their places are the same. Source: docs.opendronemap.org/gcp. Raises ProblemError: it
    cannot be read, or a line is malformed; one line that names the file and line."""
    file, lines = display_name(path), enumerate(read_characters(path).split("\n"), 1)
    given = [(number, line.split()) for number, line in lines if line.split() and not line.lstrip().startswith("#")]
    if len(given) < 2:
        raise ProblemError(f"{file}: has no points")
    (number, first), *given = given
    if len(first) > len(FIELDS) and first[0][0] in "-.0123456789":
        raise ProblemError(f"{file} line {number}: is no coordinate system, such as EPSG:32632")
    names: dict[str, int] = {}
    seen: set[tuple[int, str]] = set()
    places, point, images, pixels = [], [], [], []
    for number, words in given:
        where = f"{file} line {number}"
        if len(words) <= len(FIELDS):
            raise ProblemError(f"{where}: has {len(words)} words, not x y z px py image [name]")
        *place, x, y = finite_numbers(words[:5], FIELDS, where)
        name = words[6] if len(words) > 6 else " ".join(words[:3])
        at = names.setdefault(name, len(names))
        places += [place] if at == len(places) else []
        if places[at] != place:
            raise ProblemError(f"{where}: {name} has another place than before")
        if (at, words[5]) in seen:
            raise ProblemError(f"{where}: {name} is in {display_name(words[5])} twice")
        seen.add((at, words[5]))
        point.append(at)
        images.append(words[5])
        pixels.append([x, y])
    crs = _system(" ".join(first))
    return ControlPoints(crs, list(names), np.array(places), np.array(point), images, np.array(pixels))


def _system(line: str) -> str:
    """The coordinate system of a first line, which may be `WGS84 UTM 32N`."""
    if (found := _UTM.fullmatch(line)) is not None:
        return f"EPSG:{327 if (found[2] or '').upper() == 'S' else 326}{int(found[1]):02d}"
    return "" if line.lower() == LOCAL else line
