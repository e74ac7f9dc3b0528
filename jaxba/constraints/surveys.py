"""What a file of constraints says of surveys: positions of images on the earth, and ground control points."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from jaxba import residuals
from jaxba.constraints import values
from jaxba.constraints.measurements import leave_out, parts_of
from jaxba.io.colmap.read import principal_points
from jaxba.io.control_points import read_control_points
from jaxba.io.files import StrPath
from jaxba.io.geodesy import Frame, in_frame, is_geographic
from jaxba.io.notes import report
from jaxba.io.positions import Positions, read_database, read_photos, read_table, read_transforms
from jaxba.model.registration import with_residual
from jaxba.problem.alignment import alignment
from jaxba.problem.bundle_problem import BundleProblem
from jaxba.problem.geometry import COLMAP_FLIP
from jaxba.problem.hold import every_lens
from jaxba.problem.losses import Loss
from jaxba.problem.marks import Marks, with_marks
from jaxba.problem.measured import with_position_priors
from jaxba.problem.similarity import transformed
from jaxba.results.retriangulate import retriangulate

POSITIONS = "positions: {name or id: [x, y, z]}, or file, database or photos; crs, stddev, loss, loss_scale and align"
"""What the key `position_priors` holds."""

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
    images = np.bincount(given.point[kept], minlength=len(given.names))
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
    seen = np.isin(given.point[kept], used)
    image, pixels = image[seen], given.pixels[kept][seen]
    if bal and model is not None:
        pixels = (pixels - principal_points(model, problem.labels.images[image].tolist())) * COLMAP_FLIP[:2]
    align = values.parse_truth("align", value.get("align", "true")) and not problem.residuals
    of_mark = np.searchsorted(used, given.point[kept][seen])
    problem = with_marks(problem, image, of_mark, pixels, sigma, names)
    return _on_marks(problem, marks, values.parse_loss(value), align), marks


def _on_marks(problem: BundleProblem, marks: Marks, loss: Loss, align: bool) -> BundleProblem:
    """The problem with its marks where their rays meet, moved to the measured places of the control points among them
    if asked for, with the rows of these."""
    first, control = problem.num_points - len(marks.names), np.flatnonzero(~marks.check)
    alone = np.asarray(problem.point_index) >= first
    seen = np.unique(np.asarray(problem.camera_index)[alone])
    met = retriangulate(problem.subset(alone, seen, np.arange(first, problem.num_points))).problem.points
    problem = problem.replace(points=np.concatenate([np.asarray(problem.points)[:first], met]))
    if not len(control):
        return problem
    places, stddev = marks.places[control], marks.stddev[control]
    if align:
        fit, _ = alignment(np.asarray(met)[control], places, stddev[:, :, None] ** 2 * np.eye(3))
        problem = transformed(problem, fit)
    rows = residuals.control_point(point=first + control, position=places, whitening=np.eye(3) / stddev[:, None])
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
