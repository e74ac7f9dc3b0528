"""Random scenes: the ground truth, noisy observations of it, and perturbed initial values."""

from __future__ import annotations

import numpy as np

from jaxba.problem.bundle_problem import BundleProblem, ProblemError
from jaxba.problem.checks import random_numbers
from jaxba.problem.geometry import (
    angle_axis,
    camera_centers,
    depths,
    project,
    rotation_matrices,
    translations,
)
from jaxba.scenes.config import SceneConfig, check
from jaxba.scenes.tracks import track_lengths
from jaxba.scenes.trajectory import Path, make_path, true_cameras
from jaxba.scenes.visibility import TrueCameras, Views, place_points

# random paths to try. Only small scenes with many observations per point need more than one
MAX_PATHS = 8


def random_scene(config: SceneConfig, seed: int | np.random.Generator) -> BundleProblem:
    """A random scene at its perturbed initial values; see `random_scene_with_truth`."""
    return random_scene_with_truth(config, seed)[0]


def random_scene_with_truth(
    config: SceneConfig, seed: int | np.random.Generator
) -> tuple[BundleProblem, BundleProblem]:
    """A random scene at perturbed initial values, and the same one at the ground truth.

    Both have the same noisy observations, sorted by point and camera as in BAL files, so the cost
    of the truth is near `noise^2 * observations` where there are no outliers. Counts are exactly
    those of the configuration. Every point is seen by two cameras or more and lies in front of and
    inside the image of each; every camera sees four points or more where the geometry allows it.
    `seed` is a seed or a generator; the same seed gives the same numbers. Returns (start, truth).
    Raises ProblemError: the options contradict each other, or the cameras overlap too little for
    them."""
    check(config)
    rng = random_numbers(seed)
    path, truth = _path_and_truth(config, rng)
    truth = _measure(config, truth, rng)
    return _perturbed(config, path, truth, rng), truth


def _path_and_truth(config: SceneConfig, rng: np.random.Generator) -> tuple[Path, BundleProblem]:
    """Cameras and the points that they see; another path is drawn where the views of the first
    overlap too little."""
    lengths = track_lengths(config.points, config.total, config.cameras)
    for attempt in range(MAX_PATHS):
        path = make_path(config, rng)
        cameras = true_cameras(config, path, rng)
        try:
            return path, _problem(
                path, cameras, place_points(TrueCameras(config, path, cameras), lengths, rng)
            )
        except ProblemError:
            if attempt + 1 == MAX_PATHS:
                raise
    raise AssertionError("the last attempt returns or raises")


def _problem(path: Path, cameras: np.ndarray, views: Views) -> BundleProblem:
    """The truth without measurements: cameras by index, points in the order in which cameras first
    see them."""
    points, along, point_index = views
    count = len(cameras)
    by_index = np.empty_like(cameras)
    by_index[path.index] = cameras
    camera_index = path.index[along]
    first = np.full(len(points), count, dtype=np.int32)
    np.minimum.at(first, point_index, camera_index)
    order = np.argsort(first, kind="stable")
    number = np.empty_like(order)
    number[order] = np.arange(len(order))
    key = np.sort(number[point_index] * np.int64(count) + camera_index)
    point_index, camera_index = np.divmod(key, count)
    return BundleProblem.create(
        by_index, points[order], np.zeros((len(key), 2)), camera_index, point_index
    )


def _measure(config: SceneConfig, truth: BundleProblem, rng: np.random.Generator) -> BundleProblem:
    """The truth with noisy observations and outliers."""
    pixels = project(truth)
    pixels += config.noise * rng.standard_normal(pixels.shape)
    outliers = np.flatnonzero(rng.random(len(pixels)) < config.outlier_share)
    pixels[outliers] += rng.uniform(-config.outlier_size, config.outlier_size, (outliers.size, 2))
    return truth.replace(observations=pixels)


def _perturbed(
    config: SceneConfig, path: Path, truth: BundleProblem, rng: np.random.Generator
) -> BundleProblem:
    """The truth after drift along the path and independent noise on every parameter."""
    cameras = np.array(truth.cameras)
    # first observation of each point
    tracks = np.searchsorted(truth.point_index, np.arange(truth.num_points))
    first = truth.camera_index[tracks]
    centers = camera_centers(cameras)
    moved, drift = _drift(config, path, centers, rng)
    points = moved[first] + np.einsum("nij,nj->ni", drift[first], truth.points - centers[first])
    nearest = np.minimum.reduceat(depths(truth), tracks)
    points += config.start_point * nearest[:, None] * rng.standard_normal(points.shape)
    moved += config.start_center * config.step * rng.standard_normal(moved.shape)
    noise = rotation_matrices(config.start_rotation * rng.standard_normal(moved.shape))
    rotations = noise @ rotation_matrices(cameras[:, :3]) @ drift.transpose(0, 2, 1)
    cameras[:, :3] = angle_axis(rotations)
    cameras[:, 3:6] = translations(rotations, moved)
    cameras[:, 6] *= np.exp(config.start_focal * rng.standard_normal(len(cameras)))
    return truth.replace(cameras=cameras, points=points)


def _drift(config: SceneConfig, path: Path, centers: np.ndarray, rng: np.random.Generator) -> tuple:
    """Centres (cameras, 3) and rotations of the world (cameras, 3, 3) after the drift of
    odometry."""
    drift = rotation_matrices(
        np.cumsum(config.start_drift * rng.standard_normal(centers.shape), axis=0)
    )
    along = centers[path.index]
    steps = np.einsum("nij,nj->ni", drift[:-1], np.diff(along, axis=0))
    moved = np.empty_like(centers)
    moved[path.index] = along[0] + np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    by_index = np.empty_like(drift)
    by_index[path.index] = drift
    return moved, by_index
