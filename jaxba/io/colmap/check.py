"""Structure of a COLMAP model: ids, references between files and poses, without which nothing can be computed."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NoReturn

import numpy as np

from jaxba.io.colmap.records import CAMERA_SENSOR, NO_ID, NO_POINT, Camera, Frame, Image, Model, Pose, Rig
from jaxba.problem.bundle_problem import ProblemError


def check_model(model: Model) -> None:
    """Refuses a model whose structure is damaged.

    Raises:
        ProblemError: an id stands for none or is there twice, an image names no camera or a frame no rig, a pose is not
            finite or has no rotation; one line that names the file and the record.
    """
    groups: dict[str, Iterable[Camera | Image | Rig | Frame]] = {
        "cameras": model.cameras.values(),
        "images": model.images.values(),
        "rigs": (model.rigs or {}).values(),
        "frames": (model.frames or {}).values(),
    }
    for part, records in groups.items():
        if any(record.id == NO_ID for record in records):
            _fail(model, part, f"{NO_ID} is the id of no {part[:-1]}")
    _check_points(model)
    for image in model.images.values():
        if image.camera not in model.cameras:
            _fail(model, "images", f"{image}: camera {image.camera} is not in {model.file('cameras')}")
        _check_pose(model, "images", str(image), image.pose)
    for rig in (model.rigs or {}).values():
        for sensor in rig.sensors:
            if sensor.type == CAMERA_SENSOR and sensor.id not in model.cameras:
                _fail(model, "rigs", f"rig {rig.id}: camera {sensor.id} is not in {model.file('cameras')}")
            if sensor.from_rig is not None:
                _check_pose(model, "rigs", f"rig {rig.id}, sensor {sensor.id}", sensor.from_rig)
    _check_frames(model, model.rigs or {}, model.frames or {})


def _check_points(model: Model) -> None:
    ids, counts = np.unique(model.points.heads["id"], return_counts=True)
    if (counts > 1).any():
        _fail(model, "points3D", f"point {ids[counts.argmax()]} is there twice")
    if len(ids) and ids[-1] == NO_POINT:
        _fail(model, "points3D", f"{NO_POINT} is the id of no point")


def _check_frames(model: Model, rigs: dict[int, Rig], frames: dict[int, Frame]) -> None:
    sensors = {rig.id: {(sensor.type, sensor.id) for sensor in rig.sensors} for rig in rigs.values()}
    for frame in frames.values():
        if frame.rig not in rigs:
            _fail(model, "frames", f"frame {frame.id}: rig {frame.rig} is not in {model.file('rigs')}")
        for kind, sensor, datum in frame.data:
            if (kind, sensor) not in sensors[frame.rig]:
                _fail(model, "frames", f"frame {frame.id}: rig {frame.rig} has no sensor {sensor} of datum {datum}")
        for camera, identity in frame.images:
            image = model.images.get(identity)
            if image is not None and image.camera != camera:
                _fail(model, "frames", f"frame {frame.id}: {image} is of camera {image.camera}, not {camera}")
        seen = [str(model.images[image]) for _, image in frame.images[:1] if image in model.images]
        _check_pose(model, "frames", " of ".join([f"frame {frame.id}", *seen]), frame.pose)
    ids = [image for frame in frames.values() for _, image in frame.images]
    if len(set(ids)) < len(ids):
        twice = next(one for number, one in enumerate(sorted(ids)) if one == sorted(ids)[number + 1])
        _fail(model, "frames", f"image {twice} is in two frames")


def _check_pose(model: Model, part: str, record: str, pose: Pose) -> None:
    for field, values in (("qvec", pose.qvec), ("tvec", pose.tvec)):
        if not np.isfinite(values).all():
            _fail(model, part, f"{record}: {field} is not finite: {' '.join(f'{value:g}' for value in values)}")
    if not any(pose.qvec):
        _fail(model, part, f"{record}: qvec is zero, which is no rotation")


def _fail(model: Model, part: str, complaint: str) -> NoReturn:
    raise ProblemError(f"{model.file(part)}: {complaint}")
