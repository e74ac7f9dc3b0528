"""What a file of constraints says of ground control points: places of points, and pixels where
images show them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxba import residuals
from jaxba.constraints import marks_fit, values
from jaxba.constraints.marks_fit import Clicks
from jaxba.constraints.measurements import leave_out, parts_of
from jaxba.io.colmap.read import image_sizes, principal_points
from jaxba.io.control_points import ControlPoints, read_control_points
from jaxba.io.files import StrPath
from jaxba.io.geodesy import Frame, in_frame, is_geographic
from jaxba.io.notes import report
from jaxba.io.tables import has_fix
from jaxba.model.registration import with_residual
from jaxba.problem.alignment import alignment, check_axes, misfit_texts
from jaxba.problem.bundle_problem import BundleProblem
from jaxba.problem.geometry import COLMAP_FLIP
from jaxba.problem.hold import every_lens
from jaxba.problem.labels import Labels
from jaxba.problem.losses import Loss
from jaxba.problem.marks import Marks, with_marks
from jaxba.problem.misfit import ON_ITS_HEAD, on_its_head
from jaxba.problem.similarity import transformed
from jaxba.results.retriangulate import retriangulate

OPTIONS = ("check", "pixels", "crs", "stddev", "loss", "loss_scale", "align")  # keys besides `file`


def with_control_points(
    problem: BundleProblem,
    where: str,
    value: Any,
    strict: bool,
    frame: Frame | None,
    model: StrPath | None,
) -> tuple[BundleProblem, Marks]:
    """The problem of a COLMAP model with the marks of a file, at places in the frame of the scene,
    which is moved there unless something else was measured already; and the marks. The rest is as
    for `with_measured`."""
    values.parse_mapping(value, ["file"], OPTIONS)
    labels = problem.labels
    if labels is None or (every_lens(problem).all_bal and model is None):
        raise ValueError("a file of control points needs the COLMAP model of the problem")
    sigma = _pixel_deviation(value)
    points = read_control_points(values.beside(where, value, "file"))
    stddev = values.parse_stddev(value, points.names, "point")
    checks = _check_names(value, points.names)
    crs = values.parse_crs(value) or points.crs
    clicks = _clicks(problem, labels, where, points, sigma, strict, model)
    used = _usable_points(where, points, clicks, crs, strict)
    if crs and frame is None and problem.residuals:
        raise ValueError("the points have a crs, and position_priors have none")
    names = tuple(points.names[at] for at in used)
    check = np.isin(names, checks)
    align = values.parse_truth("align", value.get("align", "true"))
    places = _places_in_scene(problem, where, points.places[used], check, crs, frame, align)
    marks = Marks(names, places, stddev[used], check)
    clicks = clicks.of(np.isin(clicks.mark, used))
    clicks = clicks._replace(mark=np.searchsorted(used, clicks.mark))
    observed = _observations_of(problem, labels, clicks, model)
    problem = with_marks(problem, clicks.image, clicks.mark, observed(clicks.pixels), sigma, names)
    problem = _where_rays_meet(problem, len(names))
    marks_fit.say(where, marks_fit.pixels_texts(problem, clicks, names, sigma, observed), strict)
    problem, notes = _on_marks(problem, marks, values.parse_loss(value), align)
    marks_fit.say(where, notes, strict)
    return problem, marks


def _pixel_deviation(value: dict[str, Any]) -> float:
    """The standard deviation of pixels. Raises ValueError: it is not positive; one line."""
    sigma = float(values.parse_numbers("pixels", value.get("pixels", "1"), "a positive number", ()))
    if sigma <= 0:
        raise ValueError(f"pixels: must be a positive number, not {sigma:g}")
    return sigma


def _check_names(value: dict[str, Any], names: list[str]) -> list[str]:
    """Names of the check points. Raises ValueError: the file has no such point; one line."""
    checks = values.parse_items(value.get("check", []), "names")
    unknown = [name for name in checks if name not in names]
    if unknown:
        raise ValueError(
            f"check: there is no point {unknown[0]}; there are {values.names_of(names)}"
        )
    return checks


def _clicks(
    problem: BundleProblem,
    labels: Labels,
    where: str,
    points: ControlPoints,
    sigma: float,
    strict: bool,
    model: StrPath | None,
) -> Clicks:
    """The pixels in images of the problem. Those outside their image are left out with a note.

    Args:
        problem: the problem.
        labels: its names of images.
        where: what notes begin with.
        points: what the file has.
        sigma: standard deviation of the pixels.
        strict: whether to refuse what would be left out.
        model: the COLMAP model, which has the sizes of images.

    Raises:
        ValueError: no image is in the problem, or a pixel is left out and `strict`; one line."""
    items = [[name] for name in points.images]
    (image,), kept = parts_of(problem, where, "image", items, "pixels", strict, table=True)
    sizes = np.zeros((problem.num_cameras, 2))
    if model is not None:
        sizes = image_sizes(model, labels.images.tolist())
    clicks = Clicks(image, points.point[kept], points.pixels[kept], sizes[image])
    out = marks_fit.outside(clicks, sigma)
    if not out.any():
        return clicks
    text = marks_fit.outside_text(clicks, out, points.names, labels.names)
    marks_fit.say(where, [f"{text} They are left out"], strict)
    return clicks.of(~out)


def _usable_points(
    where: str, points: ControlPoints, clicks: Clicks, crs: str, strict: bool
) -> Int[np.ndarray, " used"]:
    """Which points have a place, and pixels in two images or more. Others are left out with a note.
    Raises ValueError: none is usable, or one is left out and `strict`; one line."""
    placed = has_fix(points.places, crs != "" and is_geographic(crs))
    images = np.bincount(clicks.mark, minlength=len(points.names))
    used = np.flatnonzero(placed & (images > 1))
    nowhere = [points.names[at] for at in np.flatnonzero(~placed)]
    few = [points.names[at] for at in np.flatnonzero(placed & (images < 2))]
    if not placed.any():
        raise ValueError(f"no point has a place: {values.names_of(nowhere)}")
    if not len(used):
        raise ValueError("no point is in two images of the problem")
    leave_out(where, "point", "{} without a place or height", nowhere, strict)
    leave_out(where, "point", "{} in fewer than two images of the problem", few, strict)
    return used


def _places_in_scene(
    problem: BundleProblem,
    where: str,
    places: Float[np.ndarray, "points 3"],
    check: Bool[np.ndarray, " points"],
    crs: str,
    frame: Frame | None,
    align: bool,
) -> Float[np.ndarray, "points 3"]:
    """Places in the frame of the scene, with a note that says which one it gets; NaN where nothing
    moves it there.

    Args:
        problem: the problem, with residuals if something else was measured.
        where: what notes begin with.
        places: of the points, in the coordinate system.
        check: which are check points.
        crs: the coordinate system; empty: that of the scene.
        frame: the frame of the scene, if positions of images gave it one.
        align: whether the scene is moved to the control points."""
    alone = check.all() and not problem.residuals
    if alone and crs and align:
        report(
            [
                f"{where}: all are check points and there are no position_priors: nothing moves "
                f"the scene to {crs}"
            ]
        )
        return np.full_like(places, np.nan)
    if alone:
        report(
            [
                f"{where}: all are check points, and nothing moves the scene: it is taken to be in "
                "their frame"
            ]
        )
    if not crs:
        return places
    origin_of = places if check.all() else places[~check]
    places, frame = in_frame(places, crs, frame, origin_of=origin_of, where=where)
    if not problem.residuals:
        report([f"{where}: the scene is in {frame}"])
    return places


def _observations_of(
    problem: BundleProblem, labels: Labels, clicks: Clicks, model: StrPath | None
) -> Callable[[Float[np.ndarray, "n 2"]], Float[np.ndarray, "n 2"]]:
    """What makes observations of the problem of pixels, one for each click: those of BAL's lenses
    are from the principal point, y up."""
    if model is None or not every_lens(problem).all_bal:
        return np.asarray
    origins = principal_points(model, labels.images.tolist())[clicks.image]

    def from_principal_point(pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        return (pixels - origins) * COLMAP_FLIP[:2]

    return from_principal_point


def _where_rays_meet(problem: BundleProblem, count: int) -> BundleProblem:
    """The problem with its last points where their rays meet."""
    first = problem.num_points - count
    alone = np.asarray(problem.point_index) >= first
    seen = np.unique(np.asarray(problem.camera_index)[alone])
    met = retriangulate(
        problem.subset(alone, seen, np.arange(first, problem.num_points))
    ).problem.points
    return problem.replace(points=np.concatenate([np.asarray(problem.points)[:first], met]))


def _on_marks(
    problem: BundleProblem, marks: Marks, loss: Loss, align: bool
) -> tuple[BundleProblem, list[str]]:
    """The problem with rows of the control points among its marks, moved to these if nothing else
    placed it, and what does not fit before the solve, if `align`. The marks are its last points."""
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
        notes += misfit_texts(
            names.__getitem__, "points", away, marks.places[control], covariances[control], chi
        )
        notes += [ON_ITS_HEAD] if planar and on_its_head(problem) else []
    if not len(control):
        return problem, notes
    whitening = np.eye(3) / marks.stddev[control][:, None]
    rows = residuals.control_point(
        point=first + control, position=marks.places[control], whitening=whitening
    )
    return with_residual(problem, replace(rows, aligned=True), loss=loss), notes
