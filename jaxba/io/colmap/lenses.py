"""Lenses of COLMAP as those of a problem: what is optimised, and pixels relative to the principal point.

Parameters that a model lacks stay zero. Lenses of all other models are held: their pixels are undistorted once, and
residuals are weighted so that to first order they are those of the distorted image, in pixels. Only these need
pycolmap.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxba.io.colmap.records import CAMERA_MODELS, Camera, Model
from jaxba.io.files import reason
from jaxba.problem import geometry
from jaxba.problem.bundle_problem import ProblemError
from jaxba.problem.geometry import COLMAP_FLIP

MODELS = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("f", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
}
"""Camera models that can be optimised, and their parameters. PINHOLE keeps the ratio of its focal lengths."""

PARAMETERS = ("f", "k1", "k2")
"""Parameters of a problem's lens."""

LARGEST_RATIO = 1e6
"""Of the focal lengths of a PINHOLE, and of the scales of an image in two directions. Covariances hold the squares, and
are singular to rounding beyond it."""

_STEP = 1e-6  # in the image plane, for the derivative of a distortion that is not optimised
_LARGEST_MISS = 0.1  # pixels, from a pixel to that of its direction; COLMAP gives some direction for any pixel
_SMALLEST_DETERMINANT = 1e-6  # of that derivative; below it the image folds over itself


class Seen(NamedTuple):
    """Observations of one lens."""

    pixels: Float[np.ndarray, "n 2"]
    """Relative to the principal point, y downwards; undistorted where the lens is held."""

    whitening: Float[np.ndarray, "n 2 2"]

    valid: Bool[np.ndarray, " n"]
    """False where the lens has no direction for the pixel."""


def check_lens(model: Model, camera: Camera) -> None:
    """Refuses a lens without a focal length, or with parameters that cannot be.

    Raises:
        ProblemError: it cannot be used; one line that names file and camera.
    """
    name = f"{model.file('cameras')}: camera {camera.id}"
    focals = np.array(camera.params[: CAMERA_MODELS[camera.model].focals])
    if not len(focals):
        raise ProblemError(f"{name}: {camera.model} has no focal length and cannot be used")
    possible = np.isfinite(camera.params).all() and (focals > 0).all()
    if not possible or focals.max() / LARGEST_RATIO > focals.min():
        shown = ", ".join(f"{value:g}" for value in camera.params)
        raise ProblemError(f"{name} has impossible parameters: {shown} ({camera.model})")


def intrinsics(camera: Camera) -> tuple[list[float], list[bool]]:
    """Numbers f, k1 and k2 of a lens, and which of them are optimised."""
    named = _named(camera)
    if named is None:
        return [mean_focal(camera), 0.0, 0.0], [False] * len(PARAMETERS)
    return [named.get(one, 0.0) for one in PARAMETERS], [one in named for one in PARAMETERS]


def mean_focal(camera: Camera) -> float:
    """The mean of the focal lengths."""
    return float(np.mean(camera.params[: CAMERA_MODELS[camera.model].focals]))


def principal_point(camera: Camera) -> tuple[float, float]:
    """Pixel of the principal point."""
    at = CAMERA_MODELS[camera.model].focals
    return camera.params[at], camera.params[at + 1]


def seen_through(model: Model, camera: Camera, pixels: Float[np.ndarray, "n 2"]) -> Seen:
    """Pixels of a model as a problem has them.

    Raises:
        ProblemError: the lens needs pycolmap, which is not installed.
    """
    named = _named(camera)
    if named is None:
        with _pycolmap_camera(model, camera) as lens:
            return _undistorted(lens, mean_focal(camera), pixels)
    ratio = named.get("fy", named["f"]) / named["f"]
    whitening = np.tile(np.diag([1.0, ratio]), (len(pixels), 1, 1))
    with np.errstate(over="ignore"):
        observations = (pixels - principal_point(camera)) / [1.0, ratio]
    return Seen(observations, whitening, finite_rows(observations))


def with_lens(camera: Camera, lens: Float[np.ndarray, " 3"]) -> Camera:
    """A camera with new f, k1 and k2, where its model has them; all else stays as it is, bit by bit."""
    values = _named(camera)
    if values is None:
        return camera
    new = dict(zip(PARAMETERS, lens.tolist(), strict=True))
    if "fy" in values and values["f"] != new["f"]:
        values["fy"] *= new["f"] / values["f"]
    return replace(camera, params=tuple(new.get(one, values[one]) for one in MODELS[camera.model]))


def project(model: Model, camera: Camera, plane: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
    """Pixels of points in the image plane.

    Raises:
        ProblemError: the lens needs pycolmap, which is not installed.
    """
    named = _named(camera)
    if named is None:
        with _pycolmap_camera(model, camera) as lens:
            return _image(lens, plane)
    lens = np.tile([named.get(one, 0.0) for one in PARAMETERS], (len(plane), 1))
    with np.errstate(over="ignore", invalid="ignore"):
        return geometry.distort(plane, lens) * [1.0, named.get("fy", named["f"]) / named["f"]] + principal_point(camera)


def finite_rows(values: Float[np.ndarray, "n width"]) -> Bool[np.ndarray, " n"]:
    """Whether all numbers of a row are finite."""
    return np.asarray(np.isfinite(values).all(axis=1))


def _named(camera: Camera) -> dict[str, float] | None:
    names = MODELS.get(camera.model)
    return None if names is None else dict(zip(names, camera.params, strict=True))


@contextmanager
def _pycolmap_camera(model: Model, camera: Camera) -> Iterator[Any]:
    name = f"{model.file('cameras')}: camera {camera.id}"
    try:
        import pycolmap
    except (ImportError, RuntimeError):
        raise ProblemError(f"{name}: {camera.model} lenses need pycolmap: pip install jaxba[colmap]") from None
    size = {"width": camera.width, "height": camera.height}
    try:
        yield pycolmap.Camera(camera_id=camera.id, model=camera.model, params=list(camera.params), **size)
    except Exception as error:  # exceptions of C++ arrive as any of Python's
        raise ProblemError(f"{name}: COLMAP says: {reason(error)}") from error


def _image(lens: Any, plane: np.ndarray) -> np.ndarray:
    return np.asarray(lens.img_from_cam(np.column_stack([plane, np.ones(len(plane))])))


def _undistorted(lens: Any, focal: float, pixels: Float[np.ndarray, "n 2"]) -> Seen:
    """Undistorted pixels, and the derivatives of the distorted pixels with respect to them."""
    with np.errstate(over="ignore", invalid="ignore"):
        plane = np.asarray(lens.cam_from_img(pixels))
        steps = _STEP * np.eye(2)
        rates = [(_image(lens, plane + step) - _image(lens, plane - step)) / (2 * _STEP * focal) for step in steps]
        rates = np.stack(rates, axis=2)
        undistorted = focal * plane
        valid = finite_rows(np.column_stack([undistorted, rates.reshape(-1, 4)]))
        valid &= np.abs(_image(lens, plane) - pixels).max(axis=1, initial=0.0) < _LARGEST_MISS
        rates = np.where(valid[:, None, None], rates, np.eye(2))
        determinant, square = np.abs(np.linalg.det(rates)), np.square(rates).sum(axis=(1, 2))
        # the sum of squares over the determinant is the ratio of the singular values, plus its inverse
        valid &= (determinant >= _SMALLEST_DETERMINANT) & (square <= LARGEST_RATIO * np.minimum(determinant, 1.0))
    return Seen(
        np.where(valid[:, None], undistorted, 0.0),
        np.where(valid[:, None, None], rates @ np.diag(COLMAP_FLIP[:2]), np.eye(2)),
        valid,
    )
