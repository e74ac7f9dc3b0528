"""The bundle adjustment problem of a COLMAP model, and where its parts stand in the model.

COLMAP's camera looks down +z with y downwards, BAL's down -z with y upwards: poses of a problem are BAL's. Where its
lenses are BAL's, too, its pixels are relative to the principal point, which is not optimised (lenses.py).
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxba.io.colmap import lenses
from jaxba.io.colmap.records import (
    CAMERA_MODELS,
    CAMERA_SENSOR,
    WXYZ,
    XYZW,
    Frame,
    Image,
    Model,
    Pose,
    pose_of,
    quaternions,
)
from jaxba.io.colmap.views import Ordered, Views, find_views, ordered
from jaxba.io.colmap.wording import note
from jaxba.io.files import display_name
from jaxba.problem.bundle_problem import BundleProblem, ProblemError
from jaxba.problem.geometry import COLMAP_FLIP, bal_rotations
from jaxba.problem.rigs import Rigs

_EDGE = 0.01
"""A principal point is at the edge of an image within this fraction of its size."""

_SAME = 1e-6
"""Poses that differ by less, relatively, are the same."""


class Assembled(NamedTuple):
    """A problem, and the records of the model that its parts are of."""

    problem: BundleProblem
    images: list[Image]
    """Those of the problem's cameras."""

    cameras: list[int]
    """Ids of the cameras of the problem's lenses."""

    points: Int[np.ndarray, " points"]
    """Positions in `model.points.heads`."""

    notes: list[str]
    """What was left out or mended, one line each."""


def assemble(model: Model, *, refine_principal_point: bool = False) -> Assembled:
    """The problem of a model.

    Args:
        model: the model.
        refine_principal_point: whether principal points are optimised.

    Raises:
        ProblemError: it is not known where a camera is in its rig, a lens cannot be used, or nothing is observed.
    """
    images, notes = _registered(model)
    table = ordered(model, images)
    for camera in sorted({image.camera for image in images}):
        lenses.check_lens(model, model.cameras[camera])
    views, found = find_views(table)
    views, odd = _finite(table, views)
    notes += found + odd
    if not len(views.key):
        raise ProblemError("; ".join([f"{display_name(model.folder)}: no image sees a point", *notes[:1]]))
    sees = np.bincount(views.image, minlength=len(images)) > 0
    observed = np.bincount(views.point, minlength=len(table.points)) > 0
    blind, unseen = np.flatnonzero(~sees), np.flatnonzero(~observed & lenses.finite_rows(table.points["xyz"]))
    notes += note(model.file("images"), blind, "image", "left out, without observations", lambda at: str(images[at]))
    notes += note(model.file("points3D"), unseen, "point", "left out, seen by no image", table.point_name)
    images = [image for image, kept in zip(images, sees, strict=True) if kept]
    camera_index, point_index = (np.cumsum(sees) - 1)[views.image], (np.cumsum(observed) - 1)[views.point]
    other = [(one, rig) for rig in (model.rigs or {}).values() for one in rig.sensors if one.type != CAMERA_SENSOR]
    sensor = lambda at: f"sensor {other[at][0].id} of rig {other[at][1].id}"
    notes += note(model.file("rigs"), np.arange(len(other)), "sensor", "left out, no camera", sensor)
    points = table.points["xyz"][observed]
    pixels = table.keys["xy"][views.key]
    problem, cameras = _problem(
        model, images, points, pixels, camera_index, point_index, refine_principal_point=refine_principal_point
    )
    return Assembled(problem, images, cameras, table.order[observed], notes)


def hints(model: Model) -> list[str]:
    """What looks wrong in a model, one line each."""
    odd = []
    for camera in model.cameras.values():
        if camera.width and camera.height and CAMERA_MODELS[camera.model].focals:
            at = np.array(lenses.principal_point(camera)) / (float(camera.width), float(camera.height))
            if not ((at >= _EDGE) & (at <= 1 - _EDGE)).all():
                odd.append(camera)

    def place(at: int) -> str:
        x, y = lenses.principal_point(odd[at])
        return f"camera {odd[at].id}: pixel {x:g}, {y:g} of {odd[at].width} x {odd[at].height}"

    notes = note(model.file("cameras"), np.arange(len(odd)), "principal point", "at the edge of the image", place)
    frames = _frames(model)
    posed = lambda one: composed(place_in_rig(model, frames[one.id], one.camera), frames[one.id].pose)
    other = [one for one in model.images.values() if one.id in frames and _differ(one.pose, posed(one))]
    where = f"with another pose than in {model.file('frames')}, which counts"
    return notes + note(model.file("images"), np.arange(len(other)), "image", where, lambda at: str(other[at]))


def _differ(one: Pose, other: Pose) -> bool:
    """Whether two poses are not the same to the digits of a file."""
    if one == other:
        return False
    first, second = quaternions([one, other])
    parallel = abs(first @ second) >= (1 - _SAME) * np.linalg.norm(first) * np.linalg.norm(second)
    return not (parallel and np.allclose(one.tvec, other.tvec, rtol=_SAME, atol=_SAME))


def _frames(model: Model) -> dict[int, Frame]:
    """Frames by the ids of their images."""
    return {image: frame for frame in (model.frames or {}).values() for _, image in frame.images}


def _registered(model: Model) -> tuple[list[Image], list[str]]:
    """Registered images by id, with the poses of their frames, and notes on the others.

    Raises:
        ProblemError: it is not known where a camera is in its rig.
    """
    images = [model.images[identity] for identity in sorted(model.images)]
    frames = _frames(model)
    if model.frames is None:
        return images, []
    away = np.flatnonzero([image.id not in frames for image in images])
    lost = [frame for number, frame in sorted(frames.items()) if number not in model.images]
    notes = note(model.file("images"), away, "image", "left out, without a frame", lambda at: str(images[at]))
    name = lambda at: f"frame {lost[at].id}"
    notes += note(model.file("frames"), np.arange(len(lost)), "frame", "left out, without an image", name)
    posed = [image for image in images if image.id in frames]
    return [
        replace(image, pose=composed(place_in_rig(model, frames[image.id], image.camera), frames[image.id].pose))
        for image in posed
    ], notes


def place_in_rig(model: Model, frame: Frame, camera: int) -> Pose | None:
    """Where a camera is in the rig of a frame; None for the reference sensor.

    Raises:
        ProblemError: it is not known.
    """
    assert model.rigs is not None
    sensors = model.rigs[frame.rig].sensors
    at = next(at for at, one in enumerate(sensors) if (one.type, one.id) == (CAMERA_SENSOR, camera))
    if at and sensors[at].from_rig is None:
        raise ProblemError(f"{model.file('rigs')}: rig {frame.rig}: it is not known where camera {camera} is in it")
    return sensors[at].from_rig if at else None


def composed(outer: Pose | None, inner: Pose) -> Pose:
    """The transform `outer` after `inner`; exactly the inner one for None."""
    if outer is None:
        return inner
    from scipy.spatial.transform import Rotation

    first, second = (Rotation.from_quat(quaternions([pose])[0, XYZW]) for pose in (inner, outer))
    translation = second.apply(inner.tvec) + np.array(outer.tvec)
    return pose_of([*(second * first).as_quat()[WXYZ], *translation])


def inverse(pose: Pose) -> Pose:
    """The inverse transform."""
    from scipy.spatial.transform import Rotation

    back = Rotation.from_quat(quaternions([pose])[0, XYZW]).inv()
    return pose_of([*back.as_quat()[WXYZ], *(-back.apply(pose.tvec))])


def _rigs_of(model: Model, images: list[Image]) -> Rigs | None:
    """The rigs of a problem of these images; None if no two of them are of one frame."""
    frames = _frames(model)
    ids = [frames[image.id].id if image.id in frames else -1 for image in images]
    if model.frames is None or len(set(ids)) == len(ids):
        return None
    from scipy.spatial.transform import Rotation

    places = [place_in_rig(model, frames[image.id], image.camera) for image in images]
    same = pose_of([1, 0, 0, 0, 0, 0, 0])
    poses = [same if place is None else place for place in places]
    flip = np.diag(COLMAP_FLIP)
    rotations = flip @ Rotation.from_quat(quaternions(poses)[:, XYZW]).as_matrix()
    translations = np.array([pose.tvec for pose in poses]) * COLMAP_FLIP
    # a rig whose reference sensor sees nothing has its frames where the first of its other cameras says
    rig, known = [frames[image.id].rig for image in images], {}
    for of_rig, place, image in sorted(zip(rig, places, images, strict=True), key=lambda one: one[2].camera):
        if place is None or of_rig not in known:
            known[of_rig] = None if place is None else image.camera
    free = np.array([p is not None and known[r] != i.camera for r, p, i in zip(rig, places, images, strict=True)])
    frame = np.unique(ids, return_inverse=True)[1].astype(np.int32)
    return Rigs(frame, rotations, translations, free if free.any() else None)


def _finite(table: Ordered, views: Views) -> tuple[Views, list[str]]:
    """Views of finite pixels and points, and notes on the others."""
    model, finite, what = table.model, lenses.finite_rows(table.points["xyz"]), "left out, not finite"
    notes = note(model.file("points3D"), np.flatnonzero(~finite), "point", what, table.point_name)
    views = views.of(finite[views.point])
    visible = lenses.finite_rows(table.keys["xy"][views.key])
    notes += note(model.file("images"), views.key[~visible], "key-point", what, table.key_name)
    return views.of(visible), notes


def _problem(
    model: Model,
    images: list[Image],
    points: Float[np.ndarray, "points 3"],
    pixels: Float[np.ndarray, "observations 2"],
    camera_index: Int[np.ndarray, " observations"],
    point_index: Int[np.ndarray, " observations"],
    *,
    refine_principal_point: bool,
) -> tuple[BundleProblem, list[int]]:
    """The problem, and the ids of the cameras of its lenses."""
    cameras = sorted({image.camera for image in images})
    lens = np.searchsorted(cameras, [image.camera for image in images])
    used = [model.cameras[camera] for camera in cameras]
    intrinsics, of_problem = lenses.lenses_of(used, lens, refine_principal_point=refine_principal_point)
    if of_problem is None or of_problem.all_bal:
        centers = np.array([lenses.principal_point(camera) for camera in used])[lens[camera_index]]
        with np.errstate(over="ignore"):  # what is not finite is refused below
            pixels = (pixels - centers) * COLMAP_FLIP[:2]
    poses = [image.pose for image in images]
    rotations = bal_rotations(quaternions(poses)[:, XYZW])
    translations = np.array([pose.tvec for pose in poses]) * COLMAP_FLIP
    try:
        problem = BundleProblem.create(
            np.hstack([rotations, translations, intrinsics[lens]]),
            points,
            pixels,
            camera_index,
            point_index,
            lenses=of_problem,
        )
    except ProblemError as error:
        raise ProblemError(f"{display_name(model.folder)}: {error}") from error
    return problem.replace(rigs=_rigs_of(model, images)), cameras
