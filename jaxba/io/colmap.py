"""COLMAP models: a folder of cameras, images and points, binary or text. Needs the extra `colmap`.

COLMAP's camera looks down +z with y downwards, BAL's down -z with y upwards; pixels of a problem are relative to the
principal point, which is not optimised. What COLMAP calls a camera is a lens here (`jaxba.problem.intrinsics`): its
images share it, and parameters that its model lacks stay zero. Source: COLMAP, doc/cameras.rst and doc/format.rst.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxba.io.files import StrPath, display_name, reason
from jaxba.problem.bundle_problem import BundleProblem, ProblemError
from jaxba.problem.geometry import COLMAP_FLIP, bal_rotations, colmap_quaternions
from jaxba.problem.intrinsics import LENS_SIZE, Lenses

MODELS = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("f", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
}
"""Camera models that can be optimised, and their parameters. PINHOLE keeps the ratio of its focal lengths."""

_PARAMETERS = ("f", "k1", "k2")  # of a lens
_STEP = 1e-6  # in the image plane, for the derivative of a distortion that is not optimised
_SMALLEST_DETERMINANT = 1e-6  # of that derivative; below it the image folds over itself


class _Index(NamedTuple):
    """Ids in a model of the cameras, lenses and points of a problem, in the problem's order."""

    images: list[int]  # registered images, which are the problem's cameras
    lenses: list[int]  # COLMAP's cameras
    points: list[int]


def is_colmap(path: StrPath) -> bool:
    """Whether a path is a folder that holds a COLMAP model."""
    return any((Path(path) / f"cameras.{kind}").is_file() for kind in ("bin", "txt"))


def read_colmap(folder: StrPath) -> BundleProblem:
    """Reads a COLMAP model.

    Cameras are the registered images, by id, and points are sorted by id. Intrinsics of the `MODELS` are optimised,
    shared by their images. Those of any other model are fixed: their pixels are undistorted once, and residuals are
    weighted so that to first order they are those of the distorted image, in pixels.

    Raises:
        ProblemError: no model, one that COLMAP cannot read, rigs of several cameras, or nothing is observed; one line
            that names the folder; or pycolmap is not installed.
    """
    name = display_name(folder)
    model = _load(folder)
    index = _index(model, name)
    number_of = {identity: number for number, identity in enumerate(index.images)}
    tracks = [model.point3D(identity).track.elements for identity in index.points]
    views = np.array([(view.image_id, view.point2D_idx) for track in tracks for view in track]).reshape(-1, 2)
    point_index = np.repeat(np.arange(len(tracks)), [len(track) for track in tracks])
    registered = np.isin(views[:, 0], index.images)
    views, point_index = views[registered], point_index[registered]
    if not len(views):
        raise ProblemError(f"{name}: no image sees a point")
    camera_index = np.array([number_of[identity] for identity in views[:, 0].tolist()])
    pixels = np.empty((len(views), 2))
    for number, seen in _groups(camera_index, len(index.images)):
        keys = model.image(index.images[number]).points2D
        pixels[seen] = np.array([keys[key].xy for key in views[seen, 1].tolist()]).reshape(-1, 2)
    lens = np.searchsorted(index.lenses, [model.image(identity).camera_id for identity in index.images])
    poses = [model.image(identity).cam_from_world() for identity in index.images]
    quaternions = np.array([pose.rotation.quat for pose in poses])  # xyzw
    translations = np.array([pose.translation for pose in poses]) * COLMAP_FLIP
    intrinsics = np.zeros((len(index.lenses), LENS_SIZE))
    free = np.zeros((len(index.lenses), LENS_SIZE), bool)
    observations, whitening = np.empty_like(pixels), np.tile(np.eye(2), (len(pixels), 1, 1))
    for number, seen in _groups(lens[camera_index], len(index.lenses)):
        camera = model.camera(index.lenses[number])
        label = f"{name}: camera {index.lenses[number]}"
        _check(camera, label)
        parameters = MODELS.get(camera.model.name)
        if parameters:
            named = dict(zip(parameters, camera.params, strict=True))
            intrinsics[number] = [named.get(one, 0.0) for one in _PARAMETERS]
            free[number] = [one in named for one in _PARAMETERS]
            ratio = named.get("fy", named["f"]) / named["f"]
            observations[seen] = (pixels[seen] - [named["cx"], named["cy"]]) / [1.0, ratio]
            whitening[seen, 1, 1] = ratio
        else:
            intrinsics[number, 0] = camera.mean_focal_length()
            observations[seen], whitening[seen] = _undistorted(camera, pixels[seen], label)
    covariance = None
    if (whitening != np.eye(2)).any():
        root = np.linalg.inv(whitening)
        covariance = root @ root.transpose(0, 2, 1)
        covariance = 0.5 * (covariance + covariance.transpose(0, 2, 1))
    unshared = len(index.lenses) == len(index.images)
    try:
        return BundleProblem.create(
            np.hstack([bal_rotations(quaternions), translations, intrinsics[lens]]),
            np.array([model.point3D(point).xyz for point in index.points]),
            observations * COLMAP_FLIP[:2],
            camera_index,
            point_index,
            covariance=covariance,
            lenses=None if unshared and free.all() else Lenses(lens, free),
        )
    except ProblemError as error:
        raise ProblemError(f"{name}: {error}") from error


def write_colmap(problem: BundleProblem, folder: StrPath, like: StrPath) -> None:
    """Writes a model with the poses, points and intrinsics of a problem, and everything else from another model.

    All files are first written to a temporary folder and read back; then each replaces the old one whole. They are
    binary, or text where the other model is text and the folder holds no binary one.

    Args:
        problem: as `read_colmap` made it from the other model, with optimised cameras and points.
        folder: where to write; made if it does not exist, and may be the folder of the other model.
        like: the other model.

    Raises:
        ProblemError: the problem is not one of that model, images of one camera have different intrinsics, the folder
            cannot be written, or pycolmap is not installed.
    """
    model = _load(like)
    import pycolmap

    index = _index(model, display_name(like))
    counts = len(index.images), len(index.points), _observations(model)
    if (problem.num_cameras, problem.num_points, problem.num_observations) != counts:
        raise ProblemError(f"cannot write {display_name(folder)}: the problem is not one of {display_name(like)}")
    cameras = np.asarray(problem.cameras, np.float64)
    quaternions, translations = colmap_quaternions(cameras[:, :3]), cameras[:, 3:6] * COLMAP_FLIP
    named: dict[int, np.ndarray] = {}
    for number, identity in enumerate(index.images):
        image: Any = model.image(identity)
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(quaternions[number]), translations[number])
        image.frame.set_cam_from_world(image.camera_id, pose)
        lens = named.setdefault(image.camera_id, cameras[number, 6:])
        if (lens != cameras[number, 6:]).any():
            raise ProblemError(
                f"cannot write {display_name(folder)}: images of camera {image.camera_id} have different f, k1 or k2"
            )
    for identity, lens in named.items():
        _set_lens(model.camera(identity), dict(zip(_PARAMETERS, lens, strict=True)))
    for identity, position in zip(index.points, np.asarray(problem.points, np.float64), strict=True):
        model.point3D(identity).xyz = position
    model.update_point_3d_errors()
    target = Path(folder)
    beside = target if target.is_dir() else target.absolute().parent  # writable, and on the same file system
    text = not _is_binary(like) and not _is_binary(target)  # COLMAP ignores text files beside a binary model
    try:
        with tempfile.TemporaryDirectory(dir=beside, prefix=".jaxba-") as temporary:
            (model.write_text if text else model.write_binary)(temporary)
            written = pycolmap.Reconstruction(temporary)  # fails if a full disk has cut it short
            if _observations(written) != counts[2] or written.num_points3D() != counts[1]:
                raise OSError("it cannot be read back")
            target.mkdir(exist_ok=True)
            for file in sorted(Path(temporary).iterdir()):
                os.replace(file, target / file.name)
    except Exception as error:  # exceptions of C++ arrive as any of Python's
        raise ProblemError(f"cannot write {display_name(folder)}: {reason(error)}") from error


def _set_lens(camera: Any, new: dict[str, float]) -> None:
    """Sets the parameters of a lens that its model has; the others stay as they are, bit by bit."""
    parameters = MODELS.get(camera.model.name)
    if parameters is None:
        return
    values = dict(zip(parameters, camera.params, strict=True))
    if "fy" in values and values["f"] != new["f"]:
        values["fy"] *= new["f"] / values["f"]
    camera.params = [new.get(one, values[one]) for one in parameters]


def _observations(model: Any) -> int:
    """Number of observations of a model in registered images."""
    registered = set(model.reg_image_ids())
    return sum(view.image_id in registered for p in model.points3D.values() for view in p.track.elements)


def _groups(numbers: np.ndarray, count: int) -> Iterator[tuple[int, np.ndarray]]:
    """Every number below `count`, with its positions in `numbers`."""
    order = np.argsort(numbers, kind="stable")
    return enumerate(np.split(order, np.searchsorted(numbers[order], np.arange(1, count))))


def _is_binary(folder: StrPath) -> bool:
    """Whether COLMAP would read the binary files of a folder."""
    return all((Path(folder) / f"{part}.bin").is_file() for part in ("cameras", "images", "points3D"))


def _check(camera: Any, name: str) -> None:
    """Refuses a lens without a focal length, or with parameters that cannot be."""
    if camera.is_spherical():
        raise ProblemError(f"{name}: {camera.model.name} has no focal length and cannot be used")
    focal = np.asarray(camera.params)[list(camera.focal_length_idxs())]
    if not (np.isfinite(camera.params).all() and (focal > 0).all()):
        raise ProblemError(f"{name} has impossible parameters: {camera.params_to_string()}")


def _load(folder: StrPath) -> Any:
    name = display_name(folder)
    if not is_colmap(folder):
        raise ProblemError(f"{name}: no directory with a COLMAP model (cameras.bin or cameras.txt)")
    try:
        import pycolmap
    except (ImportError, RuntimeError):
        raise ProblemError(f"{name}: COLMAP models need pycolmap: pip install jaxba[colmap]") from None
    try:
        return pycolmap.Reconstruction(os.fspath(folder))
    except Exception as error:  # exceptions of C++ arrive as any of Python's
        raise ProblemError(f"cannot read {name}: COLMAP says: {reason(error)}") from error


def _index(model: Any, name: str) -> _Index:
    """Registered images, their lenses and all points, each sorted by id."""
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
    """Undistorted pixels, and the derivatives of the distorted pixels with respect to them."""
    focal = camera.mean_focal_length()
    plane = np.asarray(camera.cam_from_img(pixels))
    image = lambda p: np.asarray(camera.img_from_cam(np.column_stack([p, np.ones(len(p))])))
    steps = _STEP * np.eye(2)
    rates = np.stack([(image(plane + step) - image(plane - step)) / (2 * _STEP * focal) for step in steps], axis=2)
    finite = np.isfinite(np.column_stack([plane, rates.reshape(-1, 4)])).all(axis=1)
    determinant = np.abs(np.linalg.det(np.where(finite.reshape(-1, 1, 1), rates, 0.0)))
    bad = determinant < _SMALLEST_DETERMINANT
    if bad.any():
        shown = ", ".join(f"{x:g}" for x in pixels[bad][0])
        raise ProblemError(f"{name} ({camera.model.name}) has no direction for pixel {shown}")
    return focal * plane, rates @ np.diag(COLMAP_FLIP[:2])
