"""The part of a `pycolmap.Reconstruction` that pycolmap's config and options mean, as a problem.

Source: COLMAP 4.2, `BundleAdjustmentOptions`, `BundleAdjustmentConfig`."""

from __future__ import annotations

import importlib
from typing import Any

import numpy as np

from jaxba.io.colmap.memory import NAME, read_part, read_whole
from jaxba.io.colmap.model import Model
from jaxba.io.colmap.read import Assembled, assemble, lens_hints
from jaxba.io.notes import report
from jaxba.problem.bundle_problem import BundleProblem, NothingObserved, ProblemError
from jaxba.problem.checks import shown
from jaxba.problem.facing import set_aside, views_behind
from jaxba.problem.gauge import Gauge, fixed_gauge
from jaxba.problem.hold import hold
from jaxba.problem.part import part

GAUGES: dict[str, Gauge] = {"TWO_CAMS_FROM_WORLD": "two-cameras", "THREE_POINTS": "three-points"}
"""Gauges by the names that pycolmap has for them."""


def chosen_part(reconstruction: Any, config: Any, options: Any) -> BundleProblem:
    """The problem of what a config means of a reconstruction: what its images see, and what others
    see of its points. Those others are constant, and points that are seen by more images, unless
    they are the config's. A ProblemWarning says what was left out.

    Args:
        reconstruction: a `pycolmap.Reconstruction`.
        config: a `pycolmap.BundleAdjustmentConfig`; None: all images and points, all of it
            optimised.
        options: a `pycolmap.BundleAdjustmentOptions`.

    Raises: as `jaxba.from_pycolmap`."""
    least = getattr(options, "min_track_length", 0)
    if config is None:
        return _assembled(read_whole(reconstruction, least), options).problem
    images, points = _chosen(reconstruction, config)
    model = read_part(reconstruction, images, points, least)
    try:
        assembled = _assembled(model, options)
    except NothingObserved:
        raise NothingObserved(f"{NAME}: no observation is left of what the config means") from None
    problem = assembled.problem
    labels = assembled.problem.labels
    assert labels is not None
    whole = np.isin(labels.points, np.array(points, labels.points.dtype))
    problem = part(problem, images=np.isin(labels.images, images), points=whole)
    views = np.bincount(problem.point_index, minlength=problem.num_points)
    return hold(problem, points=(views < model.points["length"][assembled.points]) & ~whole)


def _assembled(model: Model, options: Any) -> Assembled:
    """The problem of a model, with warnings of what was left out, and of what looks wrong."""
    assembled = assemble(model, refine_principal_point=options.refine_principal_point)
    report([*assembled.notes, *lens_hints(model)])
    return assembled


def _chosen(reconstruction: Any, config: Any) -> tuple[list[int], list[int]]:
    """Ids of images and points of a config. Raises ValueError: the reconstruction has no such
    one."""
    if not hasattr(config, "fixed_gauge"):
        raise ValueError(f"config must be a pycolmap.BundleAdjustmentConfig, not {shown(config)}")
    images = sorted(config.images)
    points = sorted({*config.variable_points, *config.constant_points})
    for kind, items in (("image", images), ("point3D", points)):
        exists = getattr(reconstruction, f"exists_{kind}")
        lost = [item for item in items if not exists(item)]
        if lost:
            raise ValueError(
                f"config names {kind} {lost[0]}, which the reconstruction does not have"
            )
    return images, points


def without_views_behind(problem: BundleProblem) -> BundleProblem:
    """The problem without views of points behind their image, itself if there are none. Raises
    NothingObserved: no other view is there."""
    behind = views_behind(problem)
    if not behind.any():
        return problem
    if behind.all():
        raise NothingObserved(f"{NAME}: every point lies behind the images that see it")
    set_aside(problem)  # says which images face away
    return problem.subset(~behind)


def constrained(
    problem: BundleProblem, reconstruction: Any, config: Any, options: Any
) -> BundleProblem:
    """The problem of `chosen_part` with what config and options hold, and in the gauge of the
    config. Arguments as there. Raises: as `from_pycolmap`."""
    labels = problem.labels
    assert labels is not None
    problem = _held(problem, options)
    if config is None:
        return problem
    frames = {*config.constant_rig_from_world_poses}
    held = [reconstruction.image(number).frame_id in frames for number in labels.images.tolist()]
    images = np.flatnonzero(held)
    if problem.rigs is not None and problem.rigs.free is not None:
        images = images[~np.asarray(problem.rigs.free)[images]]  # those say where their frame is
    lenses = {*config.constant_cam_intrinsics} & set(labels.lenses.tolist())
    sensors = {sensor.id for sensor in config.constant_sensor_from_rig_poses} & set(
        labels.lenses.tolist()
    )
    points = {*config.constant_points} & set(labels.points.tolist())
    problem = hold(
        problem,
        poses=images,
        points=labels.positions("point", sorted(points)),
        lenses=labels.positions("lens", sorted(lenses)),
        extrinsics=labels.positions("lens", sorted(sensors)),
    )
    return gauged(problem, GAUGES.get(config.fixed_gauge.name, "free"))


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


def everything(reconstruction: Any) -> Any:
    """The config of all registered images, in the gauge of two cameras, as
    `pycolmap.bundle_adjustment` has it."""
    pycolmap = importlib.import_module("pycolmap")
    config = pycolmap.BundleAdjustmentConfig()
    for image in reconstruction.reg_image_ids():
        config.add_image(image)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    return config


def gauged(problem: BundleProblem, gauge: Gauge) -> BundleProblem:
    """The problem in a gauge; without one where it has too few points for that, as COLMAP goes
    on."""
    try:
        return fixed_gauge(problem, gauge)
    except ProblemError:
        return problem
