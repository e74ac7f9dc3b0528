"""pycolmap's objects as problems, and what was found back into them.

A `pycolmap.Reconstruction` is written to a temporary folder and read as every COLMAP model is. Source: COLMAP 4.2,
`BundleAdjustmentOptions`, `BundleAdjustmentConfig`."""

from __future__ import annotations

import importlib
import re
import tempfile
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from jaxba.io.colmap import read_colmap, write_colmap
from jaxba.io.pycolmap_options import options_of
from jaxba.problem.bundle_problem import (
    BundleProblem,
    NothingObserved,
    ProblemError,
    ProblemWarning,
)
from jaxba.problem.checks import shown
from jaxba.problem.facing import set_aside, views_behind
from jaxba.problem.gauge import Gauge, fixed_gauge
from jaxba.problem.geometry import residuals
from jaxba.problem.hold import every_lens, hold
from jaxba.problem.labels import Labels
from jaxba.problem.part import part

GAUGES: dict[str, Gauge] = {"TWO_CAMS_FROM_WORLD": "two-cameras", "THREE_POINTS": "three-points"}
"""Gauges by the names that pycolmap has for them."""

OLDEST = "3.12"
"""The first pycolmap with rigs and frames."""


def from_pycolmap(reconstruction: Any, config: Any = None, options: Any = None) -> BundleProblem:
    """The problem of a `pycolmap.Reconstruction`, of pycolmap 3.12 or newer.

    Views of points behind their image are left out, as COLMAP's cost function gives them no residual; a
    `ProblemWarning` names images that face away from most of what they see.

    Args:
        reconstruction: read as `read_colmap` reads its files.
        config: a `pycolmap.BundleAdjustmentConfig`: images, variable and constant points, constant poses, lenses and
            sensors, and the gauge. None: all images, and a free gauge.
        options: a `pycolmap.BundleAdjustmentOptions`, or a dictionary of its values, of which the `refine_` and
            `constant_` options and `min_track_length` count here, and the rest for `jaxba.bundle_adjustment`. None:
            COLMAP's defaults.

    Raises:
        ProblemError: as `read_colmap` and `part`; a `NothingObserved` where no view is left.
        ValueError: `config` names what is not in the problem, or an argument is of another kind."""
    check_reconstruction(reconstruction)
    options = options_of(options)
    problem = chosen_part(whole_problem(reconstruction, options), reconstruction, config, options)
    return constrained(without_views_behind(problem), reconstruction, config, options)


def check_reconstruction(reconstruction: Any) -> None:
    """Raises ValueError: no `pycolmap.Reconstruction`, or one of a pycolmap that is too old; one line."""
    if not hasattr(reconstruction, "write_binary"):
        raise ValueError(f"reconstruction must be a pycolmap.Reconstruction, not {shown(reconstruction)}")
    if not hasattr(reconstruction, "rigs"):
        version = getattr(importlib.import_module("pycolmap"), "__version__", "another")
        raise ValueError(f"this needs pycolmap {OLDEST} or newer, which has rigs; installed is {version}")


def whole_problem(reconstruction: Any, options: Any) -> BundleProblem:
    """The problem of everything in a reconstruction. Raises: as `from_pycolmap`."""
    with tempfile.TemporaryDirectory() as folder:
        reconstruction.write_binary(folder)
        with warnings.catch_warnings(record=True) as notes:
            warnings.simplefilter("always")
            try:
                problem = read_colmap(folder, refine_principal_point=options.refine_principal_point)
            except ProblemError as error:
                raise type(error)(_without_folder(str(error), folder)) from None
    for note in notes:
        warnings.warn(_without_folder(str(note.message), folder), note.category, stacklevel=3)
    return problem


def _without_folder(text: str, folder: str) -> str:
    """A message about a file of a temporary folder as one about the reconstruction."""
    return re.sub(rf"{re.escape(folder)}(/\w+\.bin)?", "the reconstruction", text)


def chosen_part(problem: BundleProblem, reconstruction: Any, config: Any, options: Any) -> BundleProblem:
    """The part of a whole problem that a config means.

    Args:
        problem: everything in the reconstruction, perhaps moved.
        reconstruction: a `pycolmap.Reconstruction`.
        config: a `pycolmap.BundleAdjustmentConfig`, or None.
        options: a `pycolmap.BundleAdjustmentOptions`.

    Raises: as `from_pycolmap`."""
    assert problem.labels is not None
    of_part = {} if config is None else _chosen(problem.labels, reconstruction, config)
    least = getattr(options, "min_track_length", 0)
    if least:
        of_part["min_track"] = least
    return part(problem, **of_part) if of_part else problem


def without_views_behind(problem: BundleProblem) -> BundleProblem:
    """The problem without views of points behind their image, itself if there are none. Raises NothingObserved: no
    other view is there."""
    behind = views_behind(problem)
    if not behind.any():
        return problem
    if behind.all():
        raise NothingObserved("the reconstruction: every point lies behind the images that see it")
    set_aside(problem)  # says which images face away
    return problem.subset(~behind)


def constrained(problem: BundleProblem, reconstruction: Any, config: Any, options: Any) -> BundleProblem:
    """The problem of `chosen_part` with what config and options hold, and in the gauge of the config. Arguments as
    there. Raises: as `from_pycolmap`."""
    labels = problem.labels
    assert labels is not None
    problem = _held(problem, options)
    if config is None:
        return problem
    known = set(labels.images.tolist())
    frames = {*config.constant_rig_from_world_poses}
    of_frames = {image.image_id for image in reconstruction.images.values() if image.frame_id in frames}
    images = labels.positions("image", sorted(known & of_frames))
    if problem.rigs is not None and problem.rigs.free is not None:
        images = images[~np.asarray(problem.rigs.free)[images]]  # those say where their frame is
    lenses = {*config.constant_cam_intrinsics} & set(labels.lenses.tolist())
    sensors = {sensor.id for sensor in config.constant_sensor_from_rig_poses} & set(labels.lenses.tolist())
    points = {*config.constant_points} & set(labels.points.tolist())
    problem = hold(
        problem,
        poses=images,
        points=labels.positions("point", sorted(points)),
        lenses=labels.positions("lens", sorted(lenses)),
        extrinsics=labels.positions("lens", sorted(sensors)),
    )
    return gauged(problem, GAUGES.get(config.fixed_gauge.name, "free"))


def everything(reconstruction: Any) -> Any:
    """The config of all registered images, in the gauge of two cameras, as `pycolmap.bundle_adjustment` has it."""
    pycolmap = importlib.import_module("pycolmap")
    config = pycolmap.BundleAdjustmentConfig()
    for image in reconstruction.reg_image_ids():
        config.add_image(image)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    return config


def any_far_off(problem: BundleProblem, reconstruction: Any) -> bool:
    """Whether a point is seen farther from its pixel than the diagonal of the image, where no step leads it back."""
    assert problem.labels is not None
    cameras = [reconstruction.camera(lens) for lens in problem.labels.lenses.tolist()]
    diagonals = np.array([np.hypot(camera.width, camera.height) for camera in cameras])
    lens = np.asarray(every_lens(problem).index)[problem.camera_index]
    return bool((np.linalg.norm(residuals(problem), axis=1) > diagonals[lens]).any())


def gauged(problem: BundleProblem, gauge: Gauge) -> BundleProblem:
    """The problem in a gauge; without one where it has too few points for that, as COLMAP goes on."""
    try:
        return fixed_gauge(problem, gauge)
    except ProblemError:
        return problem


def _chosen(labels: Labels, reconstruction: Any, config: Any) -> dict[str, Any]:
    """Images and points of a config, as `part` takes them. Raises ValueError: the reconstruction has no such one."""
    if not hasattr(config, "fixed_gauge"):
        raise ValueError(f"config must be a pycolmap.BundleAdjustmentConfig, not {shown(config)}")
    points = {*config.variable_points, *config.constant_points}
    for kind, items in (("image", config.images), ("point3D", points)):
        exists = getattr(reconstruction, f"exists_{kind}")
        lost = [item for item in items if not exists(item)]
        if lost:
            raise ValueError(f"config names {kind} {min(lost)}, which the reconstruction does not have")
    images = set(config.images) & set(labels.images.tolist())
    points &= set(labels.points.tolist())
    return {
        "images": labels.positions("image", sorted(images)),
        "points": labels.positions("point", sorted(points)),
    }


def _held(problem: BundleProblem, options: Any) -> BundleProblem:
    """The problem with constant what options do not refine."""
    groups = {"focal": options.refine_focal_length, "distortion": options.refine_extra_params}
    parts: dict[str, Any] = {"numbers": [name for name, refined in groups.items() if not refined]}
    if not getattr(options, "refine_points3D", True):
        parts["points"] = "all"
    if not options.refine_sensor_from_rig:
        parts["extrinsics"] = "all"
    if not options.refine_rig_from_world:
        parts["poses"] = "frames"
    if getattr(options, "constant_rig_from_world_rotation", False):
        parts["rotations"] = "frames"
    return hold(problem, **parts)


def update(reconstruction: Any, problem: BundleProblem) -> None:
    """Gives a `pycolmap.Reconstruction` the poses, points, lenses and places in rigs of a problem that was made of it,
    and the errors of its points; the rest of it stays. Raises ProblemError: the problem is another one's."""
    import pycolmap

    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore", ProblemWarning)  # said when it was read
        old, new = Path(folder, "old"), Path(folder, "new")
        old.mkdir()
        reconstruction.write_binary(old)
        try:
            write_colmap(problem, new, like=old)
        except ProblemError as error:
            message = str(error).replace(str(new), "the reconstruction").replace(str(old), "this reconstruction")
            raise ProblemError(message) from None
        found = pycolmap.Reconstruction(new)
    for identity, camera in found.cameras.items():
        reconstruction.camera(identity).params = camera.params
    for identity, rig in found.rigs.items():
        for sensor, place in rig.non_ref_sensors.items():
            if place is not None:
                reconstruction.rig(identity).set_sensor_from_rig(sensor, place)
    for identity, frame in found.frames.items():
        if frame.has_pose():
            reconstruction.frame(identity).rig_from_world = frame.rig_from_world
    for identity, point in found.points3D.items():
        own = reconstruction.point3D(identity)
        own.xyz, own.error = np.asarray(point.xyz), point.error
