"""Writes a problem as a COLMAP model: into what another model holds besides, or as one that is like no other."""

from __future__ import annotations

import os
import shutil
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from jaxba.io.colmap import lenses
from jaxba.io.colmap.create import create_model, mean_errors
from jaxba.io.colmap.encode import encode
from jaxba.io.colmap.folder import is_binary, read_model
from jaxba.io.colmap.problem import Assembled, assemble, composed, inverse, place_in_rig
from jaxba.io.colmap.records import (
    CAMERA_MODELS,
    CAMERA_SENSOR,
    WXYZ,
    Camera,
    Frame,
    Model,
    Points,
    Rig,
    Sensor,
    pose_of,
)
from jaxba.io.files import StrPath, display_name, reason
from jaxba.problem import geometry
from jaxba.problem.bundle_problem import BundleProblem, ProblemError
from jaxba.problem.geometry import COLMAP_FLIP, angle_axis, colmap_quaternions


def write_colmap(problem: BundleProblem, folder: StrPath, like: StrPath | None = None) -> None:
    """Writes a problem as a COLMAP model.

    All files are first written to a hidden folder; then each replaces the old one whole. They are binary, or text where
    the other model is text and the folder holds no binary one.

    Without another model, image, camera and point ids count from 1, and images are called `image0001.jpg` and so on.
    Each BAL lens is a RADIAL camera, or SIMPLE_RADIAL or SIMPLE_PINHOLE where k2, or k1 and k2, are zero and constant.
    Its image size is made up: its principal point is the centre of the smallest even size that holds all its pixels,
    which are relative to the upper left corner. Other lenses keep their pixels, models and numbers. Weights, and what
    is constant, cannot be stored.

    Args:
        problem: as `read_colmap` made it from the other model, with optimised cameras and points; any, without one.
        folder: where to write; made if it does not exist, and may be the folder of the other model.
        like: the other model. Poses, points and intrinsics of what is in the problem are replaced, and point errors;
            all else is written as it was read, also what `read_colmap` left out.

    Raises:
        ProblemError: the problem is not one of that model or cannot be stored, images of one camera have different
            intrinsics, or the folder cannot be written.
    """
    if like is None:
        _save(_with_rigs(create_model(problem, display_name(folder))), folder, ".bin")
        return
    model = read_model(like)
    assembled = assemble(model, refine_principal_point=_is_general(problem))
    counts = problem.num_cameras, problem.num_points, problem.num_observations
    old = assembled.problem
    if counts != (old.num_cameras, old.num_points, old.num_observations):
        raise ProblemError(f"cannot write {display_name(folder)}: the problem is not one of {display_name(like)}")
    text = model.suffix == ".txt" and not is_binary(folder)  # COLMAP ignores text files beside a binary model
    _save(_with_rigs(_updated(model, assembled, problem, display_name(folder))), folder, ".txt" if text else ".bin")


def _updated(model: Model, assembled: Assembled, problem: BundleProblem, target: str) -> Model:
    """The model with the numbers of the problem."""
    cameras = np.asarray(problem.cameras, np.float64)
    points = np.asarray(problem.points, np.float64)
    pose_name = lambda at: f"the pose of {assembled.images[at]}"
    point_name = lambda at: f"point {model.points.heads['id'][assembled.points[at]]}"
    for values, name in ((cameras[:, :6], pose_name), (points, point_name)):
        if not (finite := lenses.finite_rows(values)).all():
            raise ProblemError(f"cannot write {target}: {name(int(finite.argmin()))} is not finite")
    new_lenses: dict[int, np.ndarray] = {}
    for number, image in enumerate(assembled.images):
        lens = new_lenses.setdefault(image.camera, cameras[number, 6:])
        if (lens != cameras[number, 6:]).any():
            raise ProblemError(f"cannot write {target}: images of camera {image.camera} have different intrinsics")
    new_cameras = {
        identity: lenses.with_lens(model.cameras[identity], lens, bal=not _is_general(problem))
        for identity, lens in new_lenses.items()
    }
    for camera in new_cameras.values():
        _check_lens(camera, target)
    quaternions = colmap_quaternions(cameras[:, :3])[:, WXYZ]
    poses = [pose_of(row) for row in np.hstack([quaternions, cameras[:, 3:6] * COLMAP_FLIP])]
    same = (cameras[:, :6] == np.asarray(assembled.problem.cameras)[:, :6]).all(axis=1)
    poses = [image.pose if kept else pose for image, pose, kept in zip(assembled.images, poses, same, strict=True)]
    new_images = {
        image.id: replace(model.images[image.id], pose=pose)
        for image, pose in zip(assembled.images, poses, strict=True)
    }
    model = _with_places(model, assembled, problem)
    frames = model.frames
    if frames is not None:
        changed = {image.id for image, kept in zip(assembled.images, same, strict=True) if not kept}
        for frame in model.frames.values() if model.frames is not None else ():
            seen = [(camera, image) for camera, image in frame.images if image in changed]
            if not seen:
                continue
            reference = [pair for pair in frame.images if place_in_rig(model, frame, pair[0]) is None]
            kept = [pair for pair in reference if pair[1] in new_images and pair[1] not in changed]
            # the image of the reference sensor has the frame's pose itself
            camera, image = next(iter([*kept, *(pair for pair in seen if pair in reference), seen[0]]))
            place = place_in_rig(model, frame, camera)
            pose = new_images[image].pose
            moved = pose if place is None else composed(inverse(place), pose)
            frames = {**frames, frame.id: replace(frame, pose=moved)}
            for camera, image in frame.images:  # also of images that see nothing
                if image in model.images:
                    at = composed(place_in_rig(model, frame, camera), moved)
                    new_images[image] = replace(new_images.get(image, model.images[image]), pose=at)
    heads = model.points.heads.copy()
    heads["xyz"][assembled.points] = points
    with np.errstate(over="ignore", invalid="ignore"):
        difference = geometry.project(problem) - np.asarray(problem.observations)
    heads["error"][assembled.points] = mean_errors(difference, np.asarray(problem.point_index), problem.num_points)
    return replace(
        model,
        cameras={**model.cameras, **new_cameras},
        images={**model.images, **new_images},
        points=Points(heads, model.points.tracks),
        frames=frames,
    )


def _with_places(model: Model, assembled: Assembled, problem: BundleProblem) -> Model:
    """The model with its cameras where the problem's rigs have them."""
    old, new = assembled.problem.rigs, problem.rigs
    if old is None or new is None or model.rigs is None:
        return model
    turned = (old.rotation != new.rotation).any(axis=(1, 2))
    if not turned.any() and (old.translation == new.translation).all():
        return model
    quaternions = colmap_quaternions(angle_axis(new.rotation))[:, WXYZ]
    translations = np.asarray(new.translation) * COLMAP_FLIP
    rig_of = {image: frame.rig for frame in (model.frames or {}).values() for _, image in frame.images}
    moved = {
        (rig_of[image.id], image.camera): (pose_of([*quaternion, *translation]), turn)
        for image, quaternion, translation, turn in zip(
            assembled.images, quaternions, translations, turned, strict=True
        )
    }

    def placed(rig: Rig, sensor: Sensor) -> Sensor:
        if sensor.from_rig is None or sensor.type != CAMERA_SENSOR or (rig.id, sensor.id) not in moved:
            return sensor
        pose, turn = moved[rig.id, sensor.id]
        return replace(sensor, from_rig=pose if turn else replace(sensor.from_rig, tvec=pose.tvec))

    rigs = {
        identity: replace(rig, sensors=tuple(placed(rig, sensor) for sensor in rig.sensors))
        for identity, rig in model.rigs.items()
    }
    return replace(model, rigs=rigs)


def _check_lens(camera: Camera, target: str) -> None:
    """Refuses a lens that `read_colmap` would refuse."""
    focals = camera.params[: CAMERA_MODELS[camera.model].focals]
    if not np.isfinite(camera.params).all() or min(focals, default=1.0) <= 0:
        shown = ", ".join(f"{value:g}" for value in camera.params)
        raise ProblemError(f"cannot write {target}: camera {camera.id} would have impossible parameters: {shown}")


def _is_general(problem: BundleProblem) -> bool:
    """Whether a problem's lenses have camera models of their own."""
    return problem.lenses is not None and not problem.lenses.all_bal


def _with_rigs(model: Model) -> Model:
    """The model with a rig of each camera and a frame of each image, as COLMAP reads one without."""
    if model.frames is not None:
        return model
    rigs = {identity: Rig(identity, (Sensor(CAMERA_SENSOR, identity, None),)) for identity in model.cameras}
    frames = {
        image.id: Frame(image.id, image.camera, image.pose, ((CAMERA_SENSOR, image.camera, image.id),))
        for image in model.images.values()
    }
    return replace(model, rigs=rigs, frames=frames)


def _save(model: Model, folder: StrPath, suffix: str) -> None:
    target = Path(folder)
    beside = target if target.is_dir() else target.absolute().parent  # writable, and on the same file system
    try:
        with tempfile.TemporaryDirectory(dir=beside, prefix=".jaxba-") as temporary:
            for name, content in encode(model, suffix):
                (Path(temporary) / name).write_bytes(content)
            target.mkdir(exist_ok=True)
            for file in sorted(Path(temporary).iterdir()):
                place = os.path.realpath(target / file.name)
                if os.path.exists(place):
                    shutil.copymode(place, file)
                os.replace(file, place)
    except (OSError, ValueError, MemoryError) as error:  # ValueError: a name with NUL
        raise ProblemError(f"cannot write {display_name(folder)}: {reason(error)}") from error
