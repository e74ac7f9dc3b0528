"""From the cameras of other programs to a problem: lenses in pixels, poses that look down +z with y downwards.

This is the convention of COLMAP, VisualSFM, OpenSfM, OpenMVG and AliceVision. BAL's camera looks down -z with y
upwards, has no principal point, one focal length, and two coefficients of distortion.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxba.io.files import StrPath, display_name
from jaxba.io.foreign.distortion import Distortion
from jaxba.io.notes import note, note_center
from jaxba.problem.bundle_problem import BundleProblem, ProblemError
from jaxba.problem.geometry import COLMAP_FLIP, angle_axis
from jaxba.problem.intrinsics import LENS_SIZE, Lenses

ALL_FREE = (True, True, True)
FIXED = (False, False, False)


@dataclass(frozen=True)
class ForeignLens:
    """Intrinsics of one or more images."""

    label: str
    """How messages call it, such as `intrinsic 3`."""

    focal: tuple[float, float]
    """Focal lengths along x and y, pixels. Their ratio stays as it is."""

    center: tuple[float, float] = (0.0, 0.0)
    """Principal point in the coordinates of the observations; it stays as it is."""

    distortion: Distortion = field(default_factory=Distortion)
    """Where BAL has no such distortion, pixels are undistorted once, and the lens stays as it is."""

    free: tuple[bool, bool, bool] = ALL_FREE
    """Which of f, k1 and k2 may be optimised, if the distortion is BAL's, or inverse: its pixels do not depend on f."""

    size: tuple[float, float] | None = None
    """Width and height of the image, pixels, if the principal point is measured from its corner."""


class _Observed(NamedTuple):
    pixels: np.ndarray  # (n, 2) undistorted, relative to the principal point, x to the right, y down
    whitening: np.ndarray  # (n, 2, 2)


@np.errstate(over="ignore", invalid="ignore")  # what is not finite then is refused or left out
def assemble(
    path: StrPath,
    lenses: Sequence[ForeignLens],
    lens_of: Int[np.ndarray, " cameras"],
    rotations: Float[np.ndarray, "cameras 3 3"],
    translations: Float[np.ndarray, "cameras 3"],
    points: Float[np.ndarray, "points 3"],
    pixels: Float[np.ndarray, "observations 2"],
    camera_index: Int[np.ndarray, " observations"],
    point_index: Int[np.ndarray, " observations"],
) -> BundleProblem:
    """The problem of cameras in the convention of this module.

    Observations without a direction in their lens are left out, with a warning that counts them. Where a lens has a
    distortion that BAL lacks, residuals are weighted so that to first order they are those of the distorted image, in
    pixels, as `read_colmap` does.

    Args:
        path: of the file, for messages.
        lenses: of the cameras.
        lens_of: lens of each camera.
        rotations: from the world to the camera, right-handed.
        translations: the same, `P = R X + t`.
        points: in the world.
        pixels: observations, x to the right, y down.
        camera_index: camera of each observation.
        point_index: point of each observation.

    Raises:
        ProblemError: a lens is impossible, no observation is left, or something is not finite.
    """
    name = display_name(path)
    intrinsics, free = np.zeros((len(lenses), LENS_SIZE)), np.zeros((len(lenses), LENS_SIZE), bool)
    observations, whitening = np.full(pixels.shape, np.nan), np.tile(np.eye(2), (len(pixels), 1, 1))
    lens_seen = np.asarray(lens_of)[camera_index]
    order = np.argsort(lens_seen, kind="stable")
    groups = np.split(order, np.searchsorted(lens_seen[order], np.arange(1, len(lenses))))
    for number, (lens, seen) in enumerate(zip(lenses, groups, strict=True)):
        _check(lens, name)
        if lens.size is not None:
            note_center(path, lens.label, lens.center, lens.size)
        plain = lens.distortion.is_bal
        coefficients = (*lens.distortion.radial, 0.0, 0.0)[:2] if plain else (0.0, 0.0)
        intrinsics[number] = [lens.focal[0], *coefficients]
        free[number] = lens.free if plain or lens.distortion.inverse else FIXED
        observations[seen], whitening[seen] = _observed(lens, pixels[seen])
    kept = np.flatnonzero(np.isfinite(np.column_stack([observations, whitening.reshape(-1, 4)])).all(axis=1))
    if len(kept) < len(pixels):
        note(path, f"{len(pixels) - len(kept)} of {len(pixels)} observations left out: beyond the range of their lens")
    if not len(kept):
        raise ProblemError(f"{name}: no camera sees a point")
    unshared = len(np.unique(lens_of)) == len(lens_of)
    cameras = np.hstack(
        [angle_axis(np.diag(COLMAP_FLIP) @ rotations), translations * COLMAP_FLIP, intrinsics[np.asarray(lens_of)]]
    )
    try:
        return BundleProblem.create(
            cameras,
            points,
            observations[kept] * COLMAP_FLIP[:2],
            np.asarray(camera_index)[kept],
            np.asarray(point_index)[kept],
            covariance=_covariance(whitening[kept]),
            lenses=None if unshared and free.all() else Lenses(np.asarray(lens_of), free),
        )
    except ProblemError as error:
        raise ProblemError(f"{name}: {error}") from error


def _check(lens: ForeignLens, name: str) -> None:
    numbers = [*lens.focal, *lens.center, *lens.distortion.radial, *lens.distortion.tangential]
    if not np.isfinite(numbers).all():
        raise ProblemError(f"{name}: {lens.label} has a number that is not finite")
    if not min(lens.focal) > 0:
        shown = " and ".join(f"{f:g}" for f in dict.fromkeys(lens.focal))
        raise ProblemError(f"{name}: {lens.label} has focal length {shown}, which must be positive")


def _observed(lens: ForeignLens, pixels: np.ndarray) -> _Observed:
    """Undistorted pixels with one focal length, and the weights that turn their residuals into those of the image."""
    focal = np.array(lens.focal)
    ratio = focal / focal[0]
    centred = pixels - np.array(lens.center)
    if lens.distortion.is_bal:
        return _Observed(centred / ratio, np.broadcast_to(np.diag(ratio), (len(pixels), 2, 2)))
    plane, derivative = lens.distortion.remove(centred / focal)
    flip = np.diag(COLMAP_FLIP[:2])
    return _Observed(focal[0] * plane, flip @ (ratio[:, None] * derivative) @ flip)


def _covariance(whitening: np.ndarray) -> np.ndarray | None:
    if (whitening == np.eye(2)).all():
        return None
    root = np.linalg.inv(whitening)
    covariance = root @ root.transpose(0, 2, 1)
    return 0.5 * (covariance + covariance.transpose(0, 2, 1))
