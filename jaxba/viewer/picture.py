"""The picture of one image: what the camera saw where it is at hand, and residuals on it."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw

WIDTH = 640
"""Of a picture, pixels."""

WHITE, LINE, END = (255, 255, 255), (208, 0, 0), (0, 114, 178)
"""Colours: paper, residuals, measured pixels."""


def picture_of(
    photo: UInt8[np.ndarray, "height width 3"] | None,
    size: Float[np.ndarray, "2"],
    segments: Float[np.ndarray, "own 2 2"],
) -> UInt8[np.ndarray, "rows columns 3"]:
    """Draws segments on an image of this width and height, with a dot where each begins; their ends are pixels from its
    upper left corner. The photo may have any size; None if it is not at hand."""
    scale = WIDTH / size[0]
    canvas = Image.new("RGB", (WIDTH, max(round(size[1] * scale), 1)), WHITE)
    if photo is not None:
        canvas.paste(Image.fromarray(photo).resize(canvas.size))
    draw = ImageDraw.Draw(canvas)
    for start, end in (segments * scale).tolist():
        draw.line([*start, *end], LINE, width=2)
        draw.ellipse([start[0] - 2, start[1] - 2, start[0] + 2, start[1] + 2], END)
    return np.asarray(canvas)
