"""From the cameras of other programs to a problem: lenses in pixels, poses that look down +z with y downwards.

This is the convention of OpenSfM, OpenMVG and AliceVision, which have views with poses and intrinsics, and points with
observations, in common. BAL's camera looks down -z with y upwards, has no principal point, one focal length, and two
coefficients of distortion. Lenses with more of it become those of `jaxba.CAMERA_MODELS`: Brown's FULL_OPENCV, and
OPENCV_FISHEYE."""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from jaxba.io.files import StrPath, display_name
from jaxba.io.foreign.json_records import Record
from jaxba.io.notes import note, note_center
from jaxba.problem.bundle_problem import BundleProblem, ProblemError
from jaxba.problem.camera_models import CAMERA_MODELS
from jaxba.problem.geometry import COLMAP_FLIP, angle_axis, are_rotations
from jaxba.problem.geometry import translations as translations_of
from jaxba.problem.intrinsics import Lenses

BROWN, FISHEYE = ("k1", "k2", "k3", "p1", "p2"), ("k1", "k2", "k3", "k4")
"""Coefficients of the two kinds of distortion, in the order in which OpenMVG and AliceVision write them."""

UNDEFINED = 2**32 - 1  # stands for no pose or no intrinsic. Source: `UndefinedIndexT` in types.hpp of both programs

Pose = tuple[Float[np.ndarray, "3 3"], list[float]]
"""Rotation and centre of a camera whose frame is `rotation (X - center)`, x to the right, y down, z forward."""

Landmark = tuple[list[float], list[int], list[list[float]]]  # position of a point, numbers of its views, their pixels


@dataclass(frozen=True)
class ForeignLens:
    """Intrinsics of one or more images."""

    label: str  # how messages call it, such as `intrinsic 3`
    focal: tuple[float, float]  # along x and y, pixels; their ratio stays where the distortion is BAL's
    center: tuple[float, float]  # principal point from the corner of the image, as observations are; stays
    distortion: Mapping[str, float]  # by names of the camera models; others are zero
    fisheye: bool  # whether radii are angles
    size: tuple[float, float]  # of the image, pixels
    free: bool = True  # whether f, k1 and k2, where they are coefficients of BAL's distortion, may be optimised

    @property
    def is_bal(self) -> bool:
        """Whether BAL's k1 and k2 say all of the distortion."""
        return not self.fisheye and not any(k for name, k in self.distortion.items() if name not in ("k1", "k2"))

    @property
    def model(self) -> str:
        """The camera model that has all of its numbers."""
        if self.fisheye:
            return "OPENCV_FISHEYE"
        return "RADIAL" if self.is_bal and self.focal[0] == self.focal[1] else "FULL_OPENCV"


def _assemble(
    path: StrPath,
    lenses: Sequence[ForeignLens],
    lens_of: Int[np.ndarray, " cameras"],
    rotations: Float[np.ndarray, "cameras 3 3"],
    translations: Float[np.ndarray, "cameras 3"],
    points: Float[np.ndarray, "points 3"],
    pixels: Float[np.ndarray, "observations 2"],
    camera_index: Int[np.ndarray, " observations"],
    point_index: Int[np.ndarray, " observations"],
) -> BundleProblem:
    """The problem of cameras in the convention of this module, `P = R X + t`, with pixels x to the right, y down.

    Where the distortion of all lenses is BAL's, so are those of the problem, and covariances stand for a ratio of focal
    lengths; else all are of the other models. Raises ProblemError: a lens is impossible, or something is not finite."""
    name = display_name(path)
    for lens in lenses:
        _check(lens, name)
        note_center(path, lens.label, lens.center, lens.size)
    bal = all(lens.is_bal for lens in lenses)
    names = ["BAL" if bal else lens.model for lens in lenses]
    models = tuple(CAMERA_MODELS[model] for model in dict.fromkeys(names))
    intrinsics = np.zeros((len(lenses), max(map(len, models))))
    free = np.zeros(intrinsics.shape, bool)
    for at, (lens, model) in enumerate(zip(lenses, names, strict=True)):
        (fx, fy), (cx, cy) = lens.focal, lens.center
        values = {"f": fx, "fx": fx, "fy": fy, "cx": cx, "cy": cy, **lens.distortion}
        moves = {"f", "fx", "fy", *({"k1", "k2"} & set(lens.distortion))} if lens.free and lens.is_bal else set()
        for place, parameter in enumerate(CAMERA_MODELS[model].parameters):
            intrinsics[at, place], free[at, place] = values.get(parameter, 0.0), parameter in moves
    observations, covariance = pixels, None
    if bal:
        focal, centers = (np.array([getattr(lens, name) for lens in lenses]) for name in ("focal", "center"))
        ratio = (focal / focal[:, :1])[lens_of][camera_index]
        observations = (pixels - centers[lens_of][camera_index]) / ratio * COLMAP_FLIP[:2]
        covariance = None if (ratio == 1).all() else np.eye(2) / ratio[:, :, None] ** 2
    unshared = len(np.unique(lens_of)) == len(lens_of)
    model_of = None if bal else np.array([list(dict.fromkeys(names)).index(model) for model in names])
    poses = [angle_axis(np.diag(COLMAP_FLIP) @ rotations), translations * COLMAP_FLIP]
    try:
        return BundleProblem.create(
            np.hstack([*poses, intrinsics[lens_of]]),
            points,
            observations,
            camera_index,
            point_index,
            covariance=covariance,
            lenses=None if bal and unshared and free.all() else Lenses(lens_of, free, model_of, models),
        )
    except ProblemError as error:
        raise ProblemError(f"{name}: {error}") from error


def _check(lens: ForeignLens, name: str) -> None:
    numbers = [*lens.focal, *lens.center, *lens.distortion.values()]
    if not np.isfinite(numbers).all():
        raise ProblemError(f"{name}: {lens.label} has a number that is not finite")
    if not min(lens.focal) > 0:
        shown = " and ".join(f"{f:g}" for f in dict.fromkeys(lens.focal))
        raise ProblemError(f"{name}: {lens.label} has focal length {shown}, which must be positive")


def checked_pose(record: Record, rotation: np.ndarray, center: list[float]) -> Pose:
    """A pose after a check of its rotation. Raises ProblemError."""
    if rotation.shape != (3, 3) or not are_rotations(rotation[None])[0]:
        record.fail("has a rotation that is none")
    return rotation, center


def part(document: Record, key: str, program: str) -> Record:
    """A part of a file, which must be there and not empty. Raises ProblemError: it is not; says what there is."""
    if document.has(key) and document.value[key] not in ([], {}, ""):
        return document.get(key)
    names = ("views", "intrinsics", "extrinsics", "poses", "structure")
    there = [name for name in names if document.has(name) and document.value[name] not in ([], {}, "")]
    document.fail(f"has no {key}, only {', '.join(there) or 'other parts'}: have {program} write its whole result")


@np.errstate(over="ignore", invalid="ignore")  # what is not finite then is refused
def build(
    path: StrPath,
    views: Mapping[int, tuple[int, Any]],
    poses: Mapping[int, Pose],
    intrinsics: Container[Any],
    lens: Callable[[Any], ForeignLens],
    landmarks: Iterable[Landmark],
) -> BundleProblem:
    """The problem of a file. Cameras are the views that see a point, by their numbers; points are in the file's order.

    Views have the numbers of a pose and an intrinsic; observations in views whose pose or intrinsic is not there are
    left out, with a warning that counts them. `lens` makes the lens of an intrinsic."""
    name = display_name(path)
    points, seen_views, pixels, point_index = [], [], [], []
    for number, (position, seen_by, at) in enumerate(landmarks):
        points.append(position)
        seen_views += seen_by
        pixels += at
        point_index += [number] * len(seen_by)
    there = [key for key, (pose, intrinsic) in views.items() if pose in poses and intrinsic in intrinsics]
    seen = np.array(seen_views, dtype=np.int64)
    kept = np.isin(seen, np.array(there, dtype=np.int64))
    if not kept.all():
        note(path, f"{np.sum(~kept)} of {len(kept)} observations left out: their views have no pose or no intrinsic")
    if not kept.any():
        raise ProblemError(f"{name}: no view that has a pose and an intrinsic sees a point")
    names, camera_index = np.unique(seen[kept], return_inverse=True)
    owner: dict[int, int] = {}
    for key in names.tolist():
        other = owner.setdefault(views[key][0], key)
        if other != key:
            raise ProblemError(
                f"{name}: views {other} and {key} share pose {views[key][0]}, as in a rig; rigs are not read"
            )
    if len(there) > len(names):
        note(path, f"{len(there) - len(names)} of {len(there)} views with a pose left out: they see no point")
    of_cameras = [views[key][1] for key in names.tolist()]
    used = list(dict.fromkeys(sorted(of_cameras)))
    rotations, centers = (np.array(parts) for parts in zip(*(poses[pose] for pose in owner), strict=True))
    return _assemble(
        path,
        [lens(key) for key in used],
        np.array([used.index(key) for key in of_cameras]),
        rotations,
        translations_of(rotations, centers),
        np.array(points),
        np.array(pixels)[kept],
        camera_index,
        np.array(point_index)[kept],
    )
