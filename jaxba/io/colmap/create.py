"""The COLMAP model of a problem that did not come from one: ids, names and image sizes are made up."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from jaxba.io.colmap.records import CAMERA_MODELS, KEY, POINT, TRACK, WXYZ, Camera, Image, Model, Points, pose_of
from jaxba.problem import geometry
from jaxba.problem.bundle_problem import BundleProblem, ProblemError
from jaxba.problem.geometry import COLMAP_FLIP, colmap_quaternions
from jaxba.problem.intrinsics import LENS_SIZE
from jaxba.problem.labels import part_name

_NAME_DIGITS = 4  # at least, so that the names of images sort as their ids do
_LARGEST_HALF = 2**30  # pixels; COLMAP's sizes are whole numbers, and no image is larger


def create_model(problem: BundleProblem, target: str) -> Model:
    """A model of the problem's numbers; see `write_colmap` for what is made up.

    Args:
        problem: any problem.
        target: name of what is to be written, for messages.

    Raises:
        ProblemError: the problem is not valid, a focal length is not positive, or a pixel lies too far away.
    """
    arrays = (problem.cameras, problem.points, problem.observations, problem.camera_index, problem.point_index)
    valid = BundleProblem.create(*arrays, lenses=problem.lenses)
    cameras, camera_index, point_index = (
        np.asarray(part) for part in (valid.cameras, valid.camera_index, valid.point_index)
    )
    general = valid.lenses is not None and not valid.lenses.all_bal
    wrong = np.flatnonzero(~(cameras[:, 6] > 0))
    if wrong.size:
        at = f"f of {part_name(problem.labels, 'image', wrong[0])} is {cameras[wrong[0], 6]:g}"
        raise ProblemError(f"cannot write {target}: {at}, and COLMAP's focal lengths are positive")
    lens = np.arange(len(cameras)) if valid.lenses is None else np.asarray(valid.lenses.index)
    _, first, lens = np.unique(lens, return_index=True, return_inverse=True)
    pixels = np.asarray(valid.observations) * (1.0 if general else COLMAP_FLIP[:2])
    half = np.ones((len(first), 2))
    np.maximum.at(half, lens[camera_index], np.ceil(np.abs(pixels) / (2.0 if general else 1.0)))
    if half.max() > _LARGEST_HALF:
        raise ProblemError(f"cannot write {target}: a pixel is {half.max():g} from the centre of its image")
    keys = np.empty(len(pixels), KEY)
    keys["xy"], keys["point"] = pixels + (0.0 if general else half[lens[camera_index]]), point_index + 1
    by_image, image_ends = _grouped(camera_index, len(cameras))
    by_point, point_ends = _grouped(point_index, len(valid.points))
    key_number = np.empty(len(pixels), np.int64)
    key_number[by_image] = np.arange(len(pixels)) - np.append(0, image_ends)[camera_index[by_image]]
    tracks = np.empty(len(pixels), TRACK)
    tracks["image"], tracks["key"] = camera_index[by_point] + 1, key_number[by_point]
    heads = np.zeros(len(valid.points), POINT)
    heads["id"], heads["xyz"] = np.arange(1, len(heads) + 1), valid.points
    heads["length"] = np.diff(point_ends, prepend=0)
    heads["error"] = mean_errors(geometry.residuals(valid), point_index, len(heads))
    poses = np.hstack([colmap_quaternions(cameras[:, :3])[:, WXYZ], cameras[:, 3:6] * COLMAP_FLIP])
    digits = max(_NAME_DIGITS, len(str(len(cameras))))
    images = {
        number: Image(number, pose_of(pose), int(of) + 1, f"image{number:0{digits}d}.jpg".encode(), seen)
        for number, (pose, of, seen) in enumerate(
            zip(poses, lens, np.split(keys[by_image], image_ends[:-1]), strict=True), 1
        )
    }
    free = np.ones((len(first), LENS_SIZE), bool)
    of_problem = valid.lenses
    if of_problem is not None:
        free = np.asarray(of_problem.free)[np.asarray(of_problem.index)[first]]
    rows = enumerate(zip(cameras[first, 6:], free, half, strict=True), 1)
    if of_problem is not None and general:
        models = [of_problem.model_of(int(of_problem.index[at])) for at in first]
        for model in models:
            if model.name not in CAMERA_MODELS:
                raise ProblemError(f"cannot write {target}: COLMAP has no camera model {model.name}")
        lenses = {
            number: Camera(
                number, model.name, int(2 * size[0]), int(2 * size[1]), tuple(numbers[: len(model)].tolist())
            )
            for (number, (numbers, _, size)), model in zip(rows, models, strict=True)
        }
    else:
        lenses = {number: _camera(number, *row) for number, row in rows}
    return Model(target, ".bin", lenses, images, Points(heads, tracks), None, None)


def mean_errors(
    residuals: Float[np.ndarray, "observations 2"], point_index: Int[np.ndarray, " observations"], count: int
) -> Float[np.ndarray, " points"]:
    """Mean reprojection error of each point, pixels; -1, COLMAP's word for none, where it is not finite."""
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        total = np.bincount(point_index, np.linalg.norm(residuals, axis=1), count)
        mean = total / np.bincount(point_index, minlength=count)
    return np.where(np.isfinite(mean), mean, -1.0)


def _camera(number: int, numbers: np.ndarray, free: np.ndarray, half: np.ndarray) -> Camera:
    f, k1, k2 = numbers.tolist()
    x, y = half.tolist()
    size = int(2 * x), int(2 * y)
    if k2 or free[2]:
        return Camera(number, "RADIAL", *size, (f, x, y, k1, k2))
    if k1 or free[1]:
        return Camera(number, "SIMPLE_RADIAL", *size, (f, x, y, k1))
    return Camera(number, "SIMPLE_PINHOLE", *size, (f, x, y))


def _grouped(index: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Order of numbers below `count`, and where each ends in it."""
    return np.argsort(index, kind="stable"), np.cumsum(np.bincount(index, minlength=count))
