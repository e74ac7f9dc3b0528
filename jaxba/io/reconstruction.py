"""pycolmap's objects as problems, and what was found back into them.

A `pycolmap.Reconstruction` is written to a temporary folder and read as every COLMAP model is. Source: COLMAP 4.2,
`BundleAdjustmentOptions`, `BundleAdjustmentConfig`."""

from __future__ import annotations

import tempfile
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from jaxba.io.colmap import read_colmap, write_colmap
from jaxba.problem.bundle_problem import BundleProblem, ProblemError, ProblemWarning
from jaxba.problem.checks import shown
from jaxba.problem.gauge import Gauge, with_gauge
from jaxba.problem.hold import hold
from jaxba.problem.part import part

GAUGES: dict[str, Gauge] = {"TWO_CAMS_FROM_WORLD": "two-cameras", "THREE_POINTS": "three-points"}
"""Gauges by the names that pycolmap has for them."""


def from_pycolmap(reconstruction: Any, config: Any = None, options: Any = None) -> BundleProblem:
    """The problem of a `pycolmap.Reconstruction`.

    Args:
        reconstruction: read as `read_colmap` reads its files.
        config: a `pycolmap.BundleAdjustmentConfig`: images, variable and constant points, constant poses, lenses and
            sensors, and the gauge. None: all images, and a free gauge.
        options: a `pycolmap.BundleAdjustmentOptions`, of which the `refine_` and `constant_` options and
            `min_track_length` count here, and the rest for `jaxba.bundle_adjustment`. None: COLMAP's defaults.

    Raises ProblemError: as `read_colmap` and `part`; ValueError: `config` names what is not in the problem."""
    if not hasattr(reconstruction, "write_binary"):
        raise ValueError(f"reconstruction must be a pycolmap.Reconstruction, not {shown(reconstruction)}")
    principal = options is not None and options.refine_principal_point
    with tempfile.TemporaryDirectory() as folder:
        reconstruction.write_binary(folder)
        try:
            problem = read_colmap(folder, refine_principal_point=principal)
        except ProblemError as error:
            raise ProblemError(str(error).replace(folder, "the reconstruction")) from None
    assert problem.labels is not None
    labels, of_part, known = problem.labels, {}, set(problem.labels.images.tolist())
    if config is not None:
        for what, items in (("image", config.images), ("point3D", {*config.variable_points, *config.constant_points})):
            if lost := [one for one in items if not getattr(reconstruction, f"exists_{what}")(one)]:
                raise ValueError(f"config names {what} {min(lost)}, which the reconstruction does not have")
        points = {*config.variable_points, *config.constant_points} & set(labels.points.tolist())
        of_part["images"] = labels.positions("image", sorted(known & set(config.images)))
        of_part["points"] = labels.positions("point", sorted(points))
    if options is not None and options.min_track_length:
        of_part["min_track"] = options.min_track_length
    problem = part(problem, **of_part) if of_part else problem
    if options is not None:
        problem = _held(problem, options)
    if config is None:
        return problem
    of_frames = [
        pair.id for one in config.constant_rig_from_world_poses for pair in reconstruction.frame(one).image_ids
    ]
    images = labels.positions("image", sorted(known & set(of_frames)))
    if problem.rigs is not None and problem.rigs.free is not None:
        images = images[~np.asarray(problem.rigs.free)[images]]  # those say where their frame is
    lenses = {*config.constant_cam_intrinsics} & set(labels.lenses.tolist())
    sensors = {sensor.id for sensor in config.constant_sensor_from_rig_poses} & set(labels.lenses.tolist())
    problem = hold(
        problem,
        poses=images,
        points=labels.positions("point", sorted({*config.constant_points} & points)),
        lenses=labels.positions("lens", sorted(lenses)),
        extrinsics=labels.positions("lens", sorted(sensors)),
    )
    return with_gauge(problem, GAUGES.get(config.fixed_gauge.name, "free"))


def _held(problem: BundleProblem, options: Any) -> BundleProblem:
    """The problem with constant what options do not refine."""
    groups = {"focal": options.refine_focal_length, "distortion": options.refine_extra_params}
    parts: dict[str, Any] = {"numbers": [name for name, refined in groups.items() if not refined]}
    if not options.refine_points3D:
        parts["points"] = "all"
    if not options.refine_sensor_from_rig:
        parts["extrinsics"] = "all"
    if not options.refine_rig_from_world:
        parts["poses"] = "frames"
    if options.constant_rig_from_world_rotation:
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
