"""What a file of constraints says of surveys: positions of images on the earth, and ground control points."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxba import residuals
from jaxba.constraints import marks_fit, values
from jaxba.constraints.measurements import leave_out, parts_of
from jaxba.io.colmap.read import image_sizes, principal_points
from jaxba.io.control_points import read_control_points
from jaxba.io.files import StrPath
from jaxba.io.geodesy import Frame, in_frame, is_geographic
from jaxba.io.notes import report
from jaxba.io.positions import Positions, read_database, read_photos, read_table, read_transforms
from jaxba.model.registration import with_residual
from jaxba.problem.alignment import alignment, check_axes, misfit_text
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
    source = next((one for one in SOURCES if isinstance(value, dict) and one in value), None)
    if source is None:
        items, columns = values.parse_vectors(value, "positions", "image", (), ("align", "crs"))
        names, crs = [item[0] for item in items], _crs(value)
        places = np.array(columns["positions"])[:, [1, 0, 2] if crs and is_geographic(crs) else [0, 1, 2]]
        covariances = columns["stddev"][:, :, None] ** 2 * np.eye(3)
    else:
        values.parse_mapping(value, [source], ["crs", "stddev", "loss", "loss_scale", "align"])
        names, places, covariances, crs = _read(problem, where, source, value, strict)
        if crs and "crs" in value and not is_geographic(_crs(value)):
            raise ValueError(f"crs: latitudes and longitudes are not of {_crs(value)}")
        names, crs = _full_names(problem, names), _crs(value) or crs
        if covariances is None or "stddev" in value:
            covariances = values.parse_stddev(value, names, "image")[:, :, None] ** 2 * np.eye(3)
    loss, align = values.parse_loss(value), values.parse_truth("align", value.get("align", "true"))
    at, kept = parts_of(problem, where, "image", [[name] for name in names], "positions", strict)
    places, images = places[kept], at[0].tolist()
    if crs:
        places, frame = in_frame(places, crs, frame)
        report([f"{where}: the scene is in {frame}"])
    found = with_position_priors(problem, places, covariances[kept], images=images, loss=loss, align=align)
    if align and crs and on_its_head(found):
        centres = camera_centers(found.cameras)[images]
        report([f"{where}: {ON_ITS_HEAD}"] if check_axes(centres, places, covariances[kept]) else [])
    return found, frame


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
    items = [[name] for name in _full_names(problem, given.images)]
    (image,), kept = parts_of(problem, where, "image", items, "pixels", strict)
    sizes = np.zeros((problem.num_cameras, 2)) if model is None else image_sizes(model, problem.labels.images.tolist())
    clicks = marks_fit.Clicks(image, given.point[kept], given.pixels[kept], sizes[image])
    if (out := marks_fit.outside(clicks, sigma)).any():
        text = marks_fit.outside_text(clicks, out, given.names, problem.labels.names)
        if strict:
            raise ValueError(text)
        report([f"{where}: {text} They are left out"])
        clicks = clicks.of(~out)
    images = np.bincount(clicks.mark, minlength=len(given.names))
    used = np.flatnonzero(images > 1)
    few = [name for name, count in zip(given.names, images, strict=True) if count < 2]
    if not len(used):
        raise ValueError("no point is in two images of the problem")
    leave_out(where, "point", "{} in fewer than two images of the problem", few, strict)
    places, crs = given.places[used], _crs(value) or given.crs
    if crs and frame is None and problem.residuals:
        raise ValueError("the points have a crs, and position_priors have none")
    if crs:
        places, found = in_frame(places, crs, frame)
        report([] if problem.residuals else [f"{where}: the scene is in {found}"])
    names = tuple(given.names[at] for at in used)
    marks = Marks(names, places, stddev[used], np.isin(names, checks))
    clicks = clicks.of(np.isin(clicks.mark, used))
    clicks = clicks._replace(mark=np.searchsorted(used, clicks.mark))
    origins = np.zeros((problem.num_cameras, 2))
    if bal and model is not None:
        origins = principal_points(model, problem.labels.images.tolist())

    def observed(pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        return (pixels - origins[clicks.image]) * COLMAP_FLIP[:2] if bal else pixels

    align = values.parse_truth("align", value.get("align", "true"))
    problem = with_marks(problem, clicks.image, clicks.mark, observed(clicks.pixels), sigma, names)
    problem = _where_rays_meet(problem, len(names))
    marks_fit.check_pixels(where, problem, clicks, names, sigma, observed)
    return _on_marks(where, problem, marks, values.parse_loss(value), align), marks


def _where_rays_meet(problem: BundleProblem, count: int) -> BundleProblem:
    """The problem with its last points where their rays meet."""
    first = problem.num_points - count
    alone = np.asarray(problem.point_index) >= first
    seen = np.unique(np.asarray(problem.camera_index)[alone])
    met = retriangulate(problem.subset(alone, seen, np.arange(first, problem.num_points))).problem.points
    return problem.replace(points=np.concatenate([np.asarray(problem.points)[:first], met]))


def _on_marks(where: str, problem: BundleProblem, marks: Marks, loss: Loss, align: bool) -> BundleProblem:
    """The problem with rows of the control points among its marks, moved to these if nothing else placed it.

    Args:
        where: file and key, for notes.
        problem: with the marks as its last points.
        marks: these.
        loss: of the rows.
        align: whether the problem may be moved, and what does not fit before the solve is said."""
    first = problem.num_points - len(marks.names)
    control = np.flatnonzero(~marks.check)
    met = np.asarray(problem.points)[first:]
    covariances = marks.stddev[:, :, None] ** 2 * np.eye(3)
    notes = []
    if align and problem.residuals:
        notes.append(marks_fit.places_text(problem, marks, met))
    elif align and len(control):
        planar = check_axes(met, marks.places, covariances)
        fit, chi = alignment(met[control], marks.places[control], covariances[control])
        problem = transformed(problem, fit)
        away = fit.points(met[control]) - marks.places[control]
        names = [marks.names[at] for at in control]
        notes.append(misfit_text(names.__getitem__, "points", away, marks.places[control], covariances[control], chi))
        if planar and on_its_head(problem):
            notes.append(ON_ITS_HEAD)
    report([f"{where}: {text}" for text in notes if text])
    if not len(control):
        return problem
    whitening = np.eye(3) / marks.stddev[control][:, None]
    rows = residuals.control_point(point=first + control, position=marks.places[control], whitening=whitening)
    return with_residual(problem, rows, loss=loss)


def _full_names(problem: BundleProblem, names: list[str]) -> list[str]:
    """Names of images where one without its folder means the only image of that name."""
    known = () if problem.labels is None else problem.labels.names
    counts = Counter(Path(name).name for name in known)
    full = {base: name for name in known if counts[base := Path(name).name] == 1} | {name: name for name in known}
    return [full.get(name) or full.get(Path(name).name, name) for name in names]


def _crs(value: dict[str, Any]) -> str:
    return values.parse_word(value, "crs") if "crs" in value else ""


def _read(problem: BundleProblem, where: str, source: str, value: Any, strict: bool) -> Positions:
    path = values.beside(where, value, source)
    if source != "photos":
        of_file = read_transforms if path.suffix == ".json" else read_table
        return (of_file if source == "file" else read_database)(path)
    if problem.labels is None:
        raise ValueError("photos: the problem does not name its images")
    found = read_photos(path, names := problem.labels.names)
    others = sorted({*names} - {*found.names})
    leave_out(where, "photo", "{} without a position", others, strict)
    return found
