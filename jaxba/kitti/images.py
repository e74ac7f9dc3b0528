"""Grey images of a sequence, as they are stored: a turn that a photograph's file asks for is not made."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path

import numpy as np
from PIL import Image

from jaxba.io.files import display_name, reason
from jaxba.kitti.sequence import Sequence
from jaxba.problem.bundle_problem import ProblemError

GREY_BITS = 8
"""Bits per pixel of the images in which key-points are detected."""

Reader = Callable[[int], np.ndarray]
"""Grey image of a frame by its position in the sequence, shape (height, width), uint8."""


def image_reader(sequence: Sequence) -> Reader:
    """A reader of grey images, which must all have the size of the first one.

    Images of 16 bits are shifted to the right until the first one fits into 8 bits: cameras of 10 or 12 bits leave the
    highest bits empty.

    Raises:
        ProblemError: (when called) an image cannot be read or has another size.
    """
    first = functools.cache(lambda: _decode(sequence.images[0]))

    def read(index: int) -> np.ndarray:
        image = _decode(sequence.images[index])
        if image.shape != first().shape:
            sizes = [f"{width} x {height}" for height, width in (image.shape, first().shape)]
            raise ProblemError(f"{display_name(sequence.images[index])}: is {sizes[0]} pixels, the first is {sizes[1]}")
        if image.dtype == np.uint8:
            return image
        bits = 16 if first().dtype == np.uint8 else int(first().max()).bit_length()
        return np.minimum(image >> max(bits - GREY_BITS, 0), 2**GREY_BITS - 1).astype(np.uint8)

    return read


def image_size(sequence: Sequence) -> tuple[float, float]:
    """Width and height of the first image, pixels. Raises ProblemError where it cannot be read."""
    height, width = _decode(sequence.images[0]).shape
    return float(width), float(height)


def _decode(path: Path) -> np.ndarray:
    """Grey image of a file, shape (height, width), uint8 or uint16."""
    try:
        with Image.open(path) as image:
            deep = image.mode.startswith("I")
            return np.asarray(image).astype(np.uint16) if deep else np.asarray(image.convert("L"))
    except (OSError, SyntaxError, ValueError) as error:
        if isinstance(error, OSError) and error.errno:
            raise ProblemError(f"{display_name(path)}: cannot be read: {reason(error)}") from None
        raise ProblemError(f"{display_name(path)}: is no image that can be decoded") from None
