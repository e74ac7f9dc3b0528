"""Of every kind of measurement: right data have no note, and a gross error of one row has one that
names the row."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Float
from scipy.spatial.transform import Rotation

import jaxba
from jaxba import BundleProblem, residuals
from jaxba.problem.residuals import Rows

CAMERAS = 8
POINTS = 40
FOCAL, PIXEL = 700.0, 0.5  # pixels
GROSS = 20.0  # standard deviations
SEEDS = 30

MOMENTS = 0.5 * np.arange(CAMERAS)  # of the images, seconds
RATE = 100.0  # samples of the IMU in a second
GRAVITY = np.array([0.0, 0.0, -9.81])
IMU_NOISE = (1e-3, 1e-2, 1e-4, 1e-3)
COLMAP_AXES = np.diag([1.0, -1.0, -1.0])


class Scene(NamedTuple):
    """What is true; cameras have COLMAP's axes."""

    turns: Float[np.ndarray, "cameras 3 3"]  # from the world to the camera
    centres: Float[np.ndarray, "cameras 3"]
    points: Float[np.ndarray, "points 3"]


class Measurement(NamedTuple):
    """Rows of a residual, which row has the gross error, what a note calls it, and starts of
    blocks."""

    rows: Rows
    name: str
    blocks: dict[str, np.ndarray] = {}  # noqa: RUF012 - never changed


Draw = Callable[[Scene, np.random.Generator, float], Measurement]
"""Draws measurements of a scene, with an error of so many standard deviations in one row."""


def centre_at(time: Float[np.ndarray, "*times"]) -> Float[np.ndarray, "*times 3"]:
    """The path of the cameras, an arc around the points that rises and falls."""
    angle = 0.3 * time
    return np.stack([6 * np.cos(angle), 6 * np.sin(angle), 1 + 0.5 * np.sin(1.5 * time)], axis=-1)


def attitude_at(time: Float[np.ndarray, " times"]) -> Rotation:
    """Rotations from the cameras, which look at the origin, to the world."""
    ahead = -centre_at(time)
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    return Rotation.from_matrix(np.stack([right, np.cross(ahead, right), ahead], axis=2))


def scene_and_start(rng: np.random.Generator) -> tuple[Scene, BundleProblem]:
    """A random scene, and a problem near it with noisy pixels of one known lens."""
    turns = attitude_at(MOMENTS).inv().as_matrix()
    scene = Scene(turns, centre_at(MOMENTS), rng.uniform(-1.5, 1.5, (POINTS, 3)))
    camera, point = np.divmod(np.arange(CAMERAS * POINTS), POINTS)
    inside = np.einsum("nij,nj->ni", turns[camera], scene.points[point] - scene.centres[camera])
    pixels = FOCAL * inside[:, :2] / inside[:, 2:] * [1.0, -1.0]
    pixels += PIXEL * rng.standard_normal(pixels.shape)
    start_turns = (
        Rotation.from_rotvec(0.003 * rng.standard_normal((CAMERAS, 3))).as_matrix() @ turns
    )
    start_centres = scene.centres + 0.02 * rng.standard_normal((CAMERAS, 3))
    shift = -np.einsum("nij,nj->ni", start_turns, start_centres) @ COLMAP_AXES
    vectors = Rotation.from_matrix(COLMAP_AXES @ start_turns).as_rotvec()
    cameras = np.hstack([vectors, shift, np.tile([FOCAL, 0.0, 0.0], (CAMERAS, 1))])
    points = scene.points + 0.02 * rng.standard_normal((POINTS, 3))
    return scene, BundleProblem.create(cameras, points, pixels, camera, point)


def noise(
    rng: np.random.Generator, count: int, row: int, gross: float
) -> Float[np.ndarray, " count"]:
    """Standard normals, and a gross error in one of them."""
    values = rng.standard_normal(count)
    values[row] += gross
    return values


def depths(scene: Scene, rng: np.random.Generator, gross: float) -> Measurement:
    """Maps of all images, each with a scale and a shift, at half of the points."""
    camera, point = np.divmod(np.arange(CAMERAS * POINTS // 2), POINTS // 2)
    inside = np.einsum(
        "nij,nj->ni", scene.turns[camera], scene.points[point] - scene.centres[camera]
    )
    row = 33
    sigma = 0.05
    measured = 1.7 * inside[:, 2] + 0.3 + sigma * noise(rng, len(camera), row, gross)
    rows = residuals.depth(pose=camera, point=point, image=camera, measured=measured, sigma=sigma)
    return Measurement(
        rows, f"camera {camera[row]} and point {point[row]}", {"image": np.tile([1.7, 0.0], (8, 1))}
    )


def distances(scene: Scene, rng: np.random.Generator, gross: float) -> Measurement:
    """Ten scale bars."""
    first = np.arange(10)
    second = np.arange(10, 20)
    row = 3
    sigma = 0.02
    length = np.linalg.norm(scene.points[second] - scene.points[first], axis=1)
    length = length + sigma * noise(rng, 10, row, gross)
    rows = residuals.distance(point=first, point_2=second, length=length, sigma=sigma)
    return Measurement(rows, f"point {row} and point {row + 10}")


def baselines(scene: Scene, rng: np.random.Generator, gross: float) -> Measurement:
    """Distances between successive cameras."""
    first = np.arange(CAMERAS - 1)
    row = 2
    sigma = 0.02
    length = np.linalg.norm(np.diff(scene.centres, axis=0), axis=1) + sigma * noise(
        rng, len(first), row, gross
    )
    rows = residuals.baseline(pose=first, pose_2=first + 1, length=length, sigma=sigma)
    return Measurement(rows, f"camera {row} and camera {row + 1}")


def plumb_lines(scene: Scene, rng: np.random.Generator, gross: float) -> Measurement:
    """Up in the frame of each camera, which is across its first axis."""
    row = 5
    sigma = 0.01
    direction = scene.turns[:, :, 2] + sigma * rng.standard_normal((CAMERAS, 3))
    direction[row, 0] += sigma * gross
    up = np.array([[0.0, 0.0, 1.0]])
    rows = residuals.gravity(pose=np.arange(CAMERAS), direction=direction, up=up, sigma=sigma)
    return Measurement(rows, f"camera {row}")


def odometry(scene: Scene, rng: np.random.Generator, gross: float) -> Measurement:
    """Poses of each camera in the frame of the one before."""
    first = np.arange(CAMERAS - 1)
    row = 4
    sigma = np.repeat([0.01, 0.02], 3)  # radians and scene units
    error = sigma * rng.standard_normal((len(first), 6))
    error[row, 4] += sigma[4] * gross
    rotation = scene.turns[:-1] @ np.swapaxes(scene.turns[1:], 1, 2)
    translation = (
        np.einsum("nij,nj->ni", scene.turns[:-1], np.diff(scene.centres, axis=0)) + error[:, 3:]
    )
    rotation = rotation @ Rotation.from_rotvec(error[:, :3]).as_matrix()
    data = {"rotation": rotation, "translation": translation, "whitening": np.diag(1 / sigma)[None]}
    rows = residuals.relative_pose(pose=first, pose_2=first + 1, **data)
    return Measurement(rows, f"camera {row} and camera {row + 1}")


def inertial(scene: Scene, rng: np.random.Generator, gross: float) -> Measurement:
    """An IMU in the camera, with noise in its samples and biases that walk."""
    time = np.arange(MOMENTS[-1] * RATE + 1) / RATE
    step = 1e-4
    rates = (attitude_at(time - step).inv() * attitude_at(time + step)).as_rotvec() / (2 * step)
    force = (
        centre_at(time - step) - 2 * centre_at(time) + centre_at(time + step)
    ) / step**2 - GRAVITY
    force = attitude_at(time).inv().apply(force)
    white, walk = np.repeat(IMU_NOISE, 3).reshape(2, 6)
    interval = np.diff(MOMENTS)
    steps = walk * np.sqrt(interval)[:, None] * rng.standard_normal((CAMERAS - 1, 6))
    bias = np.vstack([np.zeros(6), np.cumsum(steps, axis=0)])
    now = np.minimum((time / interval[0]).astype(int), CAMERAS - 2)
    samples = (
        np.hstack([rates, force])
        + bias[now]
        + white * np.sqrt(RATE) * rng.standard_normal((len(time), 6))
    )
    data = residuals.preintegrated(time, samples[:, :3], samples[:, 3:], MOMENTS, noise=IMU_NOISE)
    first = np.arange(CAMERAS - 1)
    row = 3
    covariance = np.linalg.inv(data["whitening"][row].T @ data["whitening"][row])
    turns = np.array(data["rotation"])
    error = Rotation.from_rotvec([0.0, gross * np.sqrt(covariance[1, 1]), 0.0])  # of the gyroscope
    turns[row] = turns[row] @ error.as_matrix()
    data["rotation"] = turns
    index = {"pose": first, "motion": first, "pose_2": first + 1, "motion_2": first + 1}
    rows = residuals.imu(**index, **data, gravity=GRAVITY, mount=np.eye(3, 4)[None])
    speed = (centre_at(MOMENTS + step) - centre_at(MOMENTS - step)) / (2 * step)
    motion = np.hstack([speed, np.zeros((CAMERAS, 6))])
    return Measurement(rows, f"camera {row} and camera {row + 1}", {"motion": motion})


@jaxba.residual
def range_finder(pose, point, offset, *, measured, sigma):
    """What a laser in the camera measures, which has an unknown offset."""
    away = point - pose.center
    return (jnp.sqrt(jnp.sum(away**2)) + offset[0] - measured) / sigma


def ranges(scene: Scene, rng: np.random.Generator, gross: float) -> Measurement:
    """A residual of a user's own, with a block of it: two ranges from each camera."""
    camera = np.repeat(np.arange(CAMERAS), 2)
    point = np.arange(2 * CAMERAS)
    row = 7
    sigma = 0.02
    measured = np.linalg.norm(scene.points[point] - scene.centres[camera], axis=1) + 0.1
    measured += sigma * noise(rng, len(point), row, gross)
    rows = range_finder(
        pose=camera, point=point, offset=np.zeros(len(point), int), measured=measured, sigma=sigma
    )
    return Measurement(rows, f"row {row} ", {"offset": np.zeros((1, 1))})


KINDS: dict[str, Draw] = {
    "baseline": baselines,
    "depth": depths,
    "distance": distances,
    "gravity": plumb_lines,
    "imu": inertial,
    "range_finder": ranges,
    "relative_pose": odometry,
}
"""Residuals by their names in notes."""


@functools.cache
def notes_of(kind: str, seed: int, gross: float) -> tuple[tuple[str, ...], str]:
    """Notes of a random survey, and the name of the row with an error of so many standard
    deviations."""
    rng = np.random.default_rng([seed, sorted(KINDS).index(kind)])
    scene, problem = scene_and_start(rng)
    measured = KINDS[kind](scene, rng, gross)
    problem = jaxba.with_residual(problem, measured.rows, unknowns=measured.blocks)
    options = jaxba.SolveOptions(compilation="quick", intrinsics="fixed")
    return jaxba.solve(problem, "ceres", options).notes, measured.name


def names_the_row(kind: str, seed: int) -> bool:
    """Whether the only note is one that begins with the kind and the row that is wrong."""
    notes, name = notes_of(kind, seed, GROSS)
    return len(notes) == 1 and notes[0].startswith(f"{kind}: does not fit the rest: {name}")


QUICK = ("distance", "gravity")
"""Kinds whose programs are compiled in some seconds."""


@pytest.mark.parametrize(
    "kind",
    [kind if kind in QUICK else pytest.param(kind, marks=pytest.mark.slow) for kind in KINDS],
)
def test_right_measurements_have_no_note_and_a_wrong_row_is_named(kind):
    assert notes_of(kind, 0, 0.0)[0] == ()
    assert names_the_row(kind, 0)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_at_most_one_of_thirty_right_surveys_has_a_note_and_all_wrong_rows_are_named(kind):
    assert sum(notes_of(kind, seed, 0.0)[0] != () for seed in range(1, SEEDS + 1)) <= 1
    assert all(names_the_row(kind, seed) for seed in range(1, SEEDS + 1))
