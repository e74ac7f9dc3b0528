"""Measured positions of images: tables of flight logs, COLMAP's database, nerfstudio's file, the GPS of photos."""

from __future__ import annotations

import csv
import re
import sqlite3
from collections.abc import Iterable, Sequence
from contextlib import closing
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxba.io.encoding import read_characters
from jaxba.io.files import StrPath, display_name, reason
from jaxba.io.json_records import Record, read_json
from jaxba.io.nerfstudio import IMAGES
from jaxba.io.text import finite_numbers
from jaxba.problem.bundle_problem import ProblemError
from jaxba.problem.geometry import are_rotations

WGS84 = "EPSG:4326"  # what longitudes and latitudes are of, if nothing else is said

COLUMNS = {
    "name": ("image", "filename", "file", "label", "name", "photo", "imagename", "imagefile", "sourcefile"),
    "x": ("x", "easting", "east", "e"),
    "y": ("y", "northing", "north", "n"),
    "longitude": ("longitude", "lon", "lng", "long", "gpslongitude", "xlongitude"),
    "latitude": ("latitude", "lat", "gpslatitude", "ylatitude"),
    "height": ("z", "height", "altitude", "alt", "elevation", "up", "gpsaltitude", "zaltitude", "ellipsoidalheight"),
    "sx": ("sigmax", "sx", "accuracyx", "xaccuracy", "stdx", "stddevx", "sigmaeast", "stdlon", "rtkstdlon"),
    "sy": ("sigmay", "sy", "accuracyy", "yaccuracy", "stdy", "stddevy", "sigmanorth", "stdlat", "rtkstdlat"),
    "sxy": ("accuracyhorizontal", "horizontalaccuracy", "accuracyxy", "xyaccuracy", "hacc", "sigmah", "horizontal"),
    "sz": (
        *("accuracyvertical", "verticalaccuracy", "accuracyz", "zaccuracy", "vacc", "sigmav", "vertical", "sigmaup"),
        *("sigmaz", "sz", "stdz", "stddevz", "stdhgt", "rtkstdhgt"),
    ),
    "s": ("accuracy", "sigma", "stddev", "std", "s"),
}
"""Columns of a table by their names, in letters alone and without units in brackets."""

DEVIATIONS = (("sx", "sy", "sz"), ("sxy", "sxy", "sz"), ("s", "s", "s"))  # columns that say how accurate a position is

GPS, ABOVE_SEA = 0x8825, 5
"""Block of the EXIF data of a photo with its position, and the field that is 1 below sea level."""


class Positions(NamedTuple):
    """Positions of images."""

    names: list[str]
    places: Float[np.ndarray, "n 3"]  # x, y, z, or longitude and latitude (degrees) and height (metres)
    covariances: Float[np.ndarray, "n 3 3"] | None  # along x, y and z, or metres east, north and up; None: not known
    crs: str  # coordinate system; empty: that of the scene


def read_table(path: StrPath) -> Positions:
    """Reads a table with a line of names (`COLUMNS`), between commas, semicolons or tabs. Lines without a place are
    left out. Raises ProblemError: it cannot be read, or a column is missing; one line that names the file and line."""
    file, lines = display_name(path), read_characters(path).split("\n")
    found = next((at for at, line in enumerate(lines) if len(_named(_cells(line))) > 2), None)
    if found is None:
        raise ProblemError(f"{file}: no line names the columns, such as image, latitude, longitude, altitude")
    column = _named(_cells(lines[found]))
    geographic = {"longitude", "latitude"} <= column.keys()
    axes = ("longitude", "latitude", "height") if geographic else ("x", "y", "height")
    if missing := [one for one in ("name", *axes) if one not in column]:
        raise ProblemError(f"{file} line {found + 1}: there is no column {missing[0]}")
    deviations = next((one for one in DEVIATIONS if column.keys() >= set(one)), ())
    names, rows = [], []
    for number, line in enumerate(lines[found + 1 :], found + 2):
        cells = _cells(line, lines[found])
        if line.startswith("#") or not any(cells):
            continue
        if len(cells) <= max(column[one] for one in ("name", *axes, *deviations)):
            raise ProblemError(f"{file} line {number}: has {len(cells)} columns, fewer than the line of names")
        if any(cells[column[one]] for one in axes):
            names.append(cells[column["name"]])
            wanted = (*axes, *deviations)
            rows.append(finite_numbers([cells[column[one]] for one in wanted], wanted, f"{file} line {number}"))
            if min(rows[-1][3:], default=1.0) <= 0:
                raise ProblemError(f"{file} line {number}: an accuracy is not positive")
    if not rows:
        raise ProblemError(f"{file}: has no positions")
    table = np.array(rows)
    covariances = table[:, 3:, None] ** 2 * np.eye(3) if deviations else None
    return Positions(names, table[:, :3], covariances, WGS84 if geographic else "")


def _cells(line: str, of: str | None = None) -> list[str]:
    """The cells of a line, between what separates those of `of`."""
    of = line if of is None else of
    mark = max(",;\t", key=of.count)
    return [cell.strip() for cell in next(csv.reader([line], delimiter=mark), [])]


def _named(cells: Sequence[str]) -> dict[str, int]:
    """The column of each thing that a line of names has."""
    known = {name: what for what, names in COLUMNS.items() for name in names}
    plain = [re.sub(r"[^a-z]", "", re.sub(r"[\[(].*", "", cell.lower())) for cell in cells]
    return {known[name]: at for at, name in reversed([*enumerate(plain)]) if name in known}


def read_database(path: StrPath) -> Positions:
    """Reads the positions of COLMAP's database. Source: COLMAP 4.2, `pose_priors` in database_sqlite.cc; before 4.0 the
    table has the image instead of sensor and data. Raises ProblemError: it is none, or has no positions; one line."""
    file, rows = display_name(path), _pose_priors(path, "position", "position_covariance", "coordinate_system")
    places = np.array([_numbers(row[1], 3) for row in rows]).reshape(-1, 3)
    kept = np.flatnonzero(np.isfinite(places).all(axis=1))
    systems = {rows[at][3] for at in kept}
    if len(systems) != 1:
        raise ProblemError(f"{file}: has {'positions of different coordinate systems' if systems else 'no positions'}")
    covariances = np.array([_numbers(rows[at][2], 9) for at in kept]).reshape(-1, 3, 3)
    known, geographic = np.isfinite(covariances).all(), systems == {0}
    places = places[kept][:, [1, 0, 2]] if geographic else places[kept]
    return Positions([rows[at][0] for at in kept], places, covariances if known else None, WGS84 if geographic else "")


def read_gravity(path: StrPath) -> dict[str, Float[np.ndarray, "3"]]:
    """Reads where up is in images of COLMAP's database, by name, in COLMAP's axes of the camera: the opposite of its
    gravity, which points down. Source: COLMAP 4.2, `SynthesizeDataset`. Raises ProblemError: as `read_database`."""
    priors = [(name, -_numbers(blob, 3)) for name, blob in _pose_priors(path, "gravity")]
    if not (found := {name: up for name, up in priors if np.isfinite(up).all()}):
        raise ProblemError(f"{display_name(path)}: has no directions of gravity")
    return found


def _pose_priors(path: StrPath, *wanted: str) -> list[Any]:
    """Names of images with columns of their priors, which are None where the table does not have them."""
    try:
        with closing(sqlite3.connect(f"{Path(path).resolve().as_uri()}?mode=ro", uri=True)) as base:
            base.text_factory = partial(str, encoding="utf-8", errors="surrogateescape")  # as names in a model
            columns = [row[1] for row in base.execute("PRAGMA table_info(pose_priors)")]
            image, own = ("image_id", "") if "image_id" in columns else ("corr_data_id", "AND corr_sensor_type = 0")
            names = ", ".join(one if one in columns else "NULL" for one in wanted)
            return base.execute(
                f"SELECT name, {names} FROM pose_priors JOIN images "
                f"ON images.image_id = pose_priors.{image} {own} ORDER BY images.image_id"
            ).fetchall()
    except (sqlite3.Error, UnicodeError) as error:  # UnicodeError: of a damaged schema, in SQLite's own message
        raise ProblemError(f"{display_name(path)}: is no database of COLMAP with positions: {reason(error)}") from None


def _numbers(blob: bytes | None, count: int) -> Float[np.ndarray, " count"]:
    return np.frombuffer(blob) if blob and len(blob) == 8 * count else np.full(count, np.nan)


def read_transforms(path: StrPath) -> Positions:
    """Reads the positions of nerfstudio's frames, as phones measure them, in the world before `applied_transform` and
    `applied_scale`. Raises ProblemError: it cannot be read, or has no frames; one line that names the field."""
    document = read_json(path)
    frames = list(document.get("frames").rows())
    if not frames:
        document.fail("has no frames")
    places = np.array([_matrix(frame.get("transform_matrix"))[:, 3] for frame in frames])
    applied = document.get("applied_transform", np.eye(4).tolist())
    turn = _matrix(applied)
    if not are_rotations(turn[None, :, :3])[0]:
        applied.fail("has a rotation that is none")
    places = (places / document.get("applied_scale", 1.0).number() - turn[:, 3]) @ turn[:, :3]
    files = [PurePosixPath(frame.get("file_path").text()).parts for frame in frames]
    return Positions(["/".join(file[file[0] == IMAGES :] if file else ()) for file in files], places, None, "")


def _matrix(record: Record) -> Float[np.ndarray, "3 4"]:
    rows = [row.vector(4) for row in record.rows()]
    if len(rows) not in (3, 4):
        record.fail("must have three or four rows")
    return np.array(rows[:3])


def read_photos(folder: StrPath, names: Iterable[str]) -> Positions:
    """Reads the GPS position of each photo of a folder that has one. Raises ProblemError: none has; one line."""
    from PIL import Image

    found, places = [], []
    for name in names:
        try:
            with Image.open(Path(folder, name)) as image:
                gps = image.getexif().get_ifd(GPS)
            below = gps.get(ABOVE_SEA, 0) in (1, b"\x01")
            place = [_degrees(gps[4], gps[3]), _degrees(gps[2], gps[1]), float(gps[6]) * (-1.0 if below else 1.0)]
        except (OSError, ValueError, KeyError, TypeError, ZeroDivisionError, SyntaxError):
            continue  # not there, no photo, or one without a place
        if np.isfinite(place).all():
            found.append(name)
            places.append(place)
    if not found:
        raise ProblemError(f"{display_name(folder)}: no photo of the model there has a GPS position")
    return Positions(found, np.array(places), None, WGS84)


def _degrees(parts: Any, side: str) -> float:
    whole, minutes, seconds = map(float, parts)
    return (whole + minutes / 60 + seconds / 3600) * (-1.0 if side in ("S", "W") else 1.0)
