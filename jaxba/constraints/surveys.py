"""What a file of constraints says of positions of images, which may be on the earth."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int

from jaxba.constraints import values
from jaxba.constraints.measurements import leave_out, parts_of
from jaxba.io.geodesy import Frame, in_frame, is_geographic
from jaxba.io.notes import report
from jaxba.io.position_tables import Positions
from jaxba.io.positions import read_database, read_file, read_photos
from jaxba.io.tables import has_fix
from jaxba.problem.alignment import check_axes
from jaxba.problem.bundle_problem import BundleProblem
from jaxba.problem.geometry import camera_centers
from jaxba.problem.measured import with_position_priors
from jaxba.problem.misfit import ON_ITS_HEAD, on_its_head

POSITIONS = (
    "positions: {name or id: [x, y, z]}, or file, database or photos; crs, stddev, loss, "
    "loss_scale and align"
)
"""What the key `position_priors` holds."""

SOURCES = ("file", "database", "photos")  # keys that say where positions are read


def with_positions(
    problem: BundleProblem, where: str, value: Any, strict: bool, frame: Frame | None
) -> tuple[BundleProblem, Frame | None]:
    """The problem with measured positions of images, and the frame of the scene where positions are
    on the earth. The rest is as for `with_measured`."""
    source = next((key for key in SOURCES if isinstance(value, dict) and key in value), None)
    given = _inline(value) if source is None else _read(problem, where, source, value, strict)
    loss = values.parse_loss(value)
    align = values.parse_truth("align", value.get("align", "true"))
    items = [[name] for name in given.names]
    (images,), kept = parts_of(
        problem, where, "image", items, "positions", strict, table=source is not None
    )
    crs = given.crs
    if not crs and frame is not None:
        crs = frame.crs
        report([f"{where}: positions are taken as of {crs}, which the scene gets"])
    degrees = given.degrees or (crs != "" and is_geographic(crs))
    chosen = _with_a_place(where, given, images, kept, degrees, strict)
    images = images[chosen]
    kept = kept[chosen]
    places = given.places[kept]
    covariances = given.covariances
    report([f"{where}: {note}" for note in given.notes])
    if crs:
        places, frame = in_frame(places, crs, frame, units=given.units, where=where)
        report([f"{where}: the scene is in {frame}"])
    else:
        places = places * np.where(np.isnan(given.units), 1.0, given.units)[[0, 0, 1]]
    assert covariances is not None
    covariances = covariances[kept]
    problem = with_position_priors(
        problem, places, covariances, images=images.tolist(), loss=loss, align=align
    )
    if align and crs and on_its_head(problem):
        centres = camera_centers(problem.cameras)[images]
        report([f"{where}: {ON_ITS_HEAD}"] if check_axes(centres, places, covariances) else [])
    return problem, frame


def _with_a_place(
    where: str,
    given: Positions,
    images: Int[np.ndarray, " n"],
    rows: Int[np.ndarray, " n"],
    degrees: bool,
    strict: bool,
) -> Int[np.ndarray, " kept"]:
    """Which images have one place. Others are left out with a note.

    Args:
        where: what notes begin with.
        given: positions.
        images: images of the problem.
        rows: which of the positions are theirs.
        degrees: whether they are longitude and latitude.
        strict: whether to refuse what would be left out.

    Returns:
        Which of the images these are.

    Raises:
        ValueError: none has a place, or one has none and `strict`; one line."""
    places = given.places[rows]
    fixed = has_fix(places, degrees)
    lost = [given.names[row] for row in rows[~fixed]]
    if not fixed.any():
        raise ValueError(
            "no image has a position: all are empty, 0 or impossible, as of "
            f"{values.names_of(lost)}"
        )
    leave_out(where, "image", "positions of {} without a fix", lost, strict)
    kept = np.flatnonzero(fixed)
    _, first, inverse = np.unique(images[kept], return_index=True, return_inverse=True)
    kept_first = kept[first]
    differs = (places[kept] != places[kept_first][inverse]).any(axis=1)
    several = np.unique(inverse[differs])
    of_several = [given.names[rows[k]] for k in kept[np.isin(inverse, several)]]
    what = f"positions of {{}} with other ones in another row, in {len(of_several)} rows"
    one_each = [given.names[rows[kept_first[k]]] for k in several]
    leave_out(where, "image", what, one_each, strict)
    return np.sort(np.delete(kept_first, several))


def _inline(value: Any) -> Positions:
    """Positions in the file of constraints itself; on the earth latitude stands before
    longitude."""
    items, columns = values.parse_vectors(value, "positions", "image", (), ("align", "crs"))
    crs = values.parse_crs(value)
    degrees = crs != "" and is_geographic(crs)
    places = np.array(columns["positions"])[:, [1, 0, 2] if degrees else [0, 1, 2]]
    covariances = columns["stddev"][:, :, None] ** 2 * np.eye(3)
    return Positions([item[0] for item in items], places, covariances, crs, degrees=degrees)


def _read(problem: BundleProblem, where: str, source: str, value: Any, strict: bool) -> Positions:
    """Positions of a file, a database or photos, with the coordinate system and standard deviations
    of `value`."""
    values.parse_mapping(value, [source], ["crs", "stddev", "loss", "loss_scale", "align"])
    path = values.beside(where, value, source)
    crs = values.parse_crs(value)
    geographic = is_geographic(crs) if crs else None
    if source == "file":
        given = read_file(path, geographic)
    elif source == "database":
        given = read_database(path)
    else:
        given = _photos(problem, where, path, strict)
    if given.degrees and (crs or given.crs) and not is_geographic(crs or given.crs):
        raise ValueError(f"crs: latitudes and longitudes are not of {crs or given.crs}")
    if "stddev" in value or given.covariances is None:
        stddev = values.parse_stddev(
            value, given.names, "image", partly=given.covariances is not None
        )
        covariances = stddev[:, :, None] ** 2 * np.eye(3)
        if given.covariances is not None:
            covariances = np.where(np.isnan(stddev[:, :1, None]), given.covariances, covariances)
        notes = () if "stddev" in value else given.notes
        given = given._replace(covariances=covariances, notes=notes)
    return given._replace(crs=crs or given.crs)


def _photos(problem: BundleProblem, where: str, folder: Path, strict: bool) -> Positions:
    if problem.labels is None:
        raise ValueError("photos: the problem does not name its images")
    names = problem.labels.names
    positions = read_photos(folder, names)
    leave_out(
        where, "photo", "{} without a position", sorted({*names} - {*positions.names}), strict
    )
    return positions
