"""How much of a scene's position, orientation and scale is fixed."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from jaxba.problem import geometry
from jaxba.problem.bundle_problem import BundleProblem
from jaxba.typing import AnyArray

NUMERICAL_RANK = 1e-6
"""Smallest singular value, as a share of the largest, of a freedom that is fixed."""


def fixed_freedoms(problem: BundleProblem, *, scale_known: bool = False) -> int:
    """How many of the seven freedoms of a similarity constants and priors fix.

    Args:
        problem: any problem.
        scale_known: whether something else gives the scale.
    """
    constants, priors = problem.constants, problem.priors
    cameras = np.asarray(problem.cameras, np.float64)
    matrices, centers = geometry.rotation_matrices(cameras[:, :3]), geometry.camera_centers(cameras)
    middle = np.median(centers, axis=0)
    extent = max(float(np.median(np.linalg.norm(centers - middle, axis=1))), np.finfo(float).tiny)
    centers = (centers - middle) / extent
    turned = np.tile(np.eye(3, 7), (len(cameras), 1, 1))  # columns: rotation, translation, scale
    rows = [np.eye(7)[6:]] if scale_known else []
    seen = np.bincount(problem.camera_index, minlength=problem.num_cameras) > 0
    placed = np.bincount(problem.point_index, minlength=problem.num_points) > 0
    if constants is not None:
        held = seen
        if problem.rigs is not None:
            frame = np.asarray(problem.rigs.frame)
            held = np.isin(frame, frame[seen])
        poses = np.asarray(constants.poses) & held[:, None]
        points = (np.asarray(problem.points, np.float64)[np.asarray(constants.points) & placed] - middle) / extent
        # t = -R c moves by -R v for a translation v, not at all for a rotation, and by s t for the scale
        scaled = -np.einsum("nij,nj->ni", matrices, centers)[:, :, None]
        moved = np.concatenate([0 * matrices, -matrices, scaled], axis=2)
        rows += [turned[poses[:, 0]], moved[poses[:, 3:]], _motions(points)]
    if priors is not None:  # images that nothing sees have none (structure/unknowns.py)
        rows += [(_directions(priors.position_whitening) @ _motions(centers))[seen]]
        rows += [(_directions(priors.rotation_whitening) @ matrices @ turned)[seen]]
    stacked = np.concatenate([np.zeros((1, 7)), *(part.reshape(-1, 7) for part in rows)])
    values = np.linalg.svd(stacked.T @ stacked, compute_uv=False)
    return int(np.sum(values > NUMERICAL_RANK**2 * max(values[0], np.finfo(float).tiny)))


def _motions(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3 7"]:
    """Derivatives of positions by a rotation, a translation and the scale."""
    x, y, z = points.T
    nothing = np.zeros_like(x)
    crossed = np.array([[nothing, z, -y], [-z, nothing, x], [y, -x, nothing]]).transpose(2, 0, 1)
    return np.concatenate([crossed, np.tile(np.eye(3), (len(points), 1, 1)), points[:, :, None]], axis=2)


def _directions(whitening: Float[AnyArray, "n 3 3"]) -> Float[np.ndarray, "n 3 3"]:
    """Whitening matrices without their sizes."""
    matrices = np.asarray(whitening, np.float64)
    size = np.abs(matrices).max(axis=(1, 2), initial=0, keepdims=True)
    return matrices / np.where(size > 0, size, 1)
