"""Measured positions of images in tables: flight logs, exports of other programs, OpenDroneMap's `geo.txt`."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxba.io.encoding import read_characters
from jaxba.io.files import StrPath, display_name
from jaxba.io.geodesy import NOT_SAID, system_of
from jaxba.io.tables import LEAST_POSITIONS, cells_of, file_joined, is_value, plain, separator_of, title_of, value_of
from jaxba.problem.bundle_problem import ProblemError

WGS84 = "EPSG:4326"  # what longitudes and latitudes are of, if nothing else is said

WORDS = {
    "name": "image images imagename imagefile imagefilename imagepath photo photos photoname photofile file filename "
    "filepath label name sourcefile cameralabel cameraname "
    "bild bildname foto",
    "x": "x easting east e xeasting eastingx geox coordx xcoord xcoordinate utmx utmeasting rechtswert",
    "y": "y northing north n ynorthing northingy geoy coordy ycoord ycoordinate utmy utmnorthing hochwert",
    "longitude": "longitude lon lng long gpslongitude xlongitude longitudex geolon",
    "latitude": "latitude lat gpslatitude ylatitude latitudey geolat",
    "height": "z height altitude alt elevation elev up gpsaltitude zaltitude zheight zelevation altitudez geoz coordz "
    "zcoord zcoordinate ellipsoidalheight ellipsoidheight heightellipsoidal altitudeellipsoidal absolutealtitude "
    "höhe",
    "sxy": "horizontal gpshpositioningerror",
    "sz": "vertical",
}
"""Names of the columns of a table, in letters alone and without units."""

ACCURACY = "accuracy acc sigma stddev stdev std sd s precision rms rmse uncertainty"
"""What accuracies are called, before or after what they are of."""

DIRECTIONS = {
    "sx": "x e east easting lon long longitude",
    "sy": "y n north northing lat latitude",
    "sxy": "xy h hor horz horiz horizontal lateral planimetric",
    "sz": "z v ver vert vertical u up height hgt alt altitude elevation elev",
    "s": "xyz d position",  # d: of 3d
}
"""What accuracies are of, by what `Layout` calls these."""

ACCURACIES = ("sx", "sy", "sxy", "sz", "s")

WITHOUT_NAMES = {
    2: ("x", "y"),
    3: ("x", "y", "height"),
    4: ("x", "y", "height", "sxy"),
    5: ("x", "y", "height", "sxy", "sz"),
    6: ("x", "y", "height", "yaw", "pitch", "roll"),
    7: ("x", "y", "height", "yaw", "pitch", "roll", "sxy"),
    8: ("x", "y", "height", "yaw", "pitch", "roll", "sxy", "sz"),
}
"""What follows a name in lines without names of columns, by the number of columns. Source: OpenDroneMap's `geo.txt`
(docs.opendronemap.org/geo); three angles or three numbers more are also what Pix4D writes."""

VERTICAL = 2.0
"""Standard deviation of heights over the horizontal one where it is not known: of RTK 15 mm against 8, of a phone 1.5
to 3 times (data sheets of receivers)."""

LARGEST_SHARE = 0.01  # extent of positions in degrees, over their distance from 0, 0: metres of a scene are not so far

_MAYBE = re.compile(r"accura|sigma|std|uncertain|precision")
_ANGLES = re.compile(r"yaw|pitch|roll|omega|phi|kappa|heading|attitude|rotation|angle|deg")


class Positions(NamedTuple):
    """Positions of images."""

    names: list[str]
    places: Float[np.ndarray, "n 3"]  # x, y, z, or longitude and latitude (degrees) and height; NaN: there is none
    covariances: Float[np.ndarray, "n 3 3"] | None  # along x, y and z, or metres east, north and up; None: not known
    crs: str  # coordinate system; empty: that of the scene
    units: tuple[float, float] = NOT_SAID  # metres of the units of x and y, and of z, if the file says them
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
    """Reads a table with a line of names (`WORDS`), between commas, semicolons, tabs or blanks, or as OpenDroneMap and
    Pix4D write it, without one (`WITHOUT_NAMES`).

    Args:
        path: the file.
        crs_is_geographic: whether positions are longitudes and latitudes, if something else says it.

    Returns:
        Positions, NaN where there is none.

    Raises:
        ProblemError: it cannot be read, or a column is missing; one line that names the file and line."""
    file = display_name(path)
    lines = read_characters(path, otherwise="cp1252").split("\n")  # that of spreadsheets on Windows
    layout = _with_names(lines) or _without_names(lines, file, crs_is_geographic)
    column = layout.columns
    degrees = {"longitude", "latitude"} <= column.keys()
    axes = ("longitude", "latitude", "height") if degrees else ("x", "y", "height")
    if missing := [axis for axis in ("name", *axes) if axis not in column]:
        raise ProblemError(f"{file} line {max(layout.first, 1)}: there is no column {missing[0]}")
    known = [what for what in ACCURACIES if what in column]
    names, places, given = [], [], []
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
    cells_by_kind = {what: [row[at] for row in given] for at, what in enumerate(known)}
    covariances, notes = _covariances(cells_by_kind, layout, names, file)
    crs = layout.crs or (WGS84 if degrees else "")
    return Positions(names, np.array(places), covariances, crs, (units[0], units[2]), notes, degrees)


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
    """The column of each thing that a line of names has, and titles of those that may be accuracies."""
    known = _known_names()
    columns: dict[str, Column] = {}
    unused = []
    for at, title in enumerate(titles):
        name, unit = title_of(title)
        if name in known:
            columns.setdefault(known[name], Column(at, title, unit))
        elif _MAYBE.search(name) and not _ANGLES.search(title.lower()):
            unused.append(title)
    return columns, tuple(unused)


def _known_names() -> dict[str, str]:
    """What columns have, by the letters of their names."""
    known = {word: what for what, words in WORDS.items() for word in words.split()}
    for what, directions in DIRECTIONS.items():
        for accuracy in ACCURACY.split():
            for direction in directions.split():
                named = [f"{accuracy}{direction}", *([f"{direction}{accuracy}"] if accuracy != "s" else [])]
                known |= {before + name: what for name in named for before in ("", "rtk", "gps", "gnss")}
    return known | {accuracy: "s" for accuracy in ACCURACY.split()}


def _without_names(lines: Sequence[str], file: str, crs_is_geographic: bool | None) -> Layout:
    """The layout of a file without names of columns: perhaps a coordinate system, then a name and numbers a line."""
    filled = [at for at, line in enumerate(lines) if line.strip() and not line.lstrip().startswith("#")]
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
    if not crs and _looks_like_degrees([row[:2] for row in values if len(row) > 1], crs_is_geographic, unclear):
        names = ("latitude", "longitude", *names[2:])  # as Pix4D has it
    columns = {name: Column(at, name) for at, name in enumerate(("name", *names))}
    return layout._replace(columns=columns)


def _looks_like_degrees(values: Sequence[Sequence[float]], crs_is_geographic: bool | None, unclear: str) -> bool:
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


def _covariances(
    cells: dict[str, list[str]], layout: Layout, names: Sequence[str], file: str
) -> tuple[Float[np.ndarray, "n 3 3"] | None, tuple[str, ...]]:
    """Covariances by what a table has of accuracies, and notes on what they get where it has none."""
    notes, usable = [], {}
    unused = list(layout.unused)
    for what, column in cells.items():
        unit = layout.columns[what].unit
        deviations = np.array([_accuracy(cell) for cell in column]) * (1.0 if np.isnan(unit) else unit)
        if np.isfinite(deviations).any():
            usable[what] = deviations
        else:
            unused.append(layout.columns[what].title)
    if unused:
        columns = f"column{'s' * (len(unused) > 1)} {', '.join(unused)}"
        notes.append(f"{file}: the accuracies in {columns} are not used")
    if not usable:
        return None, tuple(f"{note}: the standard deviation is 1" for note in notes)
    of_axes = (("sx", "sxy", "s", "sy"), ("sy", "sxy", "s", "sx"), ("sz", "s"))
    table = np.full((len(names), len(of_axes)), np.nan)
    for axis, kinds in enumerate(of_axes):
        for kind in reversed(kinds):
            if kind in usable:
                table[:, axis] = usable[kind]
    return _complete(table, names, file, notes)


def _accuracy(cell: str) -> float:
    """A positive number, or NaN."""
    number = value_of(cell, "accuracy", "") if is_value(cell) else np.nan
    return number if number > 0 else np.nan


def _complete(
    deviations: Float[np.ndarray, "n 3"], names: Sequence[str], file: str, notes: list[str]
) -> tuple[Float[np.ndarray, "n 3 3"], tuple[str, ...]]:
    """Covariances of standard deviations some of which are not known (NaN), with notes on these."""
    known = np.asarray(np.isfinite(deviations).any(axis=0))
    if not known[2]:
        deviations = np.column_stack([deviations[:, :2], VERTICAL * deviations[:, :2].max(axis=1)])
        notes.append(f"{file}: no accuracy of heights: they get {VERTICAL:g} times the horizontal one")
    elif not known[:2].any():
        deviations = np.repeat(deviations[:, 2:], 3, axis=1)
        notes.append(f"{file}: no horizontal accuracy: positions get that of heights")
    missing = ~np.isfinite(deviations)
    deviations = np.where(missing, np.nanmax(deviations, axis=0), deviations)
    if missing.any():
        notes.append(without_accuracy([names[at] for at in np.flatnonzero(missing.any(axis=1)).tolist()], file))
    return deviations[:, :, None] ** 2 * np.eye(3), tuple(notes)


def without_accuracy(names: Sequence[str], file: str) -> str:
    """The note on images whose accuracy is not known."""
    more = f" and {len(names) - 3} more" if len(names) > 3 else ""
    images = f"{len(names)} image{'s' * (len(names) > 1)}"
    return f"{file}: no accuracy of {images}, which get the largest of the others: {', '.join(names[:3])}{more}"
