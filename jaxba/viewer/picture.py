"""The picture of one image: what the camera saw where it is at hand, and residuals on it."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw

from jaxba.problem.bundle_problem import BundleProblem
from jaxba.viewer.geometry import Frusta, residual_segments

WIDTH = 640
"""Of a picture, pixels."""

WHITE, LINE, END = (255, 255, 255), (208, 0, 0), (0, 114, 178)
"""Colours: paper, residuals, measured pixels."""


def picture_of(
    photo: UInt8[np.ndarray, "height width 3"] | None,
    problem: BundleProblem,
    frusta: Frusta,
    residuals: Float[np.ndarray, "observations 2"],
    camera: int,
) -> UInt8[np.ndarray, "rows columns 3"]:
    """Draws a line for each residual of an image, magnified, and a dot where the pixel was measured.

    Args:
        photo: the image; None if it is not at hand.
        problem: cameras and observations.
        frusta: of its cameras.
        residuals: measured minus predicted, pixels.
        camera: number of the image.
    """
    half = frusta.half[camera]
    size = np.array([WIDTH, max(int(WIDTH * half[1] / half[0]), 1)])
    canvas = Image.new("RGB", tuple(size.tolist()), WHITE)
    if photo is not None:
        canvas.paste(Image.fromarray(photo).resize(canvas.size))
    draw = ImageDraw.Draw(canvas)
    segments, _ = residual_segments(problem, frusta, residuals, camera)
    for start, end in ((segments / half + 1) / 2 * size).tolist():
        draw.line([*start, *end], LINE, width=2)
        draw.ellipse([start[0] - 2, start[1] - 2, start[0] + 2, start[1] + 2], END)
    return np.asarray(canvas)
