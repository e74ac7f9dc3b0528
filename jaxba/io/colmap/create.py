"""The COLMAP model of a problem that did not come from one: ids, names and image sizes are made up."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from jaxba.io.colmap.model import KEY, MODELS, POINT, TRACK, Camera, Image, Model, Points
from jaxba.io.colmap.poses import colmap_poses
from jaxba.io.tracks import numbered
from jaxba.problem import geometry
from jaxba.problem.bundle_problem import BundleProblem, ProblemError
from jaxba.problem.constraints import every_lens
from jaxba.problem.geometry import COLMAP_FLIP
from jaxba.problem.intrinsics import Lenses
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
    cameras, camera_index, point_index = map(np.asarray, (valid.cameras, valid.camera_index, valid.point_index))
    lenses = every_lens(valid)
    wrong = np.flatnonzero(~(cameras[:, 6] > 0))
    if wrong.size:
        at = f"f of {part_name(problem.labels, 'image', wrong[0])} is {cameras[wrong[0], 6]:g}"
        raise ProblemError(f"cannot write {target}: {at}, and COLMAP's focal lengths are positive")
    _, first, lens = np.unique(lenses.index, return_index=True, return_inverse=True)
    pixels = np.asarray(valid.observations) * (COLMAP_FLIP[:2] if lenses.all_bal else 1.0)
    half = np.ones((len(first), 2))
    np.maximum.at(half, lens[camera_index], np.ceil(np.abs(pixels) / (1.0 if lenses.all_bal else 2.0)))
    if half.max() > _LARGEST_HALF:
        raise ProblemError(f"cannot write {target}: a pixel is {half.max():g} from the centre of its image")
    keys = np.empty(len(pixels), KEY)
    keys["xy"], keys["point"] = pixels + (half[lens[camera_index]] if lenses.all_bal else 0.0), point_index + 1
    by_image, by_point = (np.argsort(index, kind="stable") for index in (camera_index, point_index))
    image_ends = np.cumsum(np.bincount(camera_index, minlength=len(cameras)))
    tracks = np.empty(len(pixels), TRACK)
    tracks["image"], tracks["key"] = camera_index[by_point] + 1, numbered(camera_index)[by_point]
    heads = np.zeros(len(valid.points), POINT)
    heads["id"], heads["xyz"] = np.arange(1, len(heads) + 1), valid.points
    heads["length"] = np.bincount(point_index, minlength=len(heads))
    heads["error"] = mean_errors(geometry.residuals(valid), point_index, len(heads))
    digits = max(_NAME_DIGITS, len(str(len(cameras))))
    rows = zip(colmap_poses(cameras), lens.tolist(), np.split(keys[by_image], image_ends[:-1]), strict=True)
    images = {
        number: Image(number, pose, of + 1, f"image{number:0{digits}d}.jpg".encode(), seen)
        for number, (pose, of, seen) in enumerate(rows, 1)
    }
    made = {
        number: _camera(number, lenses, int(lenses.index[at]), cameras[at, 6:], size, target)
        for number, (at, size) in enumerate(zip(first, half, strict=True), 1)
    }
    return Model(target, ".bin", made, images, Points(heads, tracks), None, None)


def mean_errors(
    residuals: Float[np.ndarray, "observations 2"], point_index: Int[np.ndarray, " observations"], count: int
) -> Float[np.ndarray, " points"]:
    """Mean reprojection error of each point, pixels; -1, COLMAP's word for none, where it is not finite."""
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        total = np.bincount(point_index, np.linalg.norm(residuals, axis=1), count)
        mean = total / np.bincount(point_index, minlength=count)
    return np.where(np.isfinite(mean), mean, -1.0)


def _camera(number: int, lenses: Lenses, lens: int, numbers: np.ndarray, half: np.ndarray, target: str) -> Camera:
    """The camera of a lens; of one of BAL the smallest model that has all that is not zero or constant."""
    model, (x, y) = lenses.model_of(lens), half.tolist()
    size = int(2 * x), int(2 * y)
    if not lenses.all_bal:
        if model.name not in MODELS:
            raise ProblemError(f"cannot write {target}: COLMAP has no camera model {model.name}")
        return Camera(number, model.name, *size, tuple(numbers[: len(model)].tolist()))
    f, k1, k2 = numbers.tolist()
    _, free1, free2 = np.asarray(lenses.free)[lens]
    if k2 or free2:
        return Camera(number, "RADIAL", *size, (f, x, y, k1, k2))
    if k1 or free1:
        return Camera(number, "SIMPLE_RADIAL", *size, (f, x, y, k1))
    return Camera(number, "SIMPLE_PINHOLE", *size, (f, x, y))
