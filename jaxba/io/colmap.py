"""COLMAP models: a folder of cameras, images and points, binary or text. Needs the extra `colmap`.

COLMAP's camera looks down +z with y downwards, BAL's down -z with y upwards; pixels of a problem count from the
principal point, which stays. What COLMAP calls a camera is a lens here (`jaxba.lenses`): its images share it, and what
its model lacks stays zero. Source: COLMAP, doc/cameras.rst and doc/format.rst.
"""

from __future__ import annotations

import os
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxba.geometry import COLMAP_FLIP, bal_rotations, colmap_quaternions
from jaxba.io.files import StrPath, display_name, reason
from jaxba.lenses import LENS_SIZE, Lenses
from jaxba.problem import BundleProblem, ProblemError

MODELS = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("f", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
}
"""Models of a lens that can be optimised, and their parameters. PINHOLE keeps the ratio of its focal lengths."""

_NUMBERS = ("f", "k1", "k2")
_STEP = 1e-6  # of a direction, for the derivative of a lens that stays


class _Index(NamedTuple):
    """Which number of a problem is which of a model."""

    images: list[int]  # ids of registered images: cameras
    lenses: list[int]  # ids of their cameras
    points: list[int]  # ids


def is_colmap(path: StrPath) -> bool:
    """Whether a path is a folder that holds a COLMAP model."""
    return any((Path(path) / f"cameras.{kind}").is_file() for kind in ("bin", "txt"))


def read_colmap(folder: StrPath) -> BundleProblem:
    """Reads a COLMAP model.

    Cameras are the registered images by id, points come by id. Lenses of the `MODELS` are optimised, shared by their
    images. A lens of another model stays: its pixels are undistorted at once, and errors weighed so that to first
    order they are those of the image, in pixels.

    Raises:
        ProblemError: no model, one that COLMAP cannot read, rigs of several cameras, or nothing is observed; in one
            line that names the folder; or pycolmap is not installed.
    """
    name = display_name(folder)
    model = _load(folder)
    index = _index(model, name)
    image_of = {image: number for number, image in enumerate(index.images)}
    lens_of = {lens: number for number, lens in enumerate(index.lenses)}
    views = [
        (number, image_of[view.image_id], view.image_id, view.point2D_idx)
        for number, point in enumerate(index.points)
        for view in model.point3D(point).track.elements
        if view.image_id in image_of
    ]
    if not views:
        raise ProblemError(f"{name}: no image sees a point")
    point_index, camera_index, image, key = np.array(views).T
    seen_by = {number: model.image(number).points2D for number in index.images}
    pixels = np.array([seen_by[i][k].xy for i, k in zip(image.tolist(), key.tolist(), strict=True)])
    lens = np.array([lens_of[model.image(number).camera_id] for number in index.images])
    poses = [model.image(number).cam_from_world() for number in index.images]
    quaternions = np.array([pose.rotation.quat for pose in poses])  # xyzw
    shifts = np.array([pose.translation for pose in poses]) * COLMAP_FLIP
    numbers, free = np.zeros((len(index.lenses), LENS_SIZE)), np.zeros((len(index.lenses), LENS_SIZE), bool)
    observations, whitening = np.empty_like(pixels), np.tile(np.eye(2), (len(pixels), 1, 1))
    for number, identity in enumerate(index.lenses):
        here = lens[camera_index] == number
        camera = model.camera(identity)
        if not (np.isfinite(camera.params).all() and camera.mean_focal_length() > 0):
            raise ProblemError(f"{name}: camera {identity} has impossible parameters: {camera.params_to_string()}")
        parameters = MODELS.get(camera.model.name)
        if parameters:
            named = dict(zip(parameters, camera.params, strict=True))
            numbers[number] = [named.get(one, 0.0) for one in _NUMBERS]
            free[number] = [one in named for one in _NUMBERS]
            ratio = named.get("fy", named["f"]) / named["f"]
            observations[here] = (pixels[here] - [named["cx"], named["cy"]]) / [1.0, ratio]
            whitening[here, 1, 1] = ratio
        else:
            numbers[number, 0] = camera.mean_focal_length()
            observations[here], whitening[here] = _undistorted(camera, pixels[here], f"{name}: camera {identity}")
    covariance = None
    if (whitening != np.eye(2)).any():
        root = np.linalg.inv(whitening)
        covariance = root @ root.transpose(0, 2, 1)
        covariance = 0.5 * (covariance + covariance.transpose(0, 2, 1))
    own = len(index.lenses) == len(index.images)
    try:
        return BundleProblem.create(
            np.hstack([bal_rotations(quaternions), shifts, numbers[lens]]),
            np.array([model.point3D(point).xyz for point in index.points]),
            observations * COLMAP_FLIP[:2],
            camera_index,
            point_index,
            covariance=covariance,
            lenses=None if own and free.all() else Lenses(lens, free),
        )
    except ProblemError as error:
        raise ProblemError(f"{name}: {error}") from error


def write_colmap(problem: BundleProblem, folder: StrPath, like: StrPath) -> None:
    """Writes a model with the poses, points and lenses of a problem, and everything else as in another model.

    Its files appear whole, one after the other: binary ones, or text where the other model is text.

    Args:
        problem: what `read_colmap` made of the other model, with other cameras and points.
        folder: where to write; made if it does not exist, and may be that of the other model.
        like: the other model.

    Raises:
        ProblemError: the problem is not one of that model, the folder cannot be written, or pycolmap is not installed.
    """
    import pycolmap

    model = _load(like)
    index = _index(model, display_name(like))
    if (problem.num_cameras, problem.num_points) != (len(index.images), len(index.points)):
        raise ProblemError(f"cannot write {display_name(folder)}: the problem is not one of {display_name(like)}")
    cameras = np.asarray(problem.cameras, np.float64)
    quaternions, shifts = colmap_quaternions(cameras[:, :3]), cameras[:, 3:6] * COLMAP_FLIP
    for number, identity in enumerate(index.images):
        image: Any = model.image(identity)
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(quaternions[number]), shifts[number])
        image.frame.set_cam_from_world(image.camera_id, pose)
        lens = model.camera(image.camera_id)
        parameters = MODELS.get(lens.model.name)
        if parameters:
            values = dict(zip(parameters, lens.params, strict=True))
            ratio = values.get("fy", values["f"]) / values["f"]
            values |= {one: cameras[number, 6 + k] for k, one in enumerate(_NUMBERS) if one in values}
            if "fy" in values:
                values["fy"] = ratio * values["f"]
            lens.params = [values[one] for one in parameters]
    for identity, position in zip(index.points, np.asarray(problem.points, np.float64), strict=True):
        model.point3D(identity).xyz = position
    model.update_point_3d_errors()
    text = not (Path(like) / "cameras.bin").is_file()
    try:
        target = Path(folder)
        target.mkdir(exist_ok=True)
        with tempfile.TemporaryDirectory(dir=target, prefix=".jaxba-") as temporary:
            (model.write_text if text else model.write_binary)(temporary)
            for file in sorted(Path(temporary).iterdir()):
                os.replace(file, target / file.name)
    except OSError as error:
        raise ProblemError(f"cannot write {display_name(folder)}: {reason(error)}") from error


def _load(folder: StrPath) -> Any:
    name = display_name(folder)
    if not is_colmap(folder):
        raise ProblemError(f"{name}: no COLMAP model, which has cameras.bin or cameras.txt")
    try:
        import pycolmap
    except ModuleNotFoundError:
        raise ProblemError(f"{name}: COLMAP models need pycolmap: pip install jaxba[colmap]") from None
    try:
        return pycolmap.Reconstruction(os.fspath(folder))
    except Exception as error:  # what C++ throws comes as any of Python's
        raise ProblemError(f"cannot read {name}: COLMAP says: {reason(error)}") from error


def _index(model: Any, name: str) -> _Index:
    """Registered images, their lenses and all points, each in the order of their ids."""
    images = sorted(model.reg_image_ids())
    for identity in images:
        image = model.image(identity)
        if not image.is_ref_in_frame() or image.frame.num_data_ids() > 1:
            raise ProblemError(f"{name}: image {identity} is of a rig of several cameras, whose poses depend on it")
    lenses = sorted({model.image(identity).camera_id for identity in images})
    return _Index(images, lenses, sorted(model.point3D_ids()))


def _undistorted(
    camera: Any, pixels: Float[np.ndarray, "n 2"], name: str
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2 2"]]:
    """Pixels that a lens without distortion would have seen, and derivatives of the true ones by these."""
    focal = camera.mean_focal_length()
    plane = np.asarray(camera.cam_from_img(pixels))
    image = lambda p: np.asarray(camera.img_from_cam(np.column_stack([p, np.ones(len(p))])))
    steps = _STEP * np.eye(2)
    rates = np.stack([(image(plane + step) - image(plane - step)) / (2 * _STEP * focal) for step in steps], axis=2)
    if not (np.isfinite(plane).all() and np.isfinite(rates).all()):
        raise ProblemError(f"{name} ({camera.model.name}) cannot tell the direction of all its pixels")
    return focal * plane, rates @ np.diag(COLMAP_FLIP[:2])
