"""Measured positions of images: tables of flight logs, COLMAP's database, nerfstudio's file, the
GPS of photos."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterable
from contextlib import closing
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxba.io.accuracies import Accuracies, covariances_of, without_accuracy
from jaxba.io.files import StrPath, display_name, reason
from jaxba.io.image_files import files_of_images
from jaxba.io.json_records import Record, read_json
from jaxba.io.nerfstudio import IMAGES
from jaxba.io.position_tables import WGS84, Positions, read_table
from jaxba.problem.bundle_problem import ProblemError
from jaxba.problem.geometry import are_rotations

GPS = 0x8825
ABOVE_SEA = 5
ACCURACY = 31
"""Block of the EXIF data of a photo with its position, and its fields: 1 below sea level, and
GPSHPositioningError, the horizontal accuracy in metres. Source: CIPA DC-008 (EXIF 2.32), section
4.6.6."""


def read_file(path: StrPath, crs_is_geographic: bool | None = None) -> Positions:
    """Positions of nerfstudio's file, or of a table; the rest is as for `read_table`."""
    return (
        read_transforms(path)
        if Path(path).suffix == ".json"
        else read_table(path, crs_is_geographic)
    )


def read_database(path: StrPath) -> Positions:
    """Reads the positions of COLMAP's database. Source: COLMAP 4.2, `pose_priors` in
    database_sqlite.cc; before 4.0 the table has the image instead of sensor and data. Raises
    ProblemError: it is none, or has no positions; one line."""
    file = display_name(path)
    rows = _pose_priors(path, "position", "position_covariance", "coordinate_system")
    places = np.array([_numbers(row[1], 3) for row in rows]).reshape(-1, 3)
    kept = np.flatnonzero(np.isfinite(places).all(axis=1))
    systems = {rows[at][3] for at in kept}
    if len(systems) != 1:
        raise ProblemError(
            f"{file}: has "
            f"{'positions of different coordinate systems' if systems else 'no positions'}"
        )
    covariances = np.array([_numbers(rows[at][2], 9) for at in kept]).reshape(-1, 3, 3)
    names = [rows[at][0] for at in kept]
    geographic = systems == {0}
    places = places[kept][:, [1, 0, 2]] if geographic else places[kept]
    known = np.asarray(np.isfinite(covariances).all(axis=(1, 2)))
    known[known] = np.linalg.eigvalsh(covariances[known])[:, 0] > 0
    notes = ()
    if known.any() and not known.all():
        largest = np.argmax(np.where(known, np.trace(covariances, axis1=1, axis2=2), -np.inf))
        covariances[~known] = covariances[largest]
        notes = (without_accuracy([names[at] for at in np.flatnonzero(~known)], file),)
    crs = WGS84 if geographic else ""
    return Positions(
        names, places, covariances if known.any() else None, crs, notes=notes, degrees=geographic
    )


def read_gravity(path: StrPath) -> dict[str, Float[np.ndarray, "3"]]:
    """Reads where up is in images of COLMAP's database, by name, in COLMAP's axes of the camera:
    the opposite of its gravity, which points down. Source: COLMAP 4.2, `SynthesizeDataset`. Raises
    ProblemError: as `read_database`."""
    priors = [(name, -_numbers(blob, 3)) for name, blob in _pose_priors(path, "gravity")]
    if not (found := {name: up for name, up in priors if np.isfinite(up).all()}):
        raise ProblemError(f"{display_name(path)}: has no directions of gravity")
    return found


def _pose_priors(path: StrPath, *wanted: str) -> list[Any]:
    """Names of images with columns of their priors, which are None where the table does not have
    them."""
    try:
        with closing(sqlite3.connect(f"{Path(path).resolve().as_uri()}?mode=ro", uri=True)) as base:
            # as names in a model
            base.text_factory = partial(str, encoding="utf-8", errors="surrogateescape")
            columns = [row[1] for row in base.execute("PRAGMA table_info(pose_priors)")]
            image, own = (
                ("image_id", "")
                if "image_id" in columns
                else ("corr_data_id", "AND corr_sensor_type = 0")
            )
            names = ", ".join(one if one in columns else "NULL" for one in wanted)
            return base.execute(
                f"SELECT name, {names} FROM pose_priors JOIN images "
                f"ON images.image_id = pose_priors.{image} {own} ORDER BY images.image_id"
            ).fetchall()
    # UnicodeError: of a damaged schema, in SQLite's own message
    except (sqlite3.Error, UnicodeError) as error:
        raise ProblemError(
            f"{display_name(path)}: is no database of COLMAP with positions: {reason(error)}"
        ) from None


def _numbers(blob: bytes | None, count: int) -> Float[np.ndarray, " count"]:
    return np.frombuffer(blob) if blob and len(blob) == 8 * count else np.full(count, np.nan)


def read_transforms(path: StrPath) -> Positions:
    """Reads the positions of nerfstudio's frames, as phones measure them, in the world before
    `applied_transform` and `applied_scale`. Raises ProblemError: it cannot be read, or has no
    frames; one line that names the field."""
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
    return Positions(
        ["/".join(file[file[0] == IMAGES :] if file else ()) for file in files], places, None, ""
    )


def _matrix(record: Record) -> Float[np.ndarray, "3 4"]:
    rows = [row.vector(4) for row in record.rows()]
    if len(rows) not in (3, 4):
        record.fail("must have three or four rows")
    return np.array(rows[:3])


def read_photos(folder: StrPath, names: Iterable[str]) -> Positions:
    """Reads the GPS position of each photo of a folder that has one, by the names of images, which
    photos may have in another case or with another ending. Raises ProblemError: none has; one
    line."""
    found = []
    places = []
    accuracies = []
    names = list(names)
    for name, file in zip(names, files_of_images(folder, names), strict=True):
        place = None if file is None else _place_of(file)
        if place is not None:
            found.append(name)
            places.append(place[:3])
            accuracies.append(str(place[3]))
    if not found:
        raise ProblemError(
            f"{display_name(folder)}: no photo of the model there has a GPS position"
        )
    column = Accuracies("sxy", "GPSHPositioningError", np.nan, accuracies)
    known = [column] if set(accuracies) != {"nan"} else []
    covariances, notes = covariances_of(
        known, (), found, np.ones(len(found), bool), display_name(folder)
    )
    return Positions(found, np.array(places), covariances, WGS84, notes=notes, degrees=True)


def _place_of(photo: Path) -> list[float] | None:
    """Longitude, latitude, height and horizontal accuracy (NaN: not known) of a photo; None: it is
    not there, is no photo, or has no place."""
    from PIL import Image

    try:
        with Image.open(photo) as image:
            gps = image.getexif().get_ifd(GPS)
        below = gps.get(ABOVE_SEA, 0) in (1, b"\x01")
        place = [
            _degrees(gps[4], gps[3]),
            _degrees(gps[2], gps[1]),
            float(gps[6]) * (-1.0 if below else 1.0),
        ]
        accuracy = float(gps.get(ACCURACY, np.nan))
    except (OSError, ValueError, KeyError, TypeError, ZeroDivisionError, SyntaxError):
        return None
    return [*place, accuracy] if np.isfinite(place).all() else None


def _degrees(parts: Any, side: str) -> float:
    whole, minutes, seconds = map(float, parts)
    return (whole + minutes / 60 + seconds / 3600) * (-1.0 if side in ("S", "W") else 1.0)
