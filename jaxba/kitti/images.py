"""Grey images of a sequence, as they are stored: a turn that a photograph's file asks for is not
made."""

from __future__ import annotations

import functools
import io
from collections.abc import Callable
from pathlib import Path

import numpy as np

from jaxba.io.files import display_name, reason
from jaxba.kitti.sequence import Sequence
from jaxba.problem.bundle_problem import ProblemError

GREY_BITS = 8  # bits per pixel of the images in which key-points are detected
# grey image of a frame by its position, shape (height, width), uint8
Reader = Callable[[int], np.ndarray]


def image_reader(sequence: Sequence) -> Reader:
    """A reader of grey images, which must all have the size of the first one.

    Images of 16 bits are shifted to the right until the first one fits into 8 bits: cameras of 10
    or 12 bits leave the
    highest bits empty. Raises ProblemError: (when called) an image cannot be read or has another
    size."""
    first = functools.cache(lambda: _decode(sequence.images[0]))

    def read(index: int) -> np.ndarray:
        image = _decode(sequence.images[index])
        if image.shape != first().shape:
            sizes = [f"{width} x {height}" for height, width in (image.shape, first().shape)]
            raise ProblemError(
                f"{display_name(sequence.images[index])}: is {sizes[0]} pixels, the first is "
                f"{sizes[1]}"
            )
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
    from PIL import Image

    from jaxba.kitti.opencv import cv2

    try:
        data = path.read_bytes()
    except OSError as error:
        raise ProblemError(f"{display_name(path)}: cannot be read: {reason(error)}") from None
    # calibration is that of the stored pixels, whatever EXIF says of how to show them
    flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        # OpenCV may decode a damaged PNG file to other pixels, and prints of it
        Image.open(io.BytesIO(data)).verify()
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except (OSError, SyntaxError, ValueError):
        image = None
    if image is None:
        raise ProblemError(f"{display_name(path)}: is no image that can be decoded")
    return np.asarray(image)
