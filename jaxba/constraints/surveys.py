"""What a file of constraints says of surveys: positions of images on the earth, and ground control points."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from jaxba import residuals
from jaxba.constraints import marks_fit, values
from jaxba.constraints.measurements import leave_out, parts_of
from jaxba.io.colmap.read import image_sizes, principal_points
from jaxba.io.control_points import read_control_points
from jaxba.io.files import StrPath
from jaxba.io.geodesy import Frame, in_frame, is_geographic
from jaxba.io.notes import report
from jaxba.io.position_tables import Positions
from jaxba.io.positions import read_database, read_file, read_photos
from jaxba.io.tables import has_fix
from jaxba.model.registration import with_residual
from jaxba.problem.alignment import alignment, check_axes, misfit_texts
from jaxba.problem.bundle_problem import BundleProblem
from jaxba.problem.geometry import COLMAP_FLIP, camera_centers
from jaxba.problem.hold import every_lens
from jaxba.problem.losses import Loss
from jaxba.problem.marks import Marks, with_marks
from jaxba.problem.measured import with_position_priors
from jaxba.problem.misfit import on_its_head
from jaxba.problem.similarity import transformed
from jaxba.results.retriangulate import retriangulate

POSITIONS = "positions: {name or id: [x, y, z]}, or file, database or photos; crs, stddev, loss, loss_scale and align"
"""What the key `position_priors` holds."""

ON_ITS_HEAD = (
    "the scene stands on its head, and would fit as well if an axis were mirrored: are two axes swapped, or is one "
    "reversed?"
)
"""Note on places in a plane, which fit a scene that is turned over as well."""

SOURCES = ("file", "database", "photos")  # keys that say where positions are read


def with_positions(
    problem: BundleProblem, where: str, value: Any, strict: bool, frame: Frame | None
) -> tuple[BundleProblem, Frame | None]:
    """The problem with measured positions of images, and the frame of the scene where positions are on the earth. The
    rest is as for `with_measured`."""
    source = next((key for key in SOURCES if isinstance(value, dict) and key in value), None)
    given = _inline(value) if source is None else _read(problem, where, source, value, strict)
    loss = values.parse_loss(value)
    align = values.parse_truth("align", value.get("align", "true"))
    items = [[name] for name in given.names]
    (images,), kept = parts_of(problem, where, "image", items, "positions", strict, table=source is not None)
    crs = given.crs
    if not crs and frame is not None:
        crs = frame.crs
        report([f"{where}: positions are taken as of {crs}, which the scene gets"])
    degrees = given.degrees or (crs != "" and is_geographic(crs))
    chosen = _with_a_place(where, given, images, kept, degrees, strict)
    images, kept = images[chosen], kept[chosen]
    places, covariances = given.places[kept], given.covariances
    report([f"{where}: {note}" for note in given.notes])
    if crs:
        places, frame = in_frame(places, crs, frame, units=given.units, where=where)
        report([f"{where}: the scene is in {frame}"])
    else:
        places = places * np.where(np.isnan(given.units), 1.0, given.units)[[0, 0, 1]]
    assert covariances is not None
    covariances = covariances[kept]
    found = with_position_priors(problem, places, covariances, images=images.tolist(), loss=loss, align=align)
    if align and crs and on_its_head(found):
        centres = camera_centers(found.cameras)[images]
        report([f"{where}: {ON_ITS_HEAD}"] if check_axes(centres, places, covariances) else [])
    return found, frame


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
        raise ValueError(f"no image has a position: all are empty, 0 or impossible, as of {values.names_of(lost)}")
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


def with_control_points(
    problem: BundleProblem, where: str, value: Any, strict: bool, frame: Frame | None, model: StrPath | None
) -> tuple[BundleProblem, Marks]:
    """The problem of a COLMAP model with the marks of a file, at places in the frame of the scene, which is moved there
    unless something else was measured already; and the marks. The rest is as for `with_measured`."""
    values.parse_mapping(value, ["file"], ["check", "pixels", "crs", "stddev", "loss", "loss_scale", "align"])
    bal = every_lens(problem).all_bal
    if problem.labels is None or (bal and model is None):
        raise ValueError("a file of control points needs the COLMAP model of the problem")
    sigma = float(values.parse_numbers("pixels", value.get("pixels", "1"), "a positive number", ()))
    if sigma <= 0:
        raise ValueError(f"pixels: must be a positive number, not {sigma:g}")
    given = read_control_points(values.beside(where, value, "file"))
    stddev = values.parse_stddev(value, given.names, "point")
    checks = values.parse_items(value.get("check", []), "names")
    if unknown := [name for name in checks if name not in given.names]:
        raise ValueError(f"check: there is no point {unknown[0]}; there are {values.names_of(given.names)}")
    crs = _crs(value) or given.crs
    items = [[name] for name in given.images]
    (image,), kept = parts_of(problem, where, "image", items, "pixels", strict, table=True)
    sizes = np.zeros((problem.num_cameras, 2)) if model is None else image_sizes(model, problem.labels.images.tolist())
    clicks = marks_fit.Clicks(image, given.point[kept], given.pixels[kept], sizes[image])
    if (out := marks_fit.outside(clicks, sigma)).any():
        text = marks_fit.outside_text(clicks, out, given.names, problem.labels.names)
        marks_fit.say(where, [f"{text} They are left out"], strict)
        clicks = clicks.of(~out)
    placed = has_fix(given.places, crs != "" and is_geographic(crs))
    images = np.bincount(clicks.mark, minlength=len(given.names))
    used = np.flatnonzero(placed & (images > 1))
    nowhere = [name for name, known in zip(given.names, placed, strict=True) if not known]
    few = [name for name, count, known in zip(given.names, images, placed, strict=True) if known and count < 2]
    if not len(used):
        why = f"no point has a place: {values.names_of(nowhere)}" if not placed.any() else ""
        raise ValueError(why or "no point is in two images of the problem")
    leave_out(where, "point", "{} without a place or height", nowhere, strict)
    leave_out(where, "point", "{} in fewer than two images of the problem", few, strict)
    if crs and frame is None and problem.residuals:
        raise ValueError("the points have a crs, and position_priors have none")
    names = tuple(given.names[at] for at in used)
    check = np.isin(names, checks)
    align = values.parse_truth("align", value.get("align", "true"))
    places = given.places[used]
    alone = check.all() and not problem.residuals
    if alone and not (crs and align):
        report([f"{where}: all are check points, and nothing moves the scene: it is taken to be in their frame"])
    if alone and crs and align:
        report([f"{where}: all are check points and there are no position_priors: nothing moves the scene to {crs}"])
        places = np.full_like(places, np.nan)
    elif crs:
        own = places if check.all() else places[~check]
        places, frame = in_frame(places, crs, frame, origin_of=own, where=where)
        report([] if problem.residuals else [f"{where}: the scene is in {frame}"])
    marks = Marks(names, places, stddev[used], check)
    clicks = clicks.of(np.isin(clicks.mark, used))
    clicks = clicks._replace(mark=np.searchsorted(used, clicks.mark))
    origins = np.zeros((problem.num_cameras, 2))
    if bal and model is not None:
        origins = principal_points(model, problem.labels.images.tolist())

    def observed(pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        return (pixels - origins[clicks.image]) * COLMAP_FLIP[:2] if bal else pixels

    problem = with_marks(problem, clicks.image, clicks.mark, observed(clicks.pixels), sigma, names)
    problem = _where_rays_meet(problem, len(names))
    marks_fit.say(where, marks_fit.pixels_texts(problem, clicks, names, sigma, observed), strict)
    problem, notes = _on_marks(problem, marks, values.parse_loss(value), align)
    marks_fit.say(where, notes, strict)
    return problem, marks


def _where_rays_meet(problem: BundleProblem, count: int) -> BundleProblem:
    """The problem with its last points where their rays meet."""
    first = problem.num_points - count
    alone = np.asarray(problem.point_index) >= first
    seen = np.unique(np.asarray(problem.camera_index)[alone])
    met = retriangulate(problem.subset(alone, seen, np.arange(first, problem.num_points))).problem.points
    return problem.replace(points=np.concatenate([np.asarray(problem.points)[:first], met]))


def _on_marks(problem: BundleProblem, marks: Marks, loss: Loss, align: bool) -> tuple[BundleProblem, list[str]]:
    """The problem with rows of the control points among its marks, moved to these if nothing else placed it, and what
    does not fit before the solve, if `align`. The marks are its last points."""
    first = problem.num_points - len(marks.names)
    control = np.flatnonzero(~marks.check)
    met = np.asarray(problem.points)[first:]
    covariances = marks.stddev[:, :, None] ** 2 * np.eye(3)
    notes: list[str] = []
    if align and problem.residuals:
        notes += marks_fit.places_texts(problem, marks, met)
    elif align and len(control):
        planar = check_axes(met, marks.places, covariances)
        fit, chi = alignment(met[control], marks.places[control], covariances[control])
        problem = transformed(problem, fit)
        away = fit.points(met[control]) - marks.places[control]
        names = [marks.names[at] for at in control]
        notes += misfit_texts(names.__getitem__, "points", away, marks.places[control], covariances[control], chi)
        notes += [ON_ITS_HEAD] if planar and on_its_head(problem) else []
    if not len(control):
        return problem, notes
    whitening = np.eye(3) / marks.stddev[control][:, None]
    rows = residuals.control_point(point=first + control, position=marks.places[control], whitening=whitening)
    return with_residual(problem, replace(rows, aligned=True), loss=loss), notes


def _crs(value: dict[str, Any]) -> str:
    return values.parse_word(value, "crs") if "crs" in value else ""


def _inline(value: Any) -> Positions:
    """Positions in the file of constraints itself; on the earth latitude stands before longitude."""
    items, columns = values.parse_vectors(value, "positions", "image", (), ("align", "crs"))
    crs = _crs(value)
    degrees = crs != "" and is_geographic(crs)
    places = np.array(columns["positions"])[:, [1, 0, 2] if degrees else [0, 1, 2]]
    covariances = columns["stddev"][:, :, None] ** 2 * np.eye(3)
    return Positions([item[0] for item in items], places, covariances, crs, degrees=degrees)


def _read(problem: BundleProblem, where: str, source: str, value: Any, strict: bool) -> Positions:
    """Positions of a file, a database or photos, with the coordinate system and standard deviations of `value`."""
    values.parse_mapping(value, [source], ["crs", "stddev", "loss", "loss_scale", "align"])
    path = values.beside(where, value, source)
    crs = _crs(value)
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
        stddev = values.parse_stddev(value, given.names, "image", partly=given.covariances is not None)
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
    found = read_photos(folder, names)
    leave_out(where, "photo", "{} without a position", sorted({*names} - {*found.names}), strict)
    return found
