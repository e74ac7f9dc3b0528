"""What OpenMVG's and AliceVision's files have in common: views with poses and intrinsics, points with observations."""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable, Mapping

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


Pose = tuple[Float[np.ndarray, "3 3"], list[float]]
"""Rotation and centre of a camera whose frame is `rotation (X - center)`, x to the right, y down, z forward."""

Landmark = tuple[list[float], list[int], list[list[float]]]
"""A point: its position, the numbers of its views, and their pixels."""


def checked_pose(record: Record, rotation: Float[np.ndarray, "3 3"], center: list[float]) -> Pose:
    """A pose after a check of its rotation. Raises ProblemError."""
    if not are_rotations(rotation[None])[0]:
        record.fail("has a rotation that is none")
    return rotation, center


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
    views: Mapping[int, tuple[int, int]],
    poses: Mapping[int, Pose],
    intrinsics: Container[int],
    lens: Callable[[int], ForeignLens],
    landmarks: Iterable[Landmark],
) -> BundleProblem:
    """The problem of a file. Cameras are the views that see a point, by their numbers; points are in the file's order.

    Observations in views that are not reconstructed are left out, with a warning that counts them.

    Args:
        path: of the file, for messages.
        views: numbers of pose and intrinsic by the number of a view.
        poses: by number; views without one are not reconstructed.
        intrinsics: their numbers; the same.
        lens: makes the lens of an intrinsic by its number.
        landmarks: the points.

    Raises:
        ProblemError: views share a pose, no observation is left, or something is not finite.
    """
    name = display_name(path)
    points, seen_views, pixels, point_index = [], [], [], []
    for number, (position, seen_by, at) in enumerate(landmarks):
        points.append(position)
        seen_views += seen_by
        pixels += at
        point_index += [number] * len(seen_by)
    there = sorted(key for key, (pose, intrinsic) in views.items() if pose in poses and intrinsic in intrinsics)
    seen = np.array(seen_views, dtype=np.int64)
    kept = np.isin(seen, np.array(there, dtype=np.int64))
    if not kept.all():
        note(path, f"{np.sum(~kept)} of {len(kept)} observations left out: their views have no pose or no intrinsic")
    if not kept.any():
        raise ProblemError(f"{name}: no view that has a pose and an intrinsic sees a point")
    names, camera_index = np.unique(seen[kept], return_inverse=True)
    owner: dict[int, int] = {}
    for key in names.tolist():
        pose = views[key][0]
        other = owner.setdefault(pose, key)
        if other != key:
            raise ProblemError(f"{name}: views {other} and {key} share pose {pose}, as in a rig; rigs are not read")
    if len(there) > len(names):
        note(path, f"{len(there) - len(names)} of {len(there)} views with a pose left out: they see no point")
    of_cameras = [views[key][1] for key in names.tolist()]
    used = sorted(set(of_cameras))
    rotations, centers = (np.array([poses[pose][part] for pose in owner]) for part in (0, 1))
    return assemble(
        path,
        [lens(key) for key in used],
        np.searchsorted(used, of_cameras),
        rotations,
        translations(rotations, centers),
        np.array(points),
        np.array(pixels)[kept],
        camera_index,
        np.array(point_index)[kept],
    )
