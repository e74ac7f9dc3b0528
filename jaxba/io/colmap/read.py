"""Reads COLMAP models as problems, and says where the parts of a problem stand in its model.

Where the lenses of a problem are BAL's, its pixels are relative to the principal point, which is
not optimised."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int, UInt8

from jaxba.io.colmap import lenses
from jaxba.io.colmap.files import read_model
from jaxba.io.colmap.model import CAMERA_SENSOR, Camera, Frame, Image, Model
from jaxba.io.colmap.observations import Ordered, Views, find_views, ordered
from jaxba.io.colmap.poses import Pose, bal_poses, composed, differ, rotations, translations
from jaxba.io.files import StrPath, display_name
from jaxba.io.notes import counted, report
from jaxba.problem.bundle_problem import BundleProblem, NothingObserved, ProblemError
from jaxba.problem.geometry import COLMAP_FLIP
from jaxba.problem.labels import Labels
from jaxba.problem.rigs import Rigs

_EDGE = 0.01  # a principal point is at the edge of an image within this fraction of its size


class Assembled(NamedTuple):
    """A problem, and the records of the model that its parts are of."""

    problem: BundleProblem
    images: list[Image]  # those of the problem's cameras
    points: Int[np.ndarray, " points"]  # positions in `model.points`
    # key-points of the observations, by their positions in their images
    keys: Int[np.ndarray, " observations"]
    notes: list[str]  # what was left out or mended, one line each


class Looks(NamedTuple):
    """What a model holds for looking at, in the order of the problem."""

    colours: UInt8[np.ndarray, "points 3"] | None  # red, green and blue of points, if known
    # width and height of images, pixels; 0 where they are not known
    sizes: Float[np.ndarray, "cameras 2"]
    principal: Float[np.ndarray, "cameras 2"]  # principal points, pixels from the upper left corner


def read_colmap(
    folder: StrPath, *, strict: bool = False, refine_principal_point: bool = False
) -> BundleProblem:
    """Reads a COLMAP model, binary or text.

    Cameras are the registered images, by id, and points are sorted by id. Lenses keep their camera
    models and numbers; as in COLMAP, focal lengths and distortion are optimised, shared by the
    images of a camera. If all are SIMPLE_PINHOLE, SIMPLE_RADIAL or RADIAL and principal points
    stay, they become BAL's lenses, which are faster. Images of one frame of a rig move together.
    Where cameras are in their rigs is optimised, but for the reference sensor, and in rigs whose
    reference sensor sees nothing.

    What is wrong with one view, point or image only is left out, and a `ProblemWarning` says what
    and how many. `strict` refuses a model of which a part would be left out.
    `refine_principal_point` optimises principal points, too; COLMAP's default is no. Raises
    ProblemError: no model, one whose structure is damaged, a rig that does not say where a camera
    is, nothing is observed, or a part would be left out and `strict`; one line that names the file,
    and the record by its id."""
    model = read_model(folder)
    assembled = assemble(model, refine_principal_point=refine_principal_point)
    report(assembled.notes, strict=strict)
    report([*lens_hints(model), *_pose_hints(model)])
    return assembled.problem


def read_colmap_with_looks(folder: StrPath) -> tuple[BundleProblem, Looks]:
    """`read_colmap`, and the looks. Raises as it does."""
    model = read_model(folder)
    assembled = assemble(model)
    report(assembled.notes, strict=False)
    cameras = [model.cameras[image.camera] for image in assembled.images]
    sizes = np.array([(one.width, one.height) for one in cameras], np.float64)
    found = [one.principal_point if one.focals else (np.nan, np.nan) for one in cameras]
    principal = np.where(np.isnan(found), sizes / 2, found)  # a panorama has its own in the middle
    return assembled.problem, Looks(model.points["rgb"][assembled.points], sizes, principal)


def principal_points(folder: StrPath, images: Iterable[int]) -> Float[np.ndarray, "n 2"]:
    """Principal points of images by id, pixels from the upper left corner. Raises ProblemError: as
    `read_colmap`."""
    model = read_model(folder)
    return np.array([model.cameras[model.images[image].camera].principal_point for image in images])


def image_sizes(folder: StrPath, images: Iterable[int]) -> Float[np.ndarray, "n 2"]:
    """Width and height of images by id, pixels. Raises ProblemError: as `read_colmap`."""
    model = read_model(folder)
    cameras = [model.cameras[model.images[image].camera] for image in images]
    return np.array([(camera.width, camera.height) for camera in cameras], np.float64).reshape(
        -1, 2
    )


def assemble(model: Model, *, refine_principal_point: bool = False) -> Assembled:
    """The problem of a model, whose principal points are optimised if asked for. Raises
    ProblemError: it is not known where a camera is in its rig, a lens cannot be used, or nothing is
    observed."""
    images, notes = registered(model)
    table = ordered(model, images)
    for camera in sorted({image.camera for image in images}):
        if wrong := model.cameras[camera].impossible:
            raise ProblemError(
                f"{model.file('cameras')}: camera {camera} has impossible parameters: {wrong}"
            )
    views, found = find_views(table)
    views, odd = _finite(table, views)
    notes += found + odd
    if not views.size:
        raise NothingObserved(
            "; ".join([f"{display_name(model.folder)}: no image sees a point", *notes[:1]])
        )
    sees = np.bincount(views[0], minlength=len(images)) > 0
    observed = np.bincount(views[2], minlength=len(table.points)) > 0
    unseen = np.flatnonzero(~observed & np.isfinite(table.points["xyz"]).all(axis=1))
    seeing, blind = (
        [one for one, kept in zip(images, mask, strict=True) if kept] for mask in (sees, ~sees)
    )
    other = [
        (one, rig)
        for rig in (model.rigs or {}).values()
        for one in rig.sensors
        if one.type != CAMERA_SENSOR
    ]

    def name(pair):
        return f"sensor {pair[0].id} of rig {pair[1].id}"

    notes += counted(model.file("images"), blind, "image", "left out, without observations")
    notes += counted(
        model.file("points3D"), unseen, "point", "left out, seen by no image", table.point_name
    )
    notes += counted(model.file("rigs"), other, "sensor", "left out, no camera", name)
    keys = views[1] - table.first_key[views[0]]
    for row, kept in ((0, sees), (2, observed)):
        if not kept.all():
            views[row] = (np.cumsum(kept, dtype=np.int32) - 1)[views[row]]
    points = table.order[observed]
    problem = _problem(
        model,
        seeing,
        points,
        table.keys["xy"],
        views,
        refine_principal_point=refine_principal_point,
    )
    return Assembled(problem, seeing, points, keys, notes)


def lens_hints(model: Model) -> list[str]:
    """What looks wrong in the cameras of a model, one line each."""
    odd = []
    for camera in model.cameras.values():
        if camera.width and camera.height and camera.focals:
            at = np.array(camera.principal_point) / (float(camera.width), float(camera.height))
            if not ((at >= _EDGE) & (at <= 1 - _EDGE)).all():
                odd.append(camera)

    def place(camera: Camera) -> str:
        x, y = camera.principal_point
        return f"camera {camera.id}: pixel {x:g}, {y:g} of {camera.width} x {camera.height}"

    return counted(model.file("cameras"), odd, "principal point", "at the edge of the image", place)


def _pose_hints(model: Model) -> list[str]:
    """Whether images have other poses than their frames give them, one line."""
    frames = model.frame_of
    other = [
        one
        for one in model.images.values()
        if one.id in frames and differ(one.pose, _posed(model, one).pose)
    ]
    where = f"with another pose than in {model.file('frames')}, which counts"
    return counted(model.file("images"), other, "image", where)


def _posed(model: Model, image: Image) -> Image:
    """An image with the pose that its frame gives it. Raises ProblemError as `place_in_rig`."""
    frame = model.frame_of[image.id]
    return replace(image, pose=composed(place_in_rig(model, frame, image.camera), frame.pose))


def registered(model: Model) -> tuple[list[Image], list[str]]:
    """Registered images by id, in poses of their frames; notes on others. Raises ProblemError as
    `place_in_rig`."""
    images = [model.images[identity] for identity in sorted(model.images)]
    frames = model.frame_of
    if model.frames is None:
        return images, []
    away = [image for image in images if image.id not in frames]
    lost = [frame.id for number, frame in sorted(frames.items()) if number not in model.images]
    notes = counted(model.file("images"), away, "image", "left out, without a frame")
    notes += counted(
        model.file("frames"),
        lost,
        "frame",
        "left out, without an image",
        lambda frame: f"frame {frame}",
    )
    return [_posed(model, image) for image in images if image.id in frames], notes


def place_in_rig(model: Model, frame: Frame, camera: int) -> Pose | None:
    """Where a camera is in the rig of a frame; None for the reference sensor. Raises ProblemError:
    it is not known."""
    assert model.rigs is not None
    sensors = model.rigs[frame.rig].sensors
    at = next(at for at, one in enumerate(sensors) if (one.type, one.id) == (CAMERA_SENSOR, camera))
    if at and sensors[at].from_rig is None:
        raise ProblemError(
            f"{model.file('rigs')}: rig {frame.rig}: it is not known where camera {camera} is in it"
        )
    return sensors[at].from_rig if at else None


def rigs_of(model: Model, images: list[Image]) -> Rigs | None:
    """The rigs of a problem of these images; None if no two of them are of one frame."""
    frames = model.frame_of
    ids = [frames[image.id].id if image.id in frames else -1 for image in images]
    if model.frames is None or len(set(ids)) == len(ids):
        return None
    places = [place_in_rig(model, frames[image.id], image.camera) for image in images]
    poses = [(1.0, *6 * (0.0,)) if place is None else place for place in places]
    rotation = np.diag(COLMAP_FLIP) @ rotations(poses).as_matrix()
    # as in COLMAP, a rig whose reference sensor sees nothing, or is no camera, is rigid
    rig = np.array([frames[image.id].rig for image in images])
    reference = np.array([place is None for place in places])
    free = ~reference & np.isin(rig, rig[reference])
    frame = np.unique(ids, return_inverse=True)[1].astype(np.int32)
    return Rigs(frame, rotation, translations(poses) * COLMAP_FLIP, free if free.any() else None)


def _finite(table: Ordered, views: Views) -> tuple[Views, list[str]]:
    """Views of finite pixels and points, and notes on the others."""
    model = table.model
    what = "left out, not finite"
    finite = np.asarray(np.isfinite(table.points["xyz"]).all(axis=1))
    notes = counted(
        model.file("points3D"), np.flatnonzero(~finite), "point", what, table.point_name
    )
    views = views if finite.all() else views[:, finite[views[2]]]
    visible = np.asarray(np.isfinite(table.keys["xy"]).all(axis=1))[views[1]]
    notes += counted(
        model.file("images"), np.sort(views[1, ~visible]), "key-point", what, table.key_name
    )
    return views if visible.all() else views[:, visible], notes


def _problem(
    model: Model,
    images: list[Image],
    points: Int[np.ndarray, " points"],
    keys: Float[np.ndarray, "keys 2"],
    views: Views,
    *,
    refine_principal_point: bool,
) -> BundleProblem:
    """The problem of some images, points by their positions in the file, and views of these."""
    cameras = sorted({image.camera for image in images})
    lens = np.searchsorted(cameras, [image.camera for image in images])
    used = [model.cameras[camera] for camera in cameras]
    intrinsics, of_problem = lenses.lenses_of(
        used, lens, refine_principal_point=refine_principal_point
    )
    image, key, point = views
    pixels = keys[key]
    if of_problem is None or of_problem.all_bal:
        centers = np.array([camera.principal_point for camera in used])[lens]
        with np.errstate(over="ignore"):  # what is not finite is refused below
            for axis in range(2):
                pixels[:, axis] = (pixels[:, axis] - centers[image, axis]) * COLMAP_FLIP[axis]
    parameters = np.hstack([bal_poses([image.pose for image in images]), intrinsics[lens]])
    heads = model.points[points]
    try:
        problem = BundleProblem.create(
            parameters, heads["xyz"], pixels, image, point, lenses=of_problem
        )
    except ProblemError as error:
        raise ProblemError(f"{display_name(model.folder)}: {error}") from error
    labels = Labels(
        tuple(image.name.decode("utf-8", "surrogateescape") for image in images),
        np.array([image.id for image in images]),
        np.array(cameras),
        heads["id"],
    )
    return problem.replace(rigs=rigs_of(model, images), labels=labels)
