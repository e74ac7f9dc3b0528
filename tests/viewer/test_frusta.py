"""Frusta stand where the camera model sees the corners of its image."""

from __future__ import annotations

import numpy as np
import pytest

import jaxba
from jaxba.problem import geometry
from jaxba.problem.bundle_problem import BundleProblem
from jaxba.problem.similarity import upright
from jaxba.viewer.geometry import depth_of_image, frusta_of, residual_segments
from jaxba.viewer.measures import measure

CORNERS = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)], float)


def pinhole_problem(model: str) -> BundleProblem:
    """Two cameras of an image of 640 x 480 pixels, without distortion."""
    lens = {"BAL": (500.0, 0.0, 0.0), "PINHOLE": (500.0, 520.0, 320.0, 240.0)}[model]
    middle = np.zeros(2) if model == "BAL" else np.array([320.0, 240.0])
    cameras = np.array(
        [[0.3, -0.2, 0.1, 0.4, 0.1, -0.3, *lens], [-1.0, 2.0, 0.5, 0.0, 0.2, 0.1, *lens]]
    )
    pixels = np.tile(middle + CORNERS * [320.0, 240.0], (2, 1))
    camera = np.repeat([0, 1], 4)
    lenses = None
    if model != "BAL":
        models = (jaxba.CAMERA_MODELS[model],)
        lenses = jaxba.Lenses(np.zeros(2, np.int32), np.ones((1, 4), bool), None, models)
    return BundleProblem.create(
        cameras, np.ones((8, 3)), pixels, camera, np.arange(8), lenses=lenses
    )


@pytest.mark.parametrize("model", ["BAL", "PINHOLE"])
def test_corners_of_a_frustum_project_to_the_corners_of_the_image(model):
    problem = pinhole_problem(model)
    frusta = frusta_of(problem)
    poses = geometry.camera_poses(np.asarray(problem.cameras))
    depth = np.array([depth_of_image(half, 0.2) for half in frusta.half])
    plane = (
        np.concatenate([CORNERS * frusta.half[:, None], np.ones((2, 4, 1))], axis=2)
        * depth[:, None, None]
    )
    corners = np.einsum("nij,nkj->nki", poses[:, :, :3], plane) + poses[:, None, :, 3]
    placed = problem.replace(points=corners.reshape(-1, 3))
    middle = 0 if model == "BAL" else [320.0, 240.0]
    upwards = [1, -1] if model == "BAL" else [1, 1]
    expected = np.tile(CORNERS * upwards, (2, 1)) * [320.0, 240.0] + middle
    np.testing.assert_allclose(geometry.project(placed), expected, atol=1e-9)
    assert (geometry.depths(placed) > 0).all()


@pytest.mark.parametrize("model", ["BAL", "PINHOLE"])
def test_a_segment_runs_from_the_measured_towards_the_predicted_pixel(model):
    problem = pinhole_problem(model)
    predicted = problem.observations + np.array([3.0, -2.0])
    frusta = frusta_of(problem)
    factor = 7.0
    segments = residual_segments(problem, frusta, problem.observations - predicted, 1, factor)
    ends = frusta.on_plane(
        np.asarray(problem.observations)[4:] + factor * np.array([3.0, -2.0]), np.ones(4, int)
    )
    np.testing.assert_allclose(segments[:, 1], ends)


def test_a_large_residual_ends_outside_of_the_image_but_not_far():
    problem = pinhole_problem("PINHOLE")
    frusta = frusta_of(problem)
    residuals = np.full((8, 2), 1e9)
    start, end = residual_segments(problem, frusta, residuals, 0, 1.0).transpose(1, 0, 2)
    assert (np.abs(end) > frusta.half[0]).any(axis=1).all()
    np.testing.assert_allclose(
        np.linalg.norm((end - start) * frusta.focal[0], axis=1), np.hypot(640, 480)
    )


def test_on_the_page_cameras_stand_upright_around_the_origin():
    problem = jaxba.random_scene(jaxba.SceneConfig(cameras=6, points=60), 3)
    similarity = upright(problem)
    poses = similarity.poses(geometry.camera_poses(np.asarray(problem.cameras)))
    np.testing.assert_allclose(np.linalg.det(poses[:, :, :3]), 1.0)
    up = -poses[:, :, 1].mean(axis=0)
    np.testing.assert_allclose(up / np.linalg.norm(up), [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(
        np.median(similarity.points(np.asarray(problem.points)), axis=0), 0, atol=0.5
    )


def test_measures_are_those_of_each_image_and_point():
    problem = jaxba.random_scene(jaxba.SceneConfig(cameras=6, points=60), 0)
    found = measure(problem)
    length = np.linalg.norm(geometry.residuals(problem), axis=1)
    for values, index in (
        (found.of_image, problem.camera_index),
        (found.of_point, problem.point_index),
    ):
        own = np.asarray(index) == 2
        assert values[2] == pytest.approx(np.sqrt(np.mean(length[own] ** 2)))
    assert found.rmse == pytest.approx(
        np.sqrt(2 * geometry.cost(problem) / problem.num_observations)
    )
    worst = found.worst()
    assert (np.diff(found.of_image[worst]) <= 0).all()
