"""Where cameras and residuals are drawn: frusta, residuals as segments.

Frusta have the axes of COLMAP and OpenCV: x to the right, y downwards, z forwards."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxba.problem.bundle_problem import BundleProblem
from jaxba.problem.camera_models import BAL
from jaxba.problem.geometry import COLMAP_FLIP, camera_centers
from jaxba.problem.intrinsics import POSE_SIZE
from jaxba.problem.row_owners import block_groups, owners_of

# largest half width of a frustum at distance 1, tangent of 63 degrees: fisheyes see more
WIDEST = 2.0


class Frusta(NamedTuple):
    """The images of a problem in the plane at distance 1 before each camera."""

    focal: Float[np.ndarray, "cameras 2"]  # focal lengths, pixels
    center: Float[np.ndarray, "cameras 2"]  # principal points, pixels of the problem
    # whether y of the problem's pixels is upwards, as BAL's is
    flipped: Bool[np.ndarray, " cameras"]
    half: Float[np.ndarray, "cameras 2"]  # half of width and height in the plane

    def on_plane(
        self, pixels: Float[np.ndarray, "n 2"], cameras: Int[np.ndarray, " n"]
    ) -> Float[np.ndarray, "n 2"]:
        """Places of pixels in the planes of their cameras, without regard to distortion, as an
        image is shown."""
        plane = (pixels - self.center[cameras]) / self.focal[cameras]
        return np.where(self.flipped[cameras, None], plane * COLMAP_FLIP[:2], plane)


def frusta_of(
    problem: BundleProblem, sizes: Float[np.ndarray, "cameras 2"] | None = None
) -> Frusta:
    """The frusta of all cameras. `sizes` are width and height of images, pixels; None, or 0 for an
    image: from the principal point, or where there is none as far as its observations reach."""
    numbers = np.asarray(problem.cameras)[:, POSE_SIZE:]
    count = len(numbers)
    focal = np.ones((count, 2))
    center = np.zeros((count, 2))
    flipped = np.zeros(count, bool)
    lenses = problem.lenses
    models = (BAL,) if lenses is None else lenses.models
    kind = np.zeros(count, int)
    if lenses is not None and lenses.model is not None:
        kind = np.asarray(lenses.model)[np.asarray(lenses.index)]
    for at, model in enumerate(models):
        own = np.flatnonzero(kind == at)
        flipped[own] = model is BAL
        if model.focal:
            focal[own] = numbers[own][:, [model.focal[0], model.focal[-1]]]
        else:  # a panorama: width and height are numbers of the lens
            focal[own], center[own] = numbers[own][:, :2] / (2 * np.pi), numbers[own][:, :2] / 2
        if model.principal_point:
            center[own] = numbers[own][:, list(model.principal_point)]
    focal = np.where(np.abs(focal) > 0, np.abs(focal), 1.0)
    reach = _reach(problem, center)
    if sizes is not None:
        reach = np.where(sizes > 0, sizes / 2, reach)
    return Frusta(focal, center, flipped, np.clip(reach / focal, 1e-3, WIDEST))


def _reach(
    problem: BundleProblem, center: Float[np.ndarray, "cameras 2"]
) -> Float[np.ndarray, "cameras 2"]:
    """How far images reach from their principal points: to the corner of the pixels, or where
    pixels begin in the middle, to the observations of their lens, or of the median image."""
    reach = np.zeros(center.shape)
    index = np.asarray(problem.camera_index)
    np.maximum.at(reach, index, np.abs(np.asarray(problem.observations) - center[index]))
    lenses = problem.lenses
    if lenses is not None:
        of_lens = np.zeros((len(lenses.free), 2))
        np.maximum.at(of_lens, np.asarray(lenses.index), reach)
        reach = of_lens[lenses.index]
    return np.maximum(
        reach, np.where(center.any(axis=1, keepdims=True), np.abs(center), np.median(reach, axis=0))
    )


def depth_of_image(half: Float[np.ndarray, "2"], scale: float) -> float:
    """How far before the camera viser draws the image of a frustum: all frusta of a scale have the
    same volume."""
    return float(scale / np.cbrt(half.prod() / 3))


def residual_segments(
    problem: BundleProblem,
    frusta: Frusta,
    residuals: Float[np.ndarray, "all 2"],
    camera: int,
    factor: float,
) -> Float[np.ndarray, "own 2 2"]:
    """Magnified residuals of an image as segments from each measured pixel towards the predicted
    one, in its plane; what would be longer than all of the image ends outside of it. Non-finite
    residuals are left out."""
    own = np.flatnonzero(
        (np.asarray(problem.camera_index) == camera) & np.isfinite(residuals).all(axis=1)
    )
    pixels = np.asarray(problem.observations)[own]
    difference = residuals[own]
    length = np.linalg.norm(difference, axis=1)
    diagonal = 2 * float(np.linalg.norm(frusta.half[camera] * frusta.focal[camera]))
    share = np.minimum(factor, diagonal / np.maximum(length, 1e-300))[:, None]
    cameras = np.full(len(own), camera)
    ends = [frusta.on_plane(place, cameras) for place in (pixels, pixels - share * difference)]
    return np.stack(ends, axis=1)


def row_segments(problem: BundleProblem) -> list[Float[np.ndarray, "segments 2 3"]]:
    """For each residual besides those of pixels the segments between the two cameras or points that
    its rows have."""
    centers = camera_centers(problem.cameras)
    points = np.asarray(problem.points)
    found = []
    groups = block_groups(problem)
    for rows in problem.residuals.rows:
        owners = owners_of(problem, rows, groups)
        ends = [
            (places, at)
            for places, every in ((centers, owners.cameras), (points, owners.points))
            for at in every
        ]
        ends = [places[at] for places, at in ends if (at >= 0).all()]
        found.append(np.stack(ends[:2], axis=1) if len(ends) > 1 else np.zeros((0, 2, 3)))
    return found
