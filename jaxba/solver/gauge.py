"""Directions in which a problem can move without a change of its cost: those of a similarity, and points along rays.

The cost of pixels does not change when the whole scene is moved, turned and scaled about a middle m:

    X' = X + e + w x (X - m) + s (X - m),    R' = exp(-R w) R,    t' = t - R e + R (w x m) + s (t + R m).

Constants and priors leave those combinations of the seven that keep each constant number and each measured value. A
point whose rays are all parallel, as one that is seen once, can move along them.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from jaxba.problem import geometry
from jaxba.problem.bundle_problem import BundleProblem
from jaxba.problem.intrinsics import POSE_SIZE
from jaxba.problem.priors import Priors
from jaxba.structure.layout import Layout

BROKEN = 1e-9
"""Change of what must stay, as a share of the scene's extent and of one radian, from which a direction is not free."""

PARALLEL = 1e-14
"""Squared sine of the angle between rays from which they are not parallel: some rounding errors of a squared one."""

SIMILARITY = 7
"""Degrees of freedom of a similarity."""


def free_gauge(
    problem: BundleProblem, layout: Layout
) -> tuple[Float[np.ndarray, "directions cameras width"], Float[np.ndarray, "directions points 3"]]:
    """The directions of a similarity that a problem leaves free, as steps of its unknowns.

    Args:
        problem: as its layout has it: `in_frames` if it has rigs.
        layout: of the problem.

    Returns:
        Up to seven independent directions, scene units: of each camera's block of unknowns and of each point. What does
        not move, and what nothing observes, has zeros.
    """
    cameras, points, unknowns = np.asarray(problem.cameras), np.asarray(problem.points), layout.unknowns
    seen = np.asarray(layout.camera_seen)[: problem.num_cameras]
    observed = np.bincount(problem.point_index, minlength=problem.num_points) > 0
    rotation, translation = geometry.rotation_matrices(cameras[:, :3]), cameras[:, 3:6]
    middle = points[observed].mean(axis=0)
    from_middle, moved = points - middle, translation + rotation @ middle
    extent = max(np.linalg.norm(x, axis=1).max() for x in (from_middle[observed], moved[seen]))
    in_rigs = unknowns is not None and unknowns.in_rigs

    axes = np.eye(3)
    poses = np.zeros((SIMILARITY, problem.num_cameras, POSE_SIZE))
    lens = np.zeros((*poses.shape[:2], cameras.shape[1] - POSE_SIZE))
    poses[:3, :, 3:] = -extent * rotation.transpose(2, 0, 1)
    poses[3:6, :, :3] = -rotation.transpose(2, 0, 1)
    poses[3:6, :, 3:] = np.einsum("nij,kj->kni", rotation, np.cross(axes, middle))
    poses[6, :, 3:] = moved
    if in_rigs:
        lens[6, :, -3:] = cameras[:, -3:]  # the places of cameras in their rigs
    turned = np.cross(axes[:, None], from_middle)
    by_points = np.concatenate([np.tile(extent * axes[:, None], (1, len(points), 1)), turned, from_middle[None]])
    by_points[:, ~observed] = 0.0
    by_cameras = np.concatenate([poses, lens], axis=2)
    by_cameras[:, ~seen] = 0.0

    columns = range(lens.shape[2]) if unknowns is None else unknowns.columns
    block = [*range(POSE_SIZE), *(POSE_SIZE + column for column in columns)]
    moves, free_points = np.zeros(by_cameras.shape[1:], bool), np.ones(len(points), bool)
    moves[:, block] = True
    if unknowns is not None and unknowns.free is not None:
        moves[:, block] = np.asarray(unknowns.free).T[: len(cameras)]
    if problem.constants is not None:
        free_points = ~np.asarray(problem.constants.points)
    # what must stay, lengths in extents
    turns = np.arange(by_cameras.shape[2]) < 3
    staying = np.where(turns, by_cameras, by_cameras / extent)[:, ~moves]
    rows = [staying, by_points[:, ~free_points].reshape(SIMILARITY, -1) / extent]
    if unknowns is not None and unknowns.priors is not None:
        rows += _measured(cameras, by_cameras, unknowns.priors, in_rigs, extent)
    vectors, values, _ = np.linalg.svd(np.concatenate([*rows, np.zeros((SIMILARITY, SIMILARITY))], axis=1))
    free = vectors[:, values <= BROKEN].T
    combined = lambda x: np.einsum("ak,kni->ani", free, x)
    return combined(by_cameras * moves)[:, :, block], combined(by_points * free_points[:, None])


def _measured(cameras: np.ndarray, steps: np.ndarray, priors: Priors, in_rigs: bool, extent: float) -> list[np.ndarray]:
    """How measured positions (in extents) and rotations of cameras change with each direction."""
    rotation, turn = geometry.rotation_matrices(cameras[:, :3]), steps[:, :, :3]
    translation, shifted = cameras[:, 3:6], steps[:, :, 3:6]
    if in_rigs:  # the centre in the frame's axes, -R^T (t + M^T m)
        placed = geometry.rotation_matrices(cameras[:, -6:-3]).transpose(0, 2, 1)
        translation = translation + np.einsum("nij,nj->ni", placed, cameras[:, -3:])
        shifted = shifted + np.einsum("nij,knj->kni", placed, steps[:, :, -3:])
    # C = -R^T t: of exp(d) R, R^T [d]x t more
    center = np.einsum("nji,knj->kni", rotation, np.cross(turn, translation) - shifted) / extent
    found = []
    for change, whitening in ((center, priors.position_whitening), (turn, priors.rotation_whitening)):
        whitening = np.asarray(whitening)[: len(cameras)]
        size = np.linalg.norm(whitening, axis=(1, 2), keepdims=True)
        shape = whitening / np.where(size > 0, size, 1.0)
        found.append(np.einsum("nij,knj->kni", shape, change).reshape(SIMILARITY, -1))
    return found


def determined_directions(problem: BundleProblem) -> Float[np.ndarray, "points 3 3"]:
    """For each point the projection on the directions in which its rays determine it.

    It is the identity for a point with rays that are not parallel, zero for one that is constant or has no rays.

    Args:
        problem: in the coordinates of its own cameras, not `in_frames`.
    """
    centers = geometry.camera_centers(problem.cameras)
    rays = np.asarray(problem.points)[problem.point_index] - centers[problem.camera_index]
    rays = rays / np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), np.finfo(float).tiny)
    across = np.eye(3) - rays[:, :, None] * rays[:, None]
    if problem.whitening is not None:
        across = across * np.asarray(problem.whitening).any(axis=(1, 2), keepdims=True)
    total = np.zeros((problem.num_points, 3, 3))
    np.add.at(total, problem.point_index, across)
    values, vectors = np.linalg.eigh(total)
    kept = np.greater(values, PARALLEL * np.maximum(values[:, 2:], np.finfo(float).tiny))
    if problem.constants is not None:
        kept &= ~np.asarray(problem.constants.points)[:, None]
    return np.where(
        np.logical_and.reduce(kept, axis=1)[:, None, None],
        np.eye(3),
        (vectors * kept[:, None]) @ vectors.transpose(0, 2, 1),
    )
