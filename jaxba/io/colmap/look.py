"""What a COLMAP model holds for looking at: colours of points, sizes of images."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, UInt8

from jaxba.io.colmap.folder import read_model
from jaxba.io.colmap.lenses import principal_point
from jaxba.io.colmap.problem import assemble
from jaxba.io.colmap.read import labels_of
from jaxba.io.colmap.records import CAMERA_MODELS
from jaxba.io.files import StrPath
from jaxba.io.notes import report
from jaxba.problem.bundle_problem import BundleProblem


class Looks(NamedTuple):
    """In the order of the problem."""

    colours: UInt8[np.ndarray, "points 3"] | None
    """Red, green and blue of points; None if they are not known."""

    sizes: Float[np.ndarray, "cameras 2"]
    """Width and height of images, pixels; 0 where they are not known."""

    principal: Float[np.ndarray, "cameras 2"]
    """Principal points, pixels from the upper left corner."""


def read_colmap_with_looks(folder: StrPath) -> tuple[BundleProblem, Looks]:
    """`read_colmap`, and the looks. Raises as it does."""
    model = read_model(folder)
    assembled = assemble(model)
    report(assembled.notes, strict=False)
    lenses = [model.cameras[image.camera] for image in assembled.images]
    sizes = np.array([(lens.width, lens.height) for lens in lenses], np.float64)
    found = [principal_point(lens) if CAMERA_MODELS[lens.model].focals else (np.nan, np.nan) for lens in lenses]
    principal = np.where(np.isnan(found), sizes / 2, found)  # a panorama has its own in the middle
    looks = Looks(model.points.heads["rgb"][assembled.points], sizes, principal)
    return assembled.problem.replace(labels=labels_of(model, assembled)), looks
