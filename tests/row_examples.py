"""Rows of every residual of `jaxba.residuals`, and of one of a user's own, for problems of one
shape."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

import jaxba
from jaxba import BundleProblem, Loss, residuals
from jaxba.problem import geometry
from jaxba.problem.residuals import Residual, Residuals, Rows

CAMERAS = 5
POINTS = 12

READY_MADE = [name for name in residuals.__all__ if isinstance(getattr(residuals, name), Residual)]
"""Names of the residuals of the package."""

OWN = "own"
"""The name here of a residual of a user's own."""


def scene(seed: int) -> BundleProblem:
    """A random scene in which all cameras see all points, so that all scenes share programs."""
    return jaxba.random_scene(jaxba.SceneConfig(CAMERAS, POINTS, CAMERAS * POINTS), seed)


class Example(NamedTuple):
    """Rows for a scene."""

    rows: Rows
    size: int  # numbers that the function returns
    unknowns: dict[str, np.ndarray] = {}  # noqa: RUF012 - never changed


Make = Callable[[BundleProblem, np.random.Generator], Example]


def near(rng: np.random.Generator, values: np.ndarray, sigma: float) -> np.ndarray:
    """Values, and noise."""
    return values + sigma * rng.standard_normal(np.shape(values))


def centers(problem: BundleProblem) -> np.ndarray:
    """Positions of the cameras."""
    return geometry.camera_centers(problem.cameras)


def rotations(problem: BundleProblem) -> np.ndarray:
    """Rotations from the world to the cameras, in COLMAP's axes."""
    return np.diag([1.0, -1.0, -1.0]) @ geometry.rotation_matrices(problem.cameras[:, :3])


def views(problem: BundleProblem, rng: np.random.Generator) -> np.ndarray:
    """Nine observations, of nine points and as many of each camera whatever is drawn: shapes stay
    the same."""
    cameras = rng.permutation(CAMERAS)[np.arange(9) % CAMERAS]
    points = rng.permutation(POINTS)[:9]
    wanted = cameras * POINTS + points
    order = np.argsort(problem.camera_index * POINTS + problem.point_index)
    return order[wanted]


def control_point(problem: BundleProblem, rng: np.random.Generator) -> Example:
    """Three surveyed points."""
    points = rng.permutation(POINTS)[:3]
    position = near(rng, problem.points[points], 0.2)
    whitening = rng.uniform(1, 9, (3, 1, 1)) * np.eye(3)
    return Example(residuals.control_point(point=points, position=position, whitening=whitening), 3)


def distance(problem: BundleProblem, rng: np.random.Generator) -> Example:
    """Two scale bars, which fit as their standard deviations say: a solve moves no whole scene to
    them."""
    first, second = rng.permutation(POINTS)[:4].reshape(2, 2)
    length = np.linalg.norm(problem.points[first] - problem.points[second], axis=1) * rng.uniform(
        0.9, 1.1, 2
    )
    return Example(
        residuals.distance(point=first, point_2=second, length=length, sigma=0.05 * length), 1
    )


def point_to_plane(problem: BundleProblem, rng: np.random.Generator) -> Example:
    """Four points on planes."""
    points = rng.permutation(POINTS)[:4]
    normal = rng.standard_normal((4, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    on_plane = near(rng, problem.points[points], 0.15)
    return Example(
        residuals.point_to_plane(point=points, normal=normal, on_plane=on_plane, sigma=0.1), 1
    )


def baseline(problem: BundleProblem, rng: np.random.Generator) -> Example:
    """Two distances of cameras."""
    first, second = rng.permutation(CAMERAS)[:4].reshape(2, 2)
    length = np.linalg.norm(
        centers(problem)[first] - centers(problem)[second], axis=1
    ) * rng.uniform(0.9, 1.1, 2)
    return Example(
        residuals.baseline(pose=first, pose_2=second, length=length, sigma=0.05 * length), 1
    )


def gravity(problem: BundleProblem, rng: np.random.Generator) -> Example:
    """Plumb lines of three images."""
    cameras = rng.permutation(CAMERAS)[:3]
    up = rng.standard_normal(3)
    direction = near(rng, rotations(problem)[cameras] @ up, 0.05)
    return Example(residuals.gravity(pose=cameras, direction=direction, up=up[None], sigma=0.02), 3)


def heading(problem: BundleProblem, rng: np.random.Generator) -> Example:
    """Azimuths of three images."""
    cameras = rng.permutation(CAMERAS)[:3]
    up = rng.standard_normal(3)
    north = rng.standard_normal(3)
    azimuth = rng.uniform(-3, 3, 3)
    rows = residuals.heading(
        pose=cameras, azimuth=azimuth, north=north[None], up=up[None], sigma=3.0
    )
    return Example(rows, 1)


def position(problem: BundleProblem, rng: np.random.Generator) -> Example:
    """Antennas of all images."""
    at = near(rng, centers(problem), 0.3)
    lever_arm = 0.1 * rng.standard_normal((CAMERAS, 3))
    whitening = rng.uniform(1, 9, (CAMERAS, 1, 1)) * np.eye(3)
    rows = residuals.position(
        pose=np.arange(CAMERAS), position=at, lever_arm=lever_arm, whitening=whitening
    )
    return Example(rows, 3)


def depth(problem: BundleProblem, rng: np.random.Generator) -> Example:
    """A depth map with a scale of its own in each image."""
    seen = views(problem, rng)
    camera = problem.camera_index[seen]
    point = problem.point_index[seen]
    measured = near(rng, geometry.depths(problem)[seen], 0.2)
    rows = residuals.depth(pose=camera, point=point, image=camera, measured=measured, sigma=0.2)
    return Example(rows, 1, {"image": np.tile([1.0, 0.0], (CAMERAS, 1))})


def rolling_shutter(problem: BundleProblem, rng: np.random.Generator) -> Example:
    """Pixels that were taken later than their images."""
    seen = views(problem, rng)
    camera = problem.camera_index[seen]
    point = problem.point_index[seen]
    rows = residuals.rolling_shutter(
        pose=camera,
        lens=camera,
        point=point,
        velocity=camera,
        pixel=near(rng, problem.observations[seen], 2.0),
        time=rng.uniform(-0.4, 0.4, 9),
        sigma=1.0,
    )
    return Example(rows, 2, {"velocity": 0.01 * rng.standard_normal((CAMERAS, 6))})


def lens_bounds(problem: BundleProblem, rng: np.random.Generator) -> Example:
    """Bounds of the lenses of all images."""
    low = problem.cameras[:, 6:] - rng.uniform(1, 9, (CAMERAS, 3)) * [1.0, 1e-3, 1e-3]
    high = problem.cameras[:, 6:] + rng.uniform(1, 9, (CAMERAS, 3)) * [1.0, 1e-3, 1e-3]
    sigma = np.array([[0.3, 1e-3, 1e-3]])
    return Example(
        residuals.lens_bounds(lens=np.arange(CAMERAS), low=low, high=high, sigma=sigma), 6
    )


def relative_pose(problem: BundleProblem, rng: np.random.Generator) -> Example:
    """Odometry between two pairs of images."""
    first, second = rng.permutation(CAMERAS)[:4].reshape(2, 2)
    turns = rotations(problem)
    rotation = turns[first] @ np.swapaxes(turns[second], 1, 2)
    translation = np.einsum(
        "kij,kj->ki", turns[first], centers(problem)[second] - centers(problem)[first]
    )
    whitening = rng.uniform(5, 20, (2, 1, 1)) * np.eye(6)
    rows = residuals.relative_pose(
        pose=first,
        pose_2=second,
        rotation=rotation,
        translation=near(rng, translation, 0.1),
        whitening=whitening,
    )
    return Example(rows, 6)


def imu(problem: BundleProblem, rng: np.random.Generator) -> Example:
    """An inertial chain through all images, of any motion."""
    times = np.linspace(0.0, 2.0, 21)
    rates = 0.1 * rng.standard_normal((21, 3))
    forces = near(rng, np.tile([0.0, 0.0, 9.81], (21, 1)), 1.0)
    moments = np.linspace(0.0, 2.0, CAMERAS)
    data = residuals.preintegrated(times, rates, forces, moments, noise=[0.1, 0.5, 0.1, 0.1])
    mount = np.hstack([np.eye(3), 0.1 * rng.standard_normal((3, 1))])
    one = np.arange(CAMERAS - 1)
    other = np.arange(1, CAMERAS)
    gravity = np.array([[0.0, 0.0, -9.81]])
    rows = residuals.imu(
        pose=one,
        motion=one,
        pose_2=other,
        motion_2=other,
        gravity=gravity,
        mount=mount[None],
        **data,
    )
    return Example(rows, 15, {"motion": 0.1 * rng.standard_normal((CAMERAS, 9))})


@functools.cache
def drift(known: float) -> Residual:
    """A residual with a block of its own that closes over a number."""

    @jaxba.residual
    def drift(pose, pose_2, clock, clock_2, *, measured):
        way = jnp.sum((pose.center - pose_2.center) ** 2)
        return jnp.stack([known * way * (1 + clock[0]) - measured, clock[0] + clock_2[1] - known])

    return drift


def own(problem: BundleProblem, rng: np.random.Generator) -> Example:
    """Rows of one of two functions, with a block that all cameras have in common."""
    first, second = rng.permutation(CAMERAS)[:4].reshape(2, 2)
    rows = drift(float(rng.choice([0.5, 2.0])))(
        pose=first, pose_2=second, clock=[0, 0], clock_2=[0, 0], measured=rng.uniform(0.5, 2.0, 2)
    )
    return Example(rows, 2, {"clock": rng.uniform(-0.1, 0.1, (1, 2))})


MAKERS: dict[str, Make] = {
    "baseline": baseline,
    "control_point": control_point,
    "depth": depth,
    "distance": distance,
    "gravity": gravity,
    "heading": heading,
    "imu": imu,
    "lens_bounds": lens_bounds,
    "point_to_plane": point_to_plane,
    "position": position,
    "relative_pose": relative_pose,
    "rolling_shutter": rolling_shutter,
    OWN: own,
}


def with_rows_of(problem: BundleProblem, names: list[str], seed: int) -> BundleProblem:
    """The problem with rows of residuals, without the checks of `jaxba.with_residual`, which
    compiles.

    Args:
        problem: a `scene`.
        names: of `READY_MADE`, or `OWN`.
        seed: of what was measured."""
    rng = np.random.default_rng(seed)
    rows = []
    unknowns = {}
    for name in names:
        made = MAKERS[name](problem, rng)
        index = tuple(x.astype(np.int32) for x in made.rows.index)
        rows.append(replace(made.rows, size=made.size, index=index, loss=Loss("huber", 3.0)))
        unknowns |= made.unknowns
    return problem.replace(
        residuals=Residuals(tuple(rows), tuple(unknowns.values()), names=tuple(unknowns))
    )
