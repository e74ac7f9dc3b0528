"""Random scenes: the truth, its measurements, and a start some way off."""

from __future__ import annotations

import numpy as np

from jaxba.problem.bundle_problem import BundleProblem, ProblemError
from jaxba.problem.geometry import angle_axis, camera_centers, depths, project, rotation_matrices, translations
from jaxba.scenes.config import SceneConfig, check
from jaxba.scenes.tracks import track_lengths
from jaxba.scenes.trajectory import Path, make_path, true_cameras
from jaxba.scenes.visibility import Rig, Views, place_points

LAYOUTS = 8
"""Paths to try. Only small scenes that ask much of a random path need more than one."""


def random_scene(config: SceneConfig, seed: int | np.random.Generator) -> BundleProblem:
    """The start of a random scene; see `random_scene_with_truth`."""
    return random_scene_with_truth(config, seed)[0]


def random_scene_with_truth(
    config: SceneConfig, seed: int | np.random.Generator
) -> tuple[BundleProblem, BundleProblem]:
    """A random scene as it is to be solved, and the same one at the truth.

    Both have the same noisy observations, sorted by point and camera as BAL files are, so the cost of
    the truth is near `noise^2 * observations` where there are no outliers. Numbers of cameras, points
    and observations are exactly those asked for. Every point is seen by two cameras or more and lies in
    front of and inside the image of each; every camera sees four or more where the geometry allows it.

    Args:
        config: what the scene is like.
        seed: a seed or a generator; the same seed gives the same numbers.

    Returns:
        (start, truth).

    Raises:
        ProblemError: the options contradict each other, or the cameras overlap too little for them.
    """
    check(config)
    rng = np.random.default_rng(seed)
    path, truth = _layout(config, rng)
    truth = _measure(config, truth, rng)
    return _start(config, path, truth, rng), truth


def _layout(config: SceneConfig, rng: np.random.Generator) -> tuple[Path, BundleProblem]:
    """Cameras and points that see each other; another path is drawn where a first one overlaps too little."""
    lengths = track_lengths(config.points, config.total, config.cameras)
    for attempt in range(LAYOUTS):
        path = make_path(config, rng)
        cameras = true_cameras(config, path, rng)
        try:
            return path, _problem(path, cameras, place_points(Rig(config, path, cameras), lengths, rng))
        except ProblemError:
            if attempt + 1 == LAYOUTS:
                raise
    raise AssertionError("the last attempt returns or raises")


def _problem(path: Path, cameras: np.ndarray, views: Views) -> BundleProblem:
    """The truth without measurements: cameras by label, points in the order in which cameras first see them."""
    count = len(cameras)
    labelled = np.empty_like(cameras)
    labelled[path.labels] = cameras
    camera_index = path.labels[views.camera_index]
    first = np.full(len(views.points), count, dtype=np.int32)
    np.minimum.at(first, views.point_index, camera_index)
    order = np.argsort(first, kind="stable")
    number = np.empty_like(order)
    number[order] = np.arange(len(order))
    key = number[views.point_index] * np.int64(count) + camera_index
    key.sort()
    point_index, camera_index = np.divmod(key, count)
    blank = np.zeros((len(key), 2))
    return BundleProblem.create(labelled, views.points[order], blank, camera_index, point_index)


def _measure(config: SceneConfig, truth: BundleProblem, rng: np.random.Generator) -> BundleProblem:
    """The truth with noisy observations and wrong matches."""
    pixels = project(truth)
    pixels += config.noise * rng.standard_normal(pixels.shape)
    wrong = np.flatnonzero(rng.random(len(pixels)) < config.outlier_share)
    pixels[wrong] += rng.uniform(-config.outlier_size, config.outlier_size, (wrong.size, 2))
    return truth.replace(observations=pixels)


def _start(config: SceneConfig, path: Path, truth: BundleProblem, rng: np.random.Generator) -> BundleProblem:
    """The truth after drift along the path and independent noise on every parameter."""
    cameras = np.array(truth.cameras)
    tracks = np.searchsorted(truth.point_index, np.arange(truth.num_points))  # first observation of each point
    first = truth.camera_index[tracks]
    centers = camera_centers(cameras)
    moved, turns = _drift(config, path, centers, rng)
    points = moved[first] + np.einsum("nij,nj->ni", turns[first], truth.points - centers[first])
    nearest = np.minimum.reduceat(depths(truth), tracks)
    points += config.start_point * nearest[:, None] * rng.standard_normal(points.shape)
    moved += config.start_center * config.step * rng.standard_normal(moved.shape)
    noise = rotation_matrices(config.start_rotation * rng.standard_normal(moved.shape))
    rotations = noise @ rotation_matrices(cameras[:, :3]) @ turns.transpose(0, 2, 1)
    cameras[:, :3] = angle_axis(rotations)
    cameras[:, 3:6] = translations(rotations, moved)
    cameras[:, 6] *= np.exp(config.start_focal * rng.standard_normal(len(cameras)))
    return truth.replace(cameras=cameras, points=points)


def _drift(config: SceneConfig, path: Path, centers: np.ndarray, rng: np.random.Generator) -> tuple:
    """Centres (cameras, 3) and turns of the world (cameras, 3, 3) after odometry that adds up its errors."""
    turns = rotation_matrices(np.cumsum(config.start_drift * rng.standard_normal(centers.shape), axis=0))
    along = centers[path.labels]
    steps = np.einsum("nij,nj->ni", turns[:-1], np.diff(along, axis=0))
    moved = np.empty_like(centers)
    moved[path.labels] = along[0] + np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    labelled = np.empty_like(turns)
    labelled[path.labels] = turns
    return moved, labelled
