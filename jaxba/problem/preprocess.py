"""Preprocessing of a problem: what is observed, where the scene is; shift and perturb."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from jaxba.problem.bundle_problem import BundleProblem, ProblemError
from jaxba.problem.checks import random_numbers, real_number
from jaxba.problem.geometry import camera_centers, rotation_matrices, translations
from jaxba.problem.row_owners import block_groups, owners_of
from jaxba.problem.similarity import Similarity, transformed

FAR = 10.0
"""Distance of a scene from the origin, relative to its extent, from which it is solved around the
origin. BAL rotations are about the origin: far from it, small rotations are large motions, which
distorts the damping and loses digits."""

# fewest observations that determine a point. Source: rootba, which drops points with fewer
MIN_TRACK = 2


def far_middle(problem: BundleProblem) -> Float[np.ndarray, "3"]:
    """The marginal median of the points if a scene is far from the origin, as georeferenced scenes
    are; else zero.

    "Far" is more than `FAR` times the extent. In scene units."""
    middle, extent = middle_and_extent(problem)
    with np.errstate(all="ignore"):
        return middle if np.linalg.norm(middle) > FAR * extent > 0 else np.zeros(3)


def middle_and_extent(problem: BundleProblem) -> tuple[Float[np.ndarray, "3"], float]:
    """The marginal median of the observed points, of the cameras if there are none as in a pose
    graph, and the larger of the median distances of points and of cameras from it, scene units;
    zeros if nothing is observed."""
    cameras, points = observed(problem)
    with np.errstate(all="ignore"):  # a scene that overflows is rejected later, with a message
        positions = np.asarray(problem.points, np.float64)[points]
        centers = camera_centers(np.asarray(problem.cameras, np.float64)[cameras])
        places = [part for part in (positions, centers) if len(part)]
        if not places:
            return np.zeros(3), 0.0
        middle = np.median(places[0], axis=0)
        return middle, max(float(np.median(np.linalg.norm(p - middle, axis=1))) for p in places)


def observed(
    problem: BundleProblem,
) -> tuple[Bool[np.ndarray, " cameras"], Bool[np.ndarray, " points"]]:
    """Whether each camera, and each point, has an observation or a row of another residual."""
    cameras = np.bincount(problem.camera_index, minlength=problem.num_cameras) > 0
    points = np.bincount(problem.point_index, minlength=problem.num_points) > 0
    groups = block_groups(problem)
    for rows in problem.residuals.rows:
        owners = owners_of(problem, rows, groups)
        for own in owners.cameras:
            cameras[own[own >= 0]] = True
        for own in owners.points:
            points[own[own >= 0]] = True
    return cameras, points


def shift(problem: BundleProblem, offset: Float[np.ndarray, "3"]) -> BundleProblem:
    """The same scene translated by an offset, scene units, but for cameras and points without
    observations."""
    if not np.any(offset):
        return problem
    return transformed(problem, Similarity(1.0, np.eye(3), offset), *observed(problem))


def perturb(
    problem: BundleProblem,
    seed: int | np.random.Generator,
    rotation_sigma: float = 0.0,
    translation_sigma: float = 0.0,
    point_sigma: float = 0.0,
) -> BundleProblem:
    """Adds Gaussian noise to the start of a problem; the observations stay. Raises ProblemError: a
    sigma is negative or not finite. Source: Ceres `BALProblem::Perturb`.

    As in Ceres, rotation noise is added to the angle-axis vector with the camera *centre* held
    fixed, then translation noise is added to `t = -R c`. rootba adds it to c: the same
    distribution.

    Args:
        problem: the problem to perturb.
        seed: a seed or a generator; the same seed gives the same numbers.
        rotation_sigma: radians, on each component of the angle-axis vector.
        translation_sigma: scene units, on each component.
        point_sigma: scene units, on each coordinate."""
    for name, sigma in (
        ("rotation", rotation_sigma),
        ("translation", translation_sigma),
        ("point", point_sigma),
    ):
        if not 0 <= real_number(f"{name}_sigma", sigma) < np.inf:
            raise ProblemError(f"{name}_sigma must not be negative, got {sigma}")
    rng = random_numbers(seed)
    points = np.asarray(problem.points, dtype=np.float64)
    points = points + point_sigma * rng.standard_normal(points.shape)
    cameras = np.array(problem.cameras, dtype=np.float64)
    centers = camera_centers(cameras)
    rotation_noise = rng.standard_normal((problem.num_cameras, 3))
    translation_noise = translation_sigma * rng.standard_normal((problem.num_cameras, 3))
    if rotation_sigma > 0:
        cameras[:, :3] += rotation_sigma * rotation_noise
        cameras[:, 3:6] = translations(rotation_matrices(cameras[:, :3]), centers)
    cameras[:, 3:6] += translation_noise
    return problem.replace(cameras=cameras, points=points)
