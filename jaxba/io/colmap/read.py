"""Reads COLMAP models as problems."""

from __future__ import annotations

import numpy as np

from jaxba.io.colmap.folder import read_model
from jaxba.io.colmap.problem import Assembled, assemble, hints
from jaxba.io.colmap.records import Model
from jaxba.io.files import StrPath
from jaxba.io.notes import report
from jaxba.problem.bundle_problem import BundleProblem
from jaxba.problem.labels import Labels


def read_colmap(folder: StrPath, *, strict: bool = False, refine_principal_point: bool = False) -> BundleProblem:
    """Reads a COLMAP model, binary or text.

    Cameras are the registered images, by id, and points are sorted by id. Lenses keep their camera models and numbers;
    as in COLMAP, focal lengths and distortion are optimised, shared by the images of a camera. If all are
    SIMPLE_PINHOLE, SIMPLE_RADIAL or RADIAL and principal points stay, they become BAL's lenses, which are faster.
    Images of one frame of a rig move together; where cameras are in their rigs is constant.

    What is wrong with one view, point or image only is left out, and a `ProblemWarning` says what and how many.

    Args:
        folder: of the model.
        strict: refuse a model of which a part would be left out.
        refine_principal_point: whether principal points are optimised, too. COLMAP's default is no.

    Raises:
        ProblemError: no model, one whose structure is damaged, a rig that does not say where a camera is, nothing is
            observed, or a part would be left out and `strict`; one line that names the file, and the record by its id.
    """
    model = read_model(folder)
    assembled = assemble(model, refine_principal_point=refine_principal_point)
    report(assembled.notes, strict=strict)
    report(hints(model))
    return assembled.problem.replace(labels=labels_of(model, assembled))


def labels_of(model: Model, assembled: Assembled) -> Labels:
    """What a model calls the parts of its problem."""
    return Labels(
        tuple(image.name.decode("utf-8", "surrogateescape") for image in assembled.images),
        np.array([image.id for image in assembled.images]),
        np.array(assembled.cameras),
        model.points.heads["id"][assembled.points],
    )
