"""Directions in which a problem can move without a change of its cost: those of a similarity, and
points along rays.

The cost of pixels does not change when the whole scene is moved, turned and scaled about a middle
m, in units of l:

    X' = X + l e + w x (X - m) + s (X - m),    R' = exp(-R w) R,    t' = t - l R e + R (w x m) + s
    (t + R m).

Constants, rigs, priors and other residuals leave those combinations of the seven that keep each
constant number and each residual. A point whose rays are all parallel, as one that is seen once,
can move along them."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from jaxba.problem import geometry
from jaxba.problem.bundle_problem import BundleProblem
from jaxba.problem.frames import free_poses, in_frames
from jaxba.problem.intrinsics import POSE_SIZE
from jaxba.problem.preprocess import far_middle, middle_and_extent, observed, shift
from jaxba.problem.rigs import first_of_group
from jaxba.problem.row_changes import changes_by_similarity

SIMILARITY = 7  # degrees of freedom of a similarity

RESOLVED = 1e-7
"""Smallest change that is not rounding, of lengths as shares of the scene's extent and of radians.
What a cost knows of it is a square, and this squared is some rounding errors of float64."""


def fixed_freedoms(problem: BundleProblem) -> int:
    """How many of a similarity's seven freedoms constants, rigs and residuals fix, as a solve
    shifts the problem."""
    return SIMILARITY - freedoms(shift(problem, -far_middle(problem)))[0].shape[1]


def free_directions(
    problem: BundleProblem,
) -> tuple[
    Float[np.ndarray, "directions cameras parameters"], Float[np.ndarray, "directions points 3"]
]:
    """The directions of a similarity that a problem near the origin leaves free, up to seven, scene
    units: steps of the parameters of cameras as `in_frames` has them, rotations on the manifold,
    and of points. What does not move, and what nothing observes, has zeros."""
    combinations, steps, points_move, middle, extent = freedoms(problem)
    of_poses = np.einsum("nij,jk->kni", steps, combinations)
    # rotation and translation
    of_poses *= np.where(np.arange(of_poses.shape[2]) % POSE_SIZE < 3, 1.0, extent)
    lens = np.zeros((*of_poses.shape[:2], problem.cameras.shape[1] - POSE_SIZE))
    moved = _motions((np.asarray(problem.points) - middle) / extent)
    of_points = extent * np.einsum("nij,jk->kni", moved, combinations) * points_move[:, None]
    return np.concatenate(
        [of_poses[:, :, :POSE_SIZE], lens, of_poses[:, :, POSE_SIZE:]], axis=2
    ), of_points


def freedoms(
    problem: BundleProblem, *, of_rows: bool = True
) -> tuple[Float[np.ndarray, "7 directions"], np.ndarray, np.ndarray, np.ndarray, float]:
    """An orthonormal basis of the combinations of w, e and s (in this order) that are free;
    derivatives of poses by the seven, and of extrinsics in rigs, (cameras, numbers, 7), with
    lengths in extents and zero for what is constant; which points move; the middle and the extent.
    Without `of_rows` residuals other than those of pixels fix nothing."""
    here = in_frames(problem)
    constants = problem.constants
    seen, points_move = observed(problem)
    middle, extent = middle_and_extent(problem)
    extent = extent if extent > 0 else 1.0
    cameras = np.asarray(here.cameras, np.float64)
    rotation = geometry.rotation_matrices(cameras[:, :3])
    free = free_poses(here)
    steps = np.zeros((*free.shape, SIMILARITY))
    steps[:, :3, :3] = steps[:, 3:6, 3:6] = -rotation
    steps[:, 3:6, :3] = np.cross(middle, rotation) / extent
    steps[:, 3:6, 6] = (cameras[:, 3:6] + rotation @ middle) / extent
    rows = [np.zeros((SIMILARITY, SIMILARITY))]
    if here.rigs is not None:
        rows.append(_scale_rigs(here, steps, seen, free, extent))
    rows.append(steps[seen][~free[seen]])
    if constants is not None:
        held = np.asarray(constants.points) & points_move
        rows.append(_motions((np.asarray(problem.points)[held] - middle) / extent))
        points_move = points_move & ~held
    rows += changes_by_similarity(problem, middle, extent) if of_rows else []
    staying = np.concatenate([part.reshape(-1, SIMILARITY) for part in rows])
    # far away small turns are large motions
    staying /= np.maximum(np.abs(staying).max(axis=1, keepdims=True), 1.0)
    _, values, basis = np.linalg.svd(staying, full_matrices=False)
    moves = free & seen[:, None]
    return basis[values <= RESOLVED].T, steps * moves[:, :, None], points_move, middle, extent


def _scale_rigs(
    here: BundleProblem,
    steps: Float[np.ndarray, "cameras 12 7"],
    seen: Bool[np.ndarray, " cameras"],
    free: Bool[np.ndarray, "cameras 12"],
    extent: float,
) -> Float[np.ndarray, "moved 3 7"]:
    """Adds to steps how the places of cameras in rigs change with the scale; returns what must not
    change besides.

    A rig becomes larger about the first of its cameras whose place is constant: the poses of frames
    move so that it is where it has to be. All cameras of a lens have the same place."""
    assert here.rigs is not None
    frame, turn, moved = (
        np.asarray(x) for x in (here.rigs.frame, here.rigs.rotation, here.rigs.translation)
    )
    places_move = free[:, POSE_SIZE:].any(axis=1)
    held = np.flatnonzero(seen & ~places_move)
    moving = np.flatnonzero(seen & places_move)
    if len(held):
        first = np.where(np.isin(frame, frame[held]), first_of_group(frame, held), held[0])
        center = np.einsum("nji,nj->ni", turn, moved)[first]
        steps[:, 3:6, 6] += center / extent
        moved = moved - np.einsum("nij,nj->ni", turn, center)
    steps[:, 9:, 6] = moved / extent
    same = first_of_group(
        np.arange(len(frame)) if here.lenses is None else np.asarray(here.lenses.index), moving
    )
    return steps[moving, 9:] - steps[same[moving], 9:]


def _motions(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3 7"]:
    """Derivatives of positions, about the middle and in extents, by a rotation, a translation and
    the scale."""
    axes = np.broadcast_to(np.eye(3), (len(points), 3, 3))
    return np.concatenate([np.cross(points[:, None], axes), axes, points[:, :, None]], axis=2)


def determined_directions(problem: BundleProblem) -> Float[np.ndarray, "points 3 3"]:
    """For each point of a problem with cameras, not frames, the projection on the directions in
    which its rays determine it: the identity where they are not parallel, zero for a point that is
    constant or has no rays."""
    centers = geometry.camera_centers(problem.cameras)
    rays = np.asarray(problem.points)[problem.point_index] - centers[problem.camera_index]
    rays = rays / np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), np.finfo(float).tiny)
    across = np.eye(3) - rays[:, :, None] * rays[:, None]
    if problem.whitening is not None:
        across = across * np.asarray(problem.whitening).any(axis=(1, 2), keepdims=True)
    total = np.zeros((problem.num_points, 3, 3))
    np.add.at(total, problem.point_index, across)
    values, vectors = np.linalg.eigh(total)
    kept = np.greater(values, RESOLVED**2 * np.maximum(values[:, 2:], np.finfo(float).tiny))
    if problem.constants is not None:
        kept &= ~np.asarray(problem.constants.points)[:, None]
    return np.where(
        np.logical_and.reduce(kept, axis=1)[:, None, None],
        np.eye(3),
        (vectors * kept[:, None]) @ vectors.transpose(0, 2, 1),
    )
