"""Writes a problem as a COLMAP model: into what another model holds besides, or as one that is like
no other."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Integer

from jaxba.io.colmap import model as records
from jaxba.io.colmap.files import has_parts, read_model, write_model
from jaxba.io.colmap.lenses import with_lens
from jaxba.io.colmap.model import CAMERA_SENSOR, Camera, Frame, Image, Model, Rig, Sensor
from jaxba.io.colmap.poses import bal_poses, colmap_poses, composed, inverse
from jaxba.io.colmap.read import Assembled, assemble, place_in_rig, rigs_of
from jaxba.io.files import StrPath, display_name
from jaxba.io.text import grouped, numbered
from jaxba.problem import geometry
from jaxba.problem.bundle_problem import BundleProblem, ProblemError
from jaxba.problem.geometry import COLMAP_FLIP, angle_axis
from jaxba.problem.hold import every_lens
from jaxba.problem.intrinsics import Lenses
from jaxba.problem.labels import part_name
from jaxba.problem.preprocess import MIN_TRACK

_NAME_DIGITS = 4  # at least, so that the names of images sort as their ids do
_BLOCK_OBSERVATIONS = 1 << 16  # whose errors are computed at once
_LARGEST_HALF = 2**30  # pixels; COLMAP's sizes are whole numbers, and no image is larger


def write_colmap(
    problem: BundleProblem,
    folder: StrPath,
    like: StrPath | None = None,
    *,
    rejected: Bool[np.ndarray, " observations"] | None = None,
) -> None:
    """Writes a problem as a COLMAP model.

    All files are first written to a hidden folder; then each replaces the old one whole. They are
    binary, or text where the other model is and the folder has no binary one. It may be the
    other's.

    With another model, `like`, the problem is as `read_colmap` made it from that one, or a `part`
    of that, with optimised cameras and points. Poses, points and intrinsics of what is in the
    problem are replaced, and point errors; all else is written as it was read, also what
    `read_colmap` left out.

    Without another model, image, camera and point ids count from 1, and images are called
    `image0001.jpg` and so on. Each BAL lens is a RADIAL camera, or SIMPLE_RADIAL or SIMPLE_PINHOLE
    where k2, or k1 and k2, are zero and constant. Its image size is made up: the smallest even one
    that holds all its pixels around the centre, its principal point. Where f is negative, the
    camera is rolled by 180 degrees instead, which gives the same pixels. Other lenses keep their
    pixels, models and numbers. Weights, and what is constant, cannot be stored.

    `rejected` are observations that `read_colmap` made of the other model (`Solution.rejected`):
    they leave the tracks, and their key-points have no point. Points with fewer than two
    observations left are dropped.

    Raises ProblemError: another model's problem, unstorable, different intrinsics of a camera,
    unwritable folder.
    Raises ValueError: `rejected` without another model, or of another length."""
    if like is None:
        if rejected is not None:
            raise ValueError(
                "rejected is for a model that is like another one: write problem.subset(~rejected)"
            )
        write_model(_with_rigs(create_model(problem, display_name(folder))), folder, ".bin")
        return
    target = display_name(folder)
    model, assembled = with_problem(read_model(like), problem, target)
    old = assembled.problem
    gone = np.zeros(old.num_observations, bool) if rejected is None else np.asarray(rejected)
    if gone.shape != (old.num_observations,):
        raise ValueError(
            f"rejected must have {old.num_observations} entries, has shape {gone.shape}"
        )
    # COLMAP ignores text files beside a binary model
    text = model.suffix == ".txt" and not has_parts(folder, ".bin")
    model = _without(_with_points(model, assembled, problem, ~gone), assembled, gone)
    write_model(_with_rigs(model), folder, ".txt" if text else ".bin")


def check_model(problem: BundleProblem, folder: StrPath) -> None:
    """Checks, before a solve, that a new COLMAP model can hold a problem. Raises ProblemError: it
    cannot.

    Args:
        problem: any problem.
        folder: what messages say is written."""
    target = display_name(folder)
    lenses = every_lens(problem)
    for lens in np.unique(np.asarray(lenses.index)).tolist():
        name = lenses.model_of(lens).name
        if not lenses.all_bal and name not in records.MODELS:
            raise ProblemError(f"cannot write {target}: COLMAP has no camera model {name}")
    farthest = float(np.abs(problem.observations).max(initial=0.0))
    if farthest > _LARGEST_HALF:
        raise ProblemError(
            f"cannot write {target}: a pixel is {farthest:g} from the centre of its image"
        )


def _with_positive_focals(problem: BundleProblem) -> BundleProblem:
    """The problem with BAL's cameras of a negative focal length as cameras of a positive one that
    are rolled by 180 degrees about their view: the same pixels, since `f p` is `(-f)(-p)`. In rigs
    they stay."""
    rolled = np.asarray(problem.cameras)[:, 6] < 0
    if not _is_bal(problem) or problem.rigs is not None or not rolled.any():
        return problem
    cameras = np.array(problem.cameras, np.float64)
    roll = np.diag([-1.0, -1.0, 1.0])
    cameras[rolled, :3] = angle_axis(roll @ geometry.rotation_matrices(cameras[rolled, :3]))
    cameras[rolled, 3:6] = cameras[rolled, 3:6] @ roll
    cameras[rolled, 6] *= -1
    return problem.replace(cameras=cameras)


def with_problem(model: Model, problem: BundleProblem, target: str) -> tuple[Model, Assembled]:
    """A model with the lenses, poses and places in rigs of a problem that was made of it, and what
    it was made of. `target` is what messages say is written. Raises ProblemError: another model's
    problem, or unstorable."""
    assembled = assemble(model, refine_principal_point=not _is_bal(problem))
    if (problem.num_cameras, problem.num_points) != (len(assembled.images), len(assembled.points)):
        raise ProblemError(
            f"cannot write {target}: the problem is not one of {display_name(model.folder)}"
        )
    check_points(problem, model.points["id"][assembled.points], target)
    return with_cameras(model, assembled.images, problem, target), assembled


def with_cameras(model: Model, images: list[Image], problem: BundleProblem, target: str) -> Model:
    """A model with the lenses, poses and places in rigs of a problem.

    Args:
        model: any model.
        images: the images of it that are the problem's cameras, in the poses of their frames.
        problem: may have been optimised.
        target: what messages say is written.

    Raises ProblemError: a pose is not finite, a camera would be impossible, or its images have
        different lenses."""
    bal = _is_bal(problem)
    problem = _with_positive_focals(problem)
    _check_finite(
        np.asarray(problem.cameras)[:, :6], lambda at: f"the pose of {images[at]}", target
    )
    model = replace(
        model, cameras={**model.cameras, **_new_cameras(model, images, problem, bal, target)}
    )
    return _with_poses(_with_places(model, images, problem), images, problem)


def check_points(problem: BundleProblem, ids: Integer[np.ndarray, " points"], target: str) -> None:
    """Raises ProblemError: a point of a problem, whose points have these ids, is not finite;
    `target` is what cannot be written."""
    _check_finite(np.asarray(problem.points), lambda at: f"point {ids[at]}", target)


def _check_finite(
    values: Float[np.ndarray, "n numbers"], name: Callable[[int], str], target: str
) -> None:
    finite = np.isfinite(values).all(axis=1)
    if not finite.all():
        raise ProblemError(f"cannot write {target}: {name(int(finite.argmin()))} is not finite")


def _is_bal(problem: BundleProblem) -> bool:
    """Whether all lenses of a problem are BAL's."""
    return problem.lenses is None or problem.lenses.all_bal


def _with_points(
    model: Model,
    assembled: Assembled,
    problem: BundleProblem,
    kept: Bool[np.ndarray, " observations"],
) -> Model:
    """The model with the points of the problem, and their errors by the observations that are
    kept."""
    heads = model.points.copy()
    heads["xyz"][assembled.points] = problem.points
    # all of the model, of which some may not have counted
    names = ("observations", "camera_index", "point_index")
    problem = problem.replace(
        **{name: getattr(assembled.problem, name)[kept] for name in names}, whitening=None
    )
    heads["error"][assembled.points] = mean_errors(problem)
    return replace(model, points=heads)


def _without(model: Model, assembled: Assembled, gone: Bool[np.ndarray, " observations"]) -> Model:
    """The model without some of its observations, and without the points that then have too few."""
    if not gone.any():
        return model
    problem = assembled.problem
    images = dict(model.images)
    heads = model.points
    ids = np.array([image.id for image in assembled.images])[problem.camera_index]

    def code(image, key):
        return np.asarray(image, np.uint64) << np.uint64(32) | np.asarray(key, np.uint64)

    point = np.repeat(np.arange(len(heads)), heads["length"].astype(np.int64))
    elements = model.tracks
    assert elements is not None
    cut = np.isin(code(elements["image"], elements["key"]), code(ids, assembled.keys)[gone])
    touched = assembled.points[problem.point_index[gone]]
    # tracks may be wrong
    left = np.bincount(assembled.points[problem.point_index[~gone]], minlength=len(heads))
    drop = np.zeros(len(heads), bool)
    drop[touched] = left[touched] < MIN_TRACK
    for image in images.values():
        keys = image.keys.copy()
        keys["point"][assembled.keys[gone & (ids == image.id)]] = records.NO_POINT
        keys["point"][np.isin(keys["point"], heads["id"][drop])] = records.NO_POINT
        images[image.id] = replace(image, keys=keys)
    heads = heads.copy()
    heads["length"] = np.bincount(point[~cut], minlength=len(heads))
    return replace(model, images=images, points=heads[~drop], tracks=elements[~cut & ~drop[point]])


def _new_cameras(
    model: Model, images: list[Image], problem: BundleProblem, bal: bool, target: str
) -> dict[int, Camera]:
    """The lenses of the problem by the ids of their cameras."""
    found: dict[int, np.ndarray] = {}
    for image, lens in zip(images, np.asarray(problem.cameras, np.float64)[:, 6:], strict=True):
        if (found.setdefault(image.camera, lens) != lens).any():
            raise ProblemError(
                f"cannot write {target}: images of camera {image.camera} have different intrinsics"
            )
    cameras = {
        identity: with_lens(model.cameras[identity], lens, bal=bal)
        for identity, lens in found.items()
    }
    for camera in cameras.values():
        if wrong := camera.impossible:
            raise ProblemError(
                f"cannot write {target}: camera {camera.id} would have impossible parameters: "
                f"{wrong}"
            )
    return cameras


def _with_poses(model: Model, of_problem: list[Image], problem: BundleProblem) -> Model:
    """The model with the poses of the problem, those that have not changed as they were, bit by
    bit.

    The pose of a frame is that of its reference sensor's image if the problem has that, else it
    follows from another."""
    cameras = np.asarray(problem.cameras, np.float64)[:, :6]
    same = (cameras == bal_poses([image.pose for image in of_problem])).all(axis=1)
    images = dict(model.images)
    frames = dict(model.frames or {})
    changed = set()
    known = set()
    for image, kept, pose in zip(of_problem, same, colmap_poses(cameras), strict=True):
        known.add(image.id)
        images[image.id] = replace(images[image.id], pose=image.pose if kept else pose)
        if not kept:
            changed.add(image.id)
    for frame in (model.frames or {}).values():
        moved = [pair for pair in frame.images if pair[1] in changed]
        if not moved:
            continue
        own = [
            pair
            for pair in frame.images
            if place_in_rig(model, frame, pair[0]) is None and pair[1] in known
        ]
        camera, image = next((pair for pair in own if pair[1] not in changed), (own or moved)[0])
        place = place_in_rig(model, frame, camera)
        pose = images[image].pose if place is None else composed(inverse(place), images[image].pose)
        frames[frame.id] = replace(frame, pose=pose)
        for camera, image in frame.images:  # also of images that see nothing
            if image in images:
                images[image] = replace(
                    images[image], pose=composed(place_in_rig(model, frame, camera), pose)
                )
    return replace(model, images=images, frames=None if model.frames is None else frames)


def _with_places(model: Model, images: list[Image], problem: BundleProblem) -> Model:
    """The model with its cameras where the problem's rigs have them."""
    new = problem.rigs
    old = None if new is None else rigs_of(model, images)
    if old is None or new is None or model.rigs is None:
        return model
    turned = (old.rotation != new.rotation).any(axis=(1, 2))
    if not turned.any() and (old.translation == new.translation).all():
        return model
    poses = colmap_poses(np.hstack([angle_axis(new.rotation), new.translation]))
    moved = {
        (model.frame_of[image.id].rig, image.camera): (pose, turn)
        for image, pose, turn in zip(images, poses, turned, strict=True)
    }

    def placed(rig: Rig, sensor: Sensor) -> Sensor:
        if (
            sensor.from_rig is None
            or sensor.type != CAMERA_SENSOR
            or (rig.id, sensor.id) not in moved
        ):
            return sensor
        pose, turn = moved[rig.id, sensor.id]
        return replace(sensor, from_rig=pose if turn else (*sensor.from_rig[:4], *pose[4:]))

    rigs = {
        identity: replace(rig, sensors=tuple(placed(rig, sensor) for sensor in rig.sensors))
        for identity, rig in model.rigs.items()
    }
    return replace(model, rigs=rigs)


def _with_rigs(model: Model) -> Model:
    """The model with a rig of each camera and a frame of each image, as COLMAP reads one
    without."""
    if model.frames is not None:
        return model
    rigs = {
        identity: Rig(identity, (Sensor(CAMERA_SENSOR, identity, None),))
        for identity in model.cameras
    }
    frames = {
        image.id: Frame(
            image.id, image.camera, image.pose, ((CAMERA_SENSOR, image.camera, image.id),)
        )
        for image in model.images.values()
    }
    return replace(model, rigs=rigs, frames=frames)


def create_model(problem: BundleProblem, target: str) -> Model:
    """A model of the problem's numbers; see `write_colmap` for what is made up. `target` is what
    messages say is written. Raises ProblemError: the problem is not valid, a focal length is not
    positive, or a pixel lies too far away."""
    arrays = (
        problem.cameras,
        problem.points,
        problem.observations,
        problem.camera_index,
        problem.point_index,
    )
    valid = _with_positive_focals(BundleProblem.create(*arrays, lenses=problem.lenses))
    cameras, camera_index, point_index = map(
        np.asarray, (valid.cameras, valid.camera_index, valid.point_index)
    )
    lenses = every_lens(valid)
    wrong = np.flatnonzero(~(cameras[:, 6] > 0))
    if wrong.size:
        at = f"f of {part_name(problem.labels, 'image', wrong[0])} is {cameras[wrong[0], 6]:g}"
        raise ProblemError(f"cannot write {target}: {at}, and COLMAP's focal lengths are positive")
    _, first, lens = np.unique(lenses.index, return_index=True, return_inverse=True)
    by_image = grouped(camera_index, len(cameras))
    by_point = grouped(point_index, valid.num_points)
    keys = np.empty(valid.num_observations, records.KEY)
    keys["xy"], keys["point"] = np.asarray(valid.observations)[by_image], point_index[by_image]
    keys["point"] += 1
    of_images = np.split(keys, np.cumsum(np.bincount(camera_index, minlength=len(cameras)))[:-1])
    half = np.ones((len(first), 2))
    for at, seen in zip(lens, of_images, strict=True):
        extent = np.abs(seen["xy"]).max(axis=0, initial=0.0)
        half[at] = np.maximum(half[at], np.ceil(extent / (1.0 if lenses.all_bal else 2.0)))
    if half.max() > _LARGEST_HALF:
        raise ProblemError(
            f"cannot write {target}: a pixel is {half.max():g} from the centre of its image"
        )
    for at, seen in zip(lens, of_images, strict=True) if lenses.all_bal else ():
        seen["xy"] = seen["xy"] * COLMAP_FLIP[:2] + half[at]
    tracks = np.empty(len(keys), records.TRACK)
    tracks["image"], tracks["key"] = camera_index[by_point], numbered(camera_index)[by_point]
    tracks["image"] += 1
    heads = np.zeros(len(valid.points), records.POINT)
    heads["id"], heads["xyz"] = np.arange(1, len(heads) + 1), valid.points
    heads["length"] = np.bincount(point_index, minlength=len(heads))
    heads["error"] = mean_errors(valid)
    digits = max(_NAME_DIGITS, len(str(len(cameras))))
    rows = zip(colmap_poses(cameras), lens.tolist(), of_images, strict=True)
    images = {
        number: Image(number, pose, of + 1, f"image{number:0{digits}d}.jpg".encode(), seen)
        for number, (pose, of, seen) in enumerate(rows, 1)
    }
    made = {
        number: _camera(number, lenses, int(lenses.index[at]), cameras[at, 6:], size, target)
        for number, (at, size) in enumerate(zip(first, half, strict=True), 1)
    }
    return Model(target, ".bin", made, images, heads, tracks, None, None)


def mean_errors(problem: BundleProblem) -> Float[np.ndarray, " points"]:
    """Mean reprojection error of each point, pixels; -1, COLMAP's word for none, where it is not
    finite."""
    total = np.zeros(problem.num_points)
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        for start in range(0, problem.num_observations, _BLOCK_OBSERVATIONS):
            part = problem.subset(slice(start, start + _BLOCK_OBSERVATIONS))
            x, y = geometry.residuals(part).T
            np.add.at(total, part.point_index, np.sqrt(x * x + y * y))
        mean = total / np.bincount(problem.point_index, minlength=len(total))
    return np.where(np.isfinite(mean), mean, -1.0)


def _camera(
    number: int, lenses: Lenses, lens: int, numbers: np.ndarray, half: np.ndarray, target: str
) -> Camera:
    """The camera of a lens; of one of BAL the smallest model that has all that is not zero or
    constant."""
    model = lenses.model_of(lens)
    (x, y) = half.tolist()
    size = int(2 * x), int(2 * y)
    if not lenses.all_bal:
        if model.name not in records.MODELS:
            raise ProblemError(f"cannot write {target}: COLMAP has no camera model {model.name}")
        return Camera(number, model.name, *size, tuple(numbers[: len(model)].tolist()))
    f, k1, k2 = numbers.tolist()
    _, free1, free2 = np.asarray(lenses.free)[lens]
    if k2 or free2:
        return Camera(number, "RADIAL", *size, (f, x, y, k1, k2))
    if k1 or free1:
        return Camera(number, "SIMPLE_RADIAL", *size, (f, x, y, k1))
    return Camera(number, "SIMPLE_PINHOLE", *size, (f, x, y))
