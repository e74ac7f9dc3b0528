"""Measured positions of images in tables: flight logs, exports of other programs, OpenDroneMap's
`geo.txt`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxba.io.accuracies import KINDS, Accuracies, covariances_of, kind_of_accuracy, may_be_accuracy
from jaxba.io.encoding import read_characters
from jaxba.io.files import StrPath, display_name
from jaxba.io.geodesy import NOT_SAID, system_of
from jaxba.io.tables import (
    LEAST_POSITIONS,
    cells_of,
    file_joined,
    is_value,
    plain,
    separator_of,
    title_of,
    value_of,
)
from jaxba.problem.bundle_problem import ProblemError

WGS84 = "EPSG:4326"  # what longitudes and latitudes are of, if nothing else is said

WORDS = {
    "name": "image images imagename imagefile imagefilename imagepath photo photos photoname "
    "photofile file filename "
    "filepath label name sourcefile cameralabel cameraname bild bildname foto",
    "x": "x easting east e xeasting eastingx geox coordx xcoord xcoordinate utmx utmeasting "
    "rechtswert",
    "y": "y northing north n ynorthing northingy geoy coordy ycoord ycoordinate utmy utmnorthing "
    "hochwert",
    "longitude": "longitude lon lng long gpslongitude xlongitude longitudex geolon",
    "latitude": "latitude lat gpslatitude ylatitude latitudey geolat",
    "height": "z height altitude alt elevation elev up gpsaltitude zaltitude zheight zelevation "
    "altitudez geoz coordz "
    "zcoord zcoordinate ellipsoidalheight ellipsoidheight heightellipsoidal altitudeellipsoidal "
    "absolutealtitude "
    "höhe",
    "sxy": "horizontal gpshpositioningerror",
    "sz": "vertical",
}
"""Names of the columns of a table, in letters alone and without units."""

WITHOUT_NAMES = {
    2: ("x", "y"),
    3: ("x", "y", "height"),
    4: ("x", "y", "height", "sxy"),
    5: ("x", "y", "height", "sxy", "sz"),
    6: ("x", "y", "height", "yaw", "pitch", "roll"),
    7: ("x", "y", "height", "yaw", "pitch", "roll", "sxy"),
    8: ("x", "y", "height", "yaw", "pitch", "roll", "sxy", "sz"),
}
"""What follows a name in lines without names of columns, by the number of columns. Source:
OpenDroneMap's `geo.txt` (docs.opendronemap.org/geo); three angles or three numbers more are also
what Pix4D writes."""

# extent of positions in degrees, over their distance from 0, 0: metres of a scene are not so far
LARGEST_SHARE = 0.01


class Positions(NamedTuple):
    """Positions of images."""

    names: list[str]
    # x, y, z, or longitude and latitude (degrees) and height; NaN: there is none
    places: Float[np.ndarray, "n 3"]
    # along x, y and z, or metres east, north and up; None: not known
    covariances: Float[np.ndarray, "n 3 3"] | None
    crs: str  # coordinate system; empty: that of the scene
    # metres of the units of x and y, and of z, if the file says them
    units: tuple[float, float] = NOT_SAID
    notes: tuple[str, ...] = ()  # on covariances
    degrees: bool = False  # whether columns are called longitude and latitude


class Column(NamedTuple):
    """Where the values of a kind are."""

    at: int
    title: str  # as the file has it
    unit: float = np.nan  # metres or degrees; NaN: not said


class Layout(NamedTuple):
    """How the lines of a table are read."""

    first: int  # position of the first line of values
    separator: str
    columns: dict[str, Column]
    crs: str = ""
    unused: tuple[str, ...] = ()  # titles of columns that seem to have accuracies


def read_table(path: StrPath, crs_is_geographic: bool | None = None) -> Positions:
    """Reads a table with a line of names (`WORDS`), between commas, semicolons, tabs or blanks, or
    as OpenDroneMap and Pix4D write it, without one (`WITHOUT_NAMES`).

    Args:
        path: the file.
        crs_is_geographic: whether positions are longitudes and latitudes, if something else says
            it.

    Returns:
        Positions, NaN where there is none.

    Raises:
        ProblemError: it cannot be read, or a column is missing; one line that names the file and
            line."""
    file = display_name(path)
    lines = read_characters(path, otherwise="cp1252").split("\n")  # that of spreadsheets on Windows
    layout = _with_names(lines) or _without_names(lines, file, crs_is_geographic)
    column = layout.columns
    degrees = {"longitude", "latitude"} <= column.keys()
    axes = ("longitude", "latitude", "height") if degrees else ("x", "y", "height")
    if missing := [axis for axis in ("name", *axes) if axis not in column]:
        raise ProblemError(f"{file} line {max(layout.first, 1)}: there is no column {missing[0]}")
    known = [what for what in KINDS if what in column]
    names = []
    places = []
    given = []
    for number, line in enumerate(lines[layout.first :], layout.first + 1):
        cells = _row(line, layout)
        if line.lstrip().startswith("#") or not any(cells):
            continue
        cells += [""] * (1 + max(one.at for one in column.values()) - len(cells))
        where = f"{file} line {number}"
        if not cells[column["name"].at]:
            raise ProblemError(f"{where}: names no image")
        names.append(cells[column["name"].at])
        places.append([value_of(plain(cells[column[axis].at]), axis, where) for axis in axes])
        given.append([cells[column[what].at] for what in known])
    if not names:
        raise ProblemError(f"{file}: has no positions")
    units = [column[axis].unit for axis in axes]
    if degrees:
        turns = [1.0 if np.isnan(unit) else unit for unit in units[:2]]
        places = (np.array(places) * [*turns, 1.0]).tolist()
    accuracies = [
        Accuracies(what, column[what].title, column[what].unit, [row[at] for row in given])
        for at, what in enumerate(known)
    ]
    there = np.asarray(np.isfinite(np.array(places)).all(axis=1))
    covariances, notes = covariances_of(accuracies, layout.unused, names, there, file)
    crs = layout.crs or (WGS84 if degrees else "")
    return Positions(
        names, np.array(places), covariances, crs, (units[0], units[2]), notes, degrees
    )


def _with_names(lines: Sequence[str]) -> Layout | None:
    """The layout by the first line that names columns; None: no line does."""
    for at, line in enumerate(lines):
        separator = separator_of(line)
        titles = cells_of(line.lstrip("#").strip(), separator)
        columns, unused = _named(titles)
        if len(columns) > 2:
            systems = [found for before in lines[:at] if (found := system_of(before))]
            return Layout(at + 1, separator, columns, next(iter(systems), ""), unused)
    return None


def _named(titles: Sequence[str]) -> tuple[dict[str, Column], tuple[str, ...]]:
    """The column of each thing that a line of names has, and titles of those that may be
    accuracies."""
    known = {word: what for what, words in WORDS.items() for word in words.split()}
    columns: dict[str, Column] = {}
    unused = []
    for at, title in enumerate(titles):
        name, unit = title_of(title)
        accuracy = kind_of_accuracy(name)
        what = known.get(name) or accuracy
        if may_be_accuracy(title, accuracy):
            unused.append(title)
        elif what:
            columns.setdefault(what, Column(at, title, unit))
    return columns, tuple(unused)


def _without_names(lines: Sequence[str], file: str, crs_is_geographic: bool | None) -> Layout:
    """The layout of a file without names of columns: perhaps a coordinate system, then a name and
    numbers a line."""
    filled = [
        at for at, line in enumerate(lines) if line.strip() and not line.lstrip().startswith("#")
    ]
    unclear = f"{file}: no line names the columns, such as image, latitude, longitude, altitude"
    if not filled:
        raise ProblemError(unclear)
    crs = system_of(lines[filled[0]])
    first = filled[1 if crs and len(filled) > 1 else 0]
    for separator in ("\t", ";", "", ","):
        layout = Layout(first, separator, {"name": Column(0, "name")}, crs)
        values = [_values(_row(lines[at], layout)[1:]) for at in filled if at >= first]
        count = max((len(row) for row in values if row), default=0)
        if count >= (2 if crs else 3):
            break
    else:
        raise ProblemError(unclear)
    names = WITHOUT_NAMES[min(count, max(WITHOUT_NAMES))]
    if not crs and _looks_like_degrees(
        [row[:2] for row in values if len(row) > 1], crs_is_geographic, unclear
    ):
        names = ("latitude", "longitude", *names[2:])  # as Pix4D has it
    columns = {name: Column(at, name) for at, name in enumerate(("name", *names))}
    return layout._replace(columns=columns)


def _looks_like_degrees(
    values: Sequence[Sequence[float]], crs_is_geographic: bool | None, unclear: str
) -> bool:
    """Whether pairs of numbers are degrees. Raises ProblemError: they may be, and may be metres."""
    if crs_is_geographic is not None:
        return crs_is_geographic
    pairs = np.array(values)
    pairs = pairs[np.isfinite(pairs).all(axis=1) & (pairs != 0).any(axis=1)]
    if not len(pairs) or (np.abs(pairs) > [90.0, 180.0]).any():
        return False
    middle = np.median(pairs, axis=0)
    extent = np.linalg.norm(pairs - middle, axis=1).max()
    if len(pairs) < LEAST_POSITIONS or extent > LARGEST_SHARE * np.linalg.norm(middle):
        raise ProblemError(unclear)
    return True


def _row(line: str, layout: Layout) -> list[str]:
    """The cells of a line; between blanks a name goes on as far as its ending."""
    cells = cells_of(line, layout.separator)
    return cells if layout.separator else file_joined(cells, layout.columns["name"].at)


def _values(cells: Sequence[str]) -> list[float]:
    """The values with which cells begin."""
    count = next((at for at, cell in enumerate(cells) if not is_value(cell)), len(cells))
    return [value_of(cell, "value", "") for cell in cells[:count]]
