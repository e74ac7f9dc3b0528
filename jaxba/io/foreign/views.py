"""What OpenMVG's and AliceVision's files have in common: views with poses and intrinsics, points with observations."""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable, Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxba.io.files import StrPath, display_name
from jaxba.io.foreign.cameras import ForeignLens, assemble
from jaxba.io.foreign.json_records import Record
from jaxba.io.notes import note
from jaxba.problem.bundle_problem import BundleProblem, ProblemError
from jaxba.problem.geometry import are_rotations, translations

UNDEFINED = 2**32 - 1
"""Number that stands for no pose or no intrinsic. Source: `UndefinedIndexT` in types.hpp of both programs."""


class View(NamedTuple):
    """An image."""

    pose: int
    intrinsic: int


class Pose(NamedTuple):
    """A camera at `center` whose frame is `rotation (X - center)`, x to the right, y down, z forward."""

    rotation: Float[np.ndarray, "3 3"]
    center: list[float]


class Landmark(NamedTuple):
    """A point."""

    position: list[float]
    views: list[int]
    pixels: list[list[float]]


def checked_pose(record: Record, rotation: Float[np.ndarray, "3 3"], center: list[float]) -> Pose:
    """A pose after a check of its rotation. Raises ProblemError."""
    if not are_rotations(rotation[None])[0]:
        record.fail("has a rotation that is none")
    return Pose(rotation, center)


def part(document: Record, key: str, program: str) -> Record:
    """One of the parts of a file, which must be there and not empty.

    Raises:
        ProblemError: it is not; the message says what the file has.
    """
    if document.has(key) and document.value[key] not in ([], {}, ""):
        return document.get(key)
    names = ("views", "intrinsics", "extrinsics", "poses", "structure")
    there = [name for name in names if document.has(name) and document.value[name] not in ([], {}, "")]
    document.fail(f"has no {key}, only {', '.join(there) or 'other parts'}: have {program} write its whole result")


@np.errstate(over="ignore", invalid="ignore")  # what is not finite then is refused or left out
def build(
    path: StrPath,
    views: Mapping[int, View],
    poses: Mapping[int, Pose],
    intrinsics: Container[int],
    lens: Callable[[int], ForeignLens],
    landmarks: Iterable[Landmark],
) -> BundleProblem:
    """The problem of a file. Cameras are the views that see a point, by their numbers; points are in the file's order.

    Observations in views that are not reconstructed are left out, with a warning that counts them.

    Args:
        path: of the file, for messages.
        views: by number.
        poses: by number; views without one are not reconstructed.
        intrinsics: their numbers; the same.
        lens: makes the lens of an intrinsic by its number.
        landmarks: the points.

    Raises:
        ProblemError: views share a pose, no observation is left, or something is not finite.
    """
    name = display_name(path)
    points, seen_views, pixels, point_index = [], [], [], []
    for number, landmark in enumerate(landmarks):
        points.append(landmark.position)
        seen_views += landmark.views
        pixels += landmark.pixels
        point_index += [number] * len(landmark.views)
    there = sorted(key for key, view in views.items() if view.pose in poses and view.intrinsic in intrinsics)
    seen = np.array(seen_views, dtype=np.int64)
    kept = np.isin(seen, np.array(there, dtype=np.int64))
    if not kept.all():
        note(path, f"{np.sum(~kept)} of {len(kept)} observations left out: their views have no pose or no intrinsic")
    if not kept.any():
        raise ProblemError(f"{name}: no view that has a pose and an intrinsic sees a point")
    names, camera_index = np.unique(seen[kept], return_inverse=True)
    cameras = [views[key] for key in names.tolist()]
    owner: dict[int, int] = {}
    for key, view in zip(names.tolist(), cameras, strict=True):
        other = owner.setdefault(view.pose, key)
        if other != key:
            raise ProblemError(
                f"{name}: views {other} and {key} share pose {view.pose}, as in a rig; rigs are not read"
            )
    if len(there) > len(names):
        note(path, f"{len(there) - len(names)} of {len(there)} views with a pose left out: they see no point")
    used = sorted({view.intrinsic for view in cameras})
    rotations = np.array([poses[view.pose].rotation for view in cameras])
    centers = np.array([poses[view.pose].center for view in cameras])
    return assemble(
        path,
        [lens(key) for key in used],
        np.searchsorted(used, [view.intrinsic for view in cameras]),
        rotations,
        translations(rotations, centers),
        np.array(points),
        np.array(pixels)[kept],
        camera_index,
        np.array(point_index)[kept],
    )
