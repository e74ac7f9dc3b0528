"""Lenses of COLMAP as those of a problem.

A model whose lenses are all of `AS_BAL` becomes a BAL problem, with pixels relative to the
principal point: the derivatives of BAL's camera are formulas, and its blocks are small. Any other
keeps pixels, camera models and numbers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from jaxba.io.colmap.model import Camera
from jaxba.problem.camera_models import BAL, CAMERA_MODELS
from jaxba.problem.intrinsics import Lenses

AS_BAL = ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")  # BAL's but for principal points and zeros


def lenses_of(
    cameras: Sequence[Camera], index: np.ndarray, *, refine_principal_point: bool
) -> tuple[Float[np.ndarray, "lenses numbers"], Lenses | None]:
    """Numbers of lenses, and the lenses of a problem whose images have them; None if every image
    has its own, and all of it is optimised. As in COLMAP, focal lengths and distortion are
    optimised, and principal points only if asked for; nothing of a model without a focal length."""
    bal = not refine_principal_point and all(camera.model in AS_BAL for camera in cameras)
    names = ["BAL"] if bal else sorted({camera.model for camera in cameras})
    models = tuple(CAMERA_MODELS[name] for name in names)
    size = max(map(len, models))
    numbers = np.zeros((len(cameras), size))
    free = np.zeros((len(cameras), size), bool)
    for at, camera in enumerate(cameras):
        model = CAMERA_MODELS[camera.model]
        moves = [
            *model.focal,
            *model.distortion,
            *(model.principal_point if refine_principal_point else ()),
        ]
        if bal:
            places = [BAL.parameters.index(model.parameters[k]) for k in moves]
            numbers[at, places], free[at, places] = np.array(camera.params)[moves], True
        else:
            numbers[at, : len(model)] = camera.params
            free[at, moves if model.focal else []] = True
    if not bal:
        return numbers, Lenses(
            index, free, np.array([names.index(camera.model) for camera in cameras]), models
        )
    unshared = len(np.unique(index)) == len(index)
    return numbers, None if unshared and free.all() else Lenses(index, free)


def with_lens(camera: Camera, lens: Float[np.ndarray, " numbers"], *, bal: bool) -> Camera:
    """A camera with new numbers, which are BAL's if `bal`, where its model has them; the rest
    stays, bit by bit."""
    if not bal:
        return replace(camera, params=tuple(lens[: len(camera.params)].tolist()))
    names = CAMERA_MODELS[camera.model].parameters
    new = {
        **dict(zip(names, camera.params, strict=True)),
        **dict(zip(BAL.parameters, lens.tolist(), strict=True)),
    }
    return replace(camera, params=tuple(new[name] for name in names))
