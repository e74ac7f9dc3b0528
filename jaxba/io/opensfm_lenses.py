"""The cameras of OpenSfM: lenses in pixels, and the problem of cameras that look down +z with y
downwards.

BAL's camera looks down -z with y upwards, has no principal point, one focal length, and two
coefficients of distortion. Lenses with more of it become those of `jaxba.CAMERA_MODELS`: Brown's
FULL_OPENCV, and OPENCV_FISHEYE."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from jaxba.io.files import StrPath, display_name
from jaxba.io.json_records import Record
from jaxba.io.notes import note_center
from jaxba.problem.bundle_problem import BundleProblem, ProblemError
from jaxba.problem.camera_models import CAMERA_MODELS
from jaxba.problem.geometry import COLMAP_FLIP, angle_axis
from jaxba.problem.intrinsics import Lenses

_RADIAL = {"simple_radial": 1, "radial": 2, "brown": 3, "fisheye_opencv": 4}
"""Models with two focal lengths and a principal point, and how many radial coefficients they
have."""

MODELS = ("perspective", "fisheye", *_RADIAL)  # camera models that are read


@dataclass(frozen=True)
class Lens:
    """Intrinsics of one or more images."""

    record: Record  # for messages
    size: tuple[float, float]  # of the image, pixels
    # along x and y, pixels; their ratio stays where the distortion is BAL's
    focal: tuple[float, float]
    center: tuple[float, float]  # principal point from the corner of the image; stays
    distortion: Mapping[str, float]  # by names of the camera models; others are zero
    fisheye: bool  # whether radii are angles

    @property
    def is_bal(self) -> bool:
        """Whether BAL's k1 and k2 say all of the distortion."""
        return not self.fisheye and not any(
            k for name, k in self.distortion.items() if name not in ("k1", "k2")
        )

    @property
    def model(self) -> str:
        """The camera model that has all of its numbers."""
        if self.fisheye:
            return "OPENCV_FISHEYE"
        return "RADIAL" if self.is_bal and self.focal[0] == self.focal[1] else "FULL_OPENCV"


def lens(camera: Record) -> Lens:
    """The lens of a camera. Raises ProblemError: it is of another model, or a number is missing or
    impossible."""
    model = camera.get("projection_type", "perspective").text()
    if model not in MODELS:
        camera.fail(
            f"has projection_type {model!a}, which is not read; read are {', '.join(MODELS)}"
        )
    width = camera.get("width").number()
    height = camera.get("height").number()
    if not min(width, height) > 0:
        camera.fail("has no width and height, so that nothing can be in pixels")
    side = max(width, height)

    def optional(key):
        return camera.get(key, 0.0).number()

    count = _RADIAL.get(model, 2)
    radial = model in _RADIAL
    fx, fy = (
        side * camera.get(key).number()
        for key in (("focal_x", "focal_y") if radial else ("focal", "focal"))
    )
    if not min(fx, fy) > 0:
        shown = " and ".join(f"{f:g}" for f in dict.fromkeys((fx, fy)))
        camera.fail(f"has focal length {shown}, which must be positive")
    cx, cy = (side * optional(key) if radial else 0.0 for key in ("c_x", "c_y"))
    center = width / 2 + cx, height / 2 + cy
    if not np.isfinite([fx, fy, *center]).all():
        camera.fail("has a number that is not finite in pixels")
    names = [
        *(f"k{power}" for power in range(1, count + 1)),
        *(("p1", "p2") if model == "brown" else ()),
    ]
    distortion = {name: optional(name) for name in names}
    return Lens(camera, (width, height), (fx, fy), center, distortion, model.startswith("fisheye"))


def assemble(
    path: StrPath,
    lenses: Sequence[Lens],
    lens_of: Int[np.ndarray, " cameras"],
    rotations: Float[np.ndarray, "cameras 3 3"],
    translations: Float[np.ndarray, "cameras 3"],
    points: Float[np.ndarray, "points 3"],
    pixels: Float[np.ndarray, "observations 2"],
    camera_index: Int[np.ndarray, " observations"],
    point_index: Int[np.ndarray, " observations"],
) -> BundleProblem:
    """The problem of cameras `P = R X + t`, with pixels from the corner of the image, x to the
    right, y down.

    Where the distortion of all lenses is BAL's, so are those of the problem, and covariances stand
    for a ratio of focal lengths; else all are of the other models. Raises ProblemError: something
    is not finite."""
    for one in lenses:
        note_center(path, one.record.where, one.center, one.size)
    bal = all(one.is_bal for one in lenses)
    names = ["BAL" if bal else one.model for one in lenses]
    models = tuple(CAMERA_MODELS[model] for model in dict.fromkeys(names))
    intrinsics = np.zeros((len(lenses), max(map(len, models))))
    free = np.zeros(intrinsics.shape, bool)
    for at, (one, model) in enumerate(zip(lenses, names, strict=True)):
        (fx, fy) = one.focal
        (cx, cy) = one.center
        values = {"f": fx, "fx": fx, "fy": fy, "cx": cx, "cy": cy, **one.distortion}
        moves = {"f", "fx", "fy", *({"k1", "k2"} & set(one.distortion))} if one.is_bal else set()
        for place, parameter in enumerate(CAMERA_MODELS[model].parameters):
            intrinsics[at, place], free[at, place] = values.get(parameter, 0.0), parameter in moves
    observations = pixels
    covariance = None
    if bal:
        focal, centers = (
            np.array([getattr(one, name) for one in lenses]) for name in ("focal", "center")
        )
        ratio = (focal / focal[:, :1])[lens_of][camera_index]
        observations = (pixels - centers[lens_of][camera_index]) / ratio * COLMAP_FLIP[:2]
        covariance = None if (ratio == 1).all() else np.eye(2) / ratio[:, :, None] ** 2
    unshared = len(lenses) == len(lens_of)
    model_of = (
        None if bal else np.array([list(dict.fromkeys(names)).index(model) for model in names])
    )
    poses = [angle_axis(np.diag(COLMAP_FLIP) @ rotations), translations * COLMAP_FLIP]
    try:
        return BundleProblem.create(
            np.hstack([*poses, intrinsics[lens_of]]),
            points,
            observations,
            camera_index,
            point_index,
            covariance=covariance,
            lenses=None
            if bal and unshared and free.all()
            else Lenses(lens_of, free, model_of, models),
        )
    except ProblemError as error:
        raise ProblemError(f"{display_name(path)}: {error}") from error
