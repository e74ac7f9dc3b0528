"""Depths of maps at the pixels of a problem, and what maps cannot be: of another shape, on their
side, disparities."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxba.io.colmap.read import image_sizes, principal_points
from jaxba.io.files import StrPath, reason
from jaxba.problem.bundle_problem import BundleProblem
from jaxba.problem.geometry import COLMAP_FLIP
from jaxba.problem.hold import every_lens

ROUNDED = 32
"""Sides of a map are those of its image, times a scale, to half of this: networks take multiples of
up to 32 pixels. Source: Ranftl et al. 2021, "Vision Transformers for Dense Prediction", section
4."""

# share of the pixels of an image of unknown size that lie in its map: in one of half size a quarter
# do
COVERED = 0.4

LEAST_PIXELS = 8  # of an image whose depths are compared

OPPOSITE = -0.5
"""Rank correlation of depths and a map, the mean over images, below which it has disparities:
without noise that of depths is 1, of disparities -1, and of neither 0."""


class Placed(NamedTuple):
    """Pixels of observations from the upper left corner, and sizes of their images."""

    pixels: Float[np.ndarray, "observations 2"]  # from the middle of the image where `from_middle`
    sizes: Float[np.ndarray, "cameras 2"]  # 0 where they are not known
    from_middle: bool


def pixels_of_images(problem: BundleProblem, model: StrPath | None) -> Placed:
    """Where observations are in their images, by the COLMAP model of the problem if there is
    one."""
    pixels = np.asarray(problem.observations, np.float64)
    camera = np.asarray(problem.camera_index)
    bal = every_lens(problem).all_bal
    if bal:
        pixels = pixels * COLMAP_FLIP[:2]
    if problem.labels is None or model is None:
        return Placed(pixels, np.zeros((problem.num_cameras, 2)), bal)
    images = problem.labels.images.tolist()
    if bal:
        pixels = pixels + principal_points(model, images)[camera]
    return Placed(pixels, image_sizes(model, images), False)


def looked_up(
    file: Path, placed: Placed, own: Int[np.ndarray, " n"], image: int
) -> Float[np.ndarray, " n"]:
    """Depths of a map at pixels of its image, NaN where there is none.

    Args:
        file: the map.
        placed: pixels of all observations.
        own: observations of the image.
        image: which one it is.

    Raises:
        ValueError: no matrix, or it has another shape than the image; one line."""
    try:
        depths = np.asarray(np.load(file, allow_pickle=False), np.float64)
        height, width = depths.shape
    except (OSError, ValueError, TypeError) as error:
        raise ValueError(f"{file}: no matrix of depths: {reason(error)}") from None
    size = np.array([width, height], np.float64)
    pixels = placed.pixels[own] + (size / 2 if placed.from_middle else 0.0)
    if (placed.sizes[image] > 0).all():
        pixels = pixels * _scale(file, size, placed.sizes[image])
    column, row = np.floor(pixels).astype(int).T
    inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
    if np.mean(inside) < COVERED and not (placed.sizes[image] > 0).all():
        outside = f"{np.sum(~inside)} of {len(own)} pixels of its image lie outside"
        raise ValueError(
            f"{file}: is {width} x {height}, and {outside}: maps have the size of their images"
        )
    depth = depths[np.where(inside, row, 0), np.where(inside, column, 0)]
    return np.where(inside & (depth > 0) & np.isfinite(depth), depth, np.nan)


def _scale(
    file: Path, size: Float[np.ndarray, "2"], of_image: Float[np.ndarray, "2"]
) -> Float[np.ndarray, "2"]:
    """Size of a map over that of its image, along x and y. Raises ValueError: they are not of one
    shape; one line."""
    if _same_shape(size, of_image):
        return size / of_image
    both = f"is {size[0]:g} x {size[1]:g}, and its image {of_image[0]:g} x {of_image[1]:g}"
    if _same_shape(size[::-1], of_image):
        raise ValueError(f"{file}: {both}: the map is on its side")
    raise ValueError(f"{file}: {both}: the map is not of the whole image")


def _same_shape(size: Float[np.ndarray, "2"], of_image: Float[np.ndarray, "2"]) -> bool:
    """Whether a size is that of an image times a scale, to rounding."""
    scale = np.sqrt(np.prod(size / of_image))
    return bool((np.abs(size - scale * of_image) <= min(ROUNDED / 2, 0.1 * size.min())).all())


def refuse_disparities(
    folder: Path,
    image: Int[np.ndarray, " n"],
    measured: Float[np.ndarray, " n"],
    depths: Float[np.ndarray, " n"],
) -> None:
    """Raises ValueError: maps are smaller where points are farther; one line.

    Args:
        folder: of the maps, for the message.
        image: image of each pixel.
        measured: what maps have there.
        depths: those of the points."""
    from scipy.stats import rankdata

    correlations = []
    for number in range(int(image.max()) + 1):
        of_image = image == number
        if (
            of_image.sum() >= LEAST_PIXELS
            and np.ptp(measured[of_image]) > 0
            and np.ptp(depths[of_image]) > 0
        ):
            correlations.append(
                float(np.corrcoef(rankdata(measured[of_image]), rankdata(depths[of_image]))[0, 1])
            )
    mean = float(np.mean(correlations)) if correlations else 0.0
    if mean < OPPOSITE:
        raise ValueError(
            f"{folder}: maps are smaller where points are farther (rank correlation {mean:.2f}): "
            "they seem "
            "to have disparities, not depths; give their inverse"
        )
