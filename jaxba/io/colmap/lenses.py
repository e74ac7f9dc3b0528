"""Lenses of COLMAP as those of a problem.

A model whose lenses are all of `AS_BAL` becomes a BAL problem, with pixels relative to the principal point: the
derivatives of BAL's camera are formulas, and its blocks are small. Any other keeps its pixels, and its lenses their own
camera models and numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from jaxba.io.colmap.records import CAMERA_MODELS, Camera, Model
from jaxba.problem import camera_models
from jaxba.problem.bundle_problem import ProblemError
from jaxba.problem.intrinsics import LENS_SIZE, Lenses

AS_BAL = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
}
"""Camera models that are BAL's but for the principal point and numbers that stay zero, and their parameters."""

PARAMETERS = ("f", "k1", "k2")
"""Parameters of a BAL lens."""

LARGEST_RATIO = 1e6
"""Of the focal lengths of a lens; a larger one is damage."""


def check_lens(model: Model, camera: Camera) -> None:
    """Refuses a lens with parameters that cannot be.

    Raises:
        ProblemError: it cannot be used; one line that names file and camera.
    """
    focals = np.array(camera.params[: CAMERA_MODELS[camera.model].focals])
    possible = np.isfinite(camera.params).all() and (focals > 0).all()
    if not possible or (len(focals) and focals.max() / LARGEST_RATIO > focals.min()):
        shown = ", ".join(f"{value:g}" for value in camera.params)
        name = f"{model.file('cameras')}: camera {camera.id}"
        raise ProblemError(f"{name} has impossible parameters: {shown} ({camera.model})")


def are_bal(cameras: Sequence[Camera], *, refine_principal_point: bool) -> bool:
    """Whether lenses can be those of a BAL problem."""
    return not refine_principal_point and all(camera.model in AS_BAL for camera in cameras)


def lenses_of(
    cameras: Sequence[Camera], index: np.ndarray, *, refine_principal_point: bool
) -> tuple[Float[np.ndarray, "lenses numbers"], Lenses | None]:
    """Numbers of lenses, and the lenses of a problem.

    As in COLMAP, focal lengths and distortion are optimised, and principal points only if asked for; nothing of a model
    without a focal length.

    Args:
        cameras: those of the lenses.
        index: lens of each image.
        refine_principal_point: whether principal points are optimised.

    Returns:
        The lenses are None if every image has its own, and all of it is optimised.
    """
    if are_bal(cameras, refine_principal_point=refine_principal_point):
        named = [dict(zip(AS_BAL[camera.model], camera.params, strict=True)) for camera in cameras]
        numbers = np.array([[one.get(name, 0.0) for name in PARAMETERS] for one in named]).reshape(-1, LENS_SIZE)
        free = np.array([[name in one for name in PARAMETERS] for one in named]).reshape(-1, LENS_SIZE)
        unshared = len(np.unique(index)) == len(index)
        return numbers, None if unshared and free.all() else Lenses(index, free)
    names = sorted({camera.model for camera in cameras})
    models = tuple(camera_models.CAMERA_MODELS[name] for name in names)
    size = max(map(len, models))
    numbers, free = np.zeros((len(cameras), size)), np.zeros((len(cameras), size), bool)
    for at, camera in enumerate(cameras):
        model = camera_models.CAMERA_MODELS[camera.model]
        numbers[at, : len(model)] = camera.params
        if model.focal:
            moves = [*model.focal, *model.distortion, *(model.principal_point if refine_principal_point else ())]
            free[at, moves] = True
    model_index = np.array([names.index(camera.model) for camera in cameras])
    return numbers, Lenses(index, free, model_index, models)


def principal_point(camera: Camera) -> tuple[float, float]:
    """Pixel of the principal point."""
    at = CAMERA_MODELS[camera.model].focals
    return camera.params[at], camera.params[at + 1]


def with_lens(camera: Camera, lens: Float[np.ndarray, " numbers"], *, bal: bool) -> Camera:
    """A camera with new numbers, where its model has them; all else stays as it is, bit by bit.

    Args:
        camera: the old one.
        lens: its numbers in the problem.
        bal: whether these are BAL's.
    """
    if not bal:
        return replace(camera, params=tuple(lens[: len(camera.params)].tolist()))
    values = dict(zip(AS_BAL[camera.model], camera.params, strict=True))
    new = dict(zip(PARAMETERS, lens.tolist(), strict=True))
    return replace(camera, params=tuple(new.get(one, values[one]) for one in AS_BAL[camera.model]))


def finite_rows(values: Float[np.ndarray, "n width"]) -> Bool[np.ndarray, " n"]:
    """Whether all numbers of a row are finite."""
    return np.asarray(np.isfinite(values).all(axis=1))
