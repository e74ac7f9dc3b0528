"""Reads COLMAP models as problems."""

from __future__ import annotations

from jaxba.io.colmap.folder import read_model
from jaxba.io.colmap.problem import assemble, hints
from jaxba.io.files import StrPath
from jaxba.io.notes import report
from jaxba.problem.bundle_problem import BundleProblem


def read_colmap(folder: StrPath, *, strict: bool = False) -> BundleProblem:
    """Reads a COLMAP model, binary or text.

    Cameras are the registered images, by id, and points are sorted by id. Intrinsics of the models SIMPLE_PINHOLE,
    PINHOLE, SIMPLE_RADIAL and RADIAL are optimised, shared by their images. Those of any other model are fixed: their
    pixels are undistorted once, and residuals are weighted so that to first order they are those of the distorted
    image, in pixels; this needs the extra `colmap`.

    What is wrong with one view, point or image only is left out, and a `ProblemWarning` says what and how many.

    Args:
        folder: of the model.
        strict: refuse a model of which a part would be left out.

    Raises:
        ProblemError: no model, one whose structure is damaged, rigs of several cameras, nothing is observed, or a part
            would be left out and `strict`; one line that names the file, and the record by its own id.
    """
    model = read_model(folder)
    assembled = assemble(model)
    report(assembled.notes, strict=strict)
    report(hints(model))
    return assembled.problem
