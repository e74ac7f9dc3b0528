"""Geometry of the BAL camera on the host, and the changes of a problem that are built on it."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
import support
from scipy.spatial.transform import Rotation
from support import solve

from jaxba.problem import geometry
from jaxba.problem.bundle_problem import BundleProblem, ProblemError
from jaxba.problem.geometry import (
    angle_axis,
    bal_rotations,
    camera_centers,
    colmap_quaternions,
    cost,
    depths,
    project,
    residuals,
    rotation_matrices,
)
from jaxba.problem.preprocess import FAR, far_middle, perturb, shift

DATA = os.environ.get("JAXBA_DATA")
needs_data = pytest.mark.skipif(DATA is None, reason="JAXBA_DATA names no folder of real problems")

ANGLES = [
    0.0,
    1e-300,
    1e-12,
    1e-8,
    1e-4,
    0.5,
    3.0,
    np.pi - 1e-4,
    np.pi - 1e-8,
    np.pi - 1e-12,
    np.pi,
]


def axes(seed: int, count: int) -> np.ndarray:
    vectors = np.random.default_rng(seed).standard_normal((count, 3))
    return np.concatenate(
        [vectors / np.linalg.norm(vectors, axis=1, keepdims=True), np.eye(3), -np.eye(3)]
    )


def small_problem(seed: int = 0, **options) -> BundleProblem:
    """12 points in front of 5 cameras, all visible, with measurements some pixels off."""
    rng = np.random.default_rng(seed)
    cameras = np.zeros((5, 9))
    cameras[:, :3] = 0.2 * rng.standard_normal((5, 3))
    cameras[:, 3:6] = rng.standard_normal((5, 3)) - [0, 0, 8]
    cameras[:, 6:] = rng.uniform([500, -0.1, 0.0], [900, 0.0, 0.01], (5, 3))
    points = rng.uniform([-1.7, -2.2, -1.5], [2.3, 1.8, 2.5], (12, 3))
    camera_index, point_index = (
        index.ravel() for index in np.meshgrid(np.arange(5), np.arange(12))
    )
    return BundleProblem.create(
        cameras, points, 30 * rng.standard_normal((60, 2)), camera_index, point_index, **options
    )


# Rotations


@pytest.mark.parametrize("angle", [*ANGLES, 4.0, 7.0])
def test_rotation_matrices_equal_scipy_at_every_angle(angle):
    vectors = angle * axes(1, 20)
    np.testing.assert_allclose(
        rotation_matrices(vectors), Rotation.from_rotvec(vectors).as_matrix(), atol=4e-15
    )


@pytest.mark.parametrize("angle", ANGLES[:-2])
def test_angle_axis_inverts_rotation_matrices_up_to_pi(angle):
    vectors = angle * axes(2, 50)
    np.testing.assert_allclose(
        angle_axis(rotation_matrices(vectors)), vectors, rtol=0, atol=1e-14 + 1e-9 * angle
    )


def test_angle_axis_inverts_rotation_matrices_up_to_a_half_turn():
    rng = np.random.default_rng(0)
    angles = np.array(
        [
            0,
            1e-300,
            1e-16,
            1e-8,
            1e-4,
            0.1,
            1,
            2,
            3,
            np.pi - 1e-4,
            np.pi - 1e-8,
            np.pi - 1e-15,
            np.pi,
        ]
    )
    axes = np.concatenate(
        [np.eye(3), -np.eye(3), rng.normal(size=(50, 3)), [[1, 1e-9, 0], [1, -1, 0], [0, 1e-5, 1]]]
    )
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    expected = (angles[:, None, None] * axes).reshape(-1, 3)
    found = angle_axis(rotation_matrices(expected))
    # Near a half turn the two directions of the axis stand for nearly the same rotation.
    flipped = expected * (
        1 - 2 * np.pi / np.maximum(np.linalg.norm(expected, axis=1, keepdims=True), 1e-9)
    )
    error = np.minimum(
        np.linalg.norm(found - expected, axis=1), np.linalg.norm(found - flipped, axis=1)
    )
    assert error.max() < 4e-15
    assert np.linalg.norm(found, axis=1).max() <= np.pi * (1 + 4e-16)


def test_tiny_rotations_keep_their_relative_precision():
    vectors = 1e-10 * axes(3, 20)
    np.testing.assert_allclose(
        angle_axis(rotation_matrices(vectors)), vectors, rtol=1e-6, atol=1e-26
    )


@pytest.mark.parametrize("angle", ANGLES[-3:])
def test_angle_axis_near_half_a_turn_is_the_same_rotation(angle):
    matrices = Rotation.from_rotvec(angle * axes(4, 50)).as_matrix()
    vectors = angle_axis(matrices)
    assert (np.linalg.norm(vectors, axis=1) <= np.pi + 1e-15).all()
    np.testing.assert_allclose(rotation_matrices(vectors), matrices, atol=1e-14)


@pytest.mark.parametrize("angle", [*ANGLES, 4.0, 7.0])
def test_colmaps_quaternions_are_the_rotations_after_a_half_turn_about_x(angle):
    vectors = angle * axes(5, 50)
    vectors.setflags(write=False)  # as arrays of JAX are on the host
    found = Rotation.from_quat(colmap_quaternions(vectors)).as_matrix()
    np.testing.assert_allclose(found, np.diag([1, -1, -1]) @ rotation_matrices(vectors), atol=4e-15)


@pytest.mark.parametrize("angle", ANGLES[:-1])
def test_rotations_come_back_from_colmaps_quaternions_of_any_sign_and_norm(angle):
    vectors = angle * axes(6, 50)
    for scale in (1.0, -1.0, 0.3):
        found = bal_rotations(scale * colmap_quaternions(vectors))
        np.testing.assert_allclose(found, vectors, rtol=1e-15, atol=2e-15)


def test_a_half_turn_comes_back_from_colmaps_quaternions_with_either_sign():
    vectors = np.pi * axes(7, 50)
    found = bal_rotations(colmap_quaternions(vectors))
    np.testing.assert_allclose(
        found * np.sign((found * vectors).sum(1, keepdims=True)), vectors, atol=2e-15
    )


def test_a_quaternion_that_is_no_rotation_gives_no_number():
    found = bal_rotations(np.array([[np.nan, 0, 0, 1], [0, 0, 0, 0], [1, 0, 0, 0]]))
    np.testing.assert_array_equal(np.isnan(found), [[True] * 3, [True] * 3, [False] * 3])
    np.testing.assert_array_equal(found[2], 0)


# Cameras


def test_a_camera_maps_its_centre_to_the_origin():
    cameras = small_problem().cameras
    centers = camera_centers(cameras)
    np.testing.assert_allclose(
        Rotation.from_rotvec(cameras[:, :3]).apply(centers) + cameras[:, 3:6], 0, atol=1e-14
    )


def test_projection_is_the_formula_of_bal():
    problem = small_problem()
    for n, predicted in enumerate(project(problem)):
        camera = problem.cameras[problem.camera_index[n]]
        local = (
            Rotation.from_rotvec(camera[:3]).apply(problem.points[problem.point_index[n]])
            + camera[3:6]
        )
        plane = -local[:2] / local[2]
        square = plane @ plane
        pixels = camera[6] * (1 + camera[7] * square + camera[8] * square**2) * plane
        np.testing.assert_allclose(predicted, pixels, rtol=1e-12)
        assert depths(problem)[n] == pytest.approx(-local[2])


def test_pieces_do_not_change_the_projection(monkeypatch):
    problem = small_problem()
    whole = project(problem)
    depth = depths(problem)
    monkeypatch.setattr(geometry, "CHUNK", 7)
    np.testing.assert_array_equal(project(problem), whole)
    np.testing.assert_array_equal(depths(problem), depth)


def test_a_point_in_the_plane_of_the_camera_gives_no_warning_and_no_number():
    cameras = [[0.0, 0, 0, 0, 0, -5, 500, 0, 0]]
    problem = BundleProblem.create(cameras, [[1.0, 0, 5]], [[0.0, 0]], [0], [0])
    assert depths(problem) == 0
    assert not np.isfinite(cost(problem))


def test_cost_is_half_the_squared_mahalanobis_distance():
    rng = np.random.default_rng(6)
    root = rng.standard_normal((60, 2, 2)) + 3 * np.eye(2)
    covariance = root @ root.transpose(0, 2, 1)
    plain = small_problem()
    weighed = small_problem(covariance=covariance)
    difference = plain.observations - project(plain)
    np.testing.assert_allclose(residuals(plain), difference)
    squares = np.einsum("ni,nij,nj->n", difference, np.linalg.inv(covariance), difference)
    assert cost(weighed) == pytest.approx(0.5 * squares.sum())
    assert cost(small_problem(weight=np.full(60, 4.0))) == pytest.approx(4 * cost(plain))


# Perturb


def test_the_same_seed_gives_the_same_noise_and_another_seed_another():
    problem = small_problem()
    first, again, other = (perturb(problem, seed, 0.01, 0.1, 0.2) for seed in (3, 3, 4))
    np.testing.assert_array_equal(first.cameras, again.cameras)
    np.testing.assert_array_equal(first.points, again.points)
    assert (first.points != other.points).all()
    np.testing.assert_array_equal(first.observations, problem.observations)


def test_no_noise_changes_nothing():
    problem = small_problem()
    same = perturb(problem, 0)
    np.testing.assert_array_equal(same.cameras, problem.cameras)
    np.testing.assert_array_equal(same.points, problem.points)


def test_rotation_noise_keeps_the_centres_and_translation_noise_the_rotations():
    problem = small_problem()
    turned = perturb(problem, 0, rotation_sigma=0.1)
    np.testing.assert_allclose(
        camera_centers(turned.cameras), camera_centers(problem.cameras), atol=1e-13
    )
    assert (turned.cameras[:, :3] != problem.cameras[:, :3]).all()
    moved = perturb(problem, 0, translation_sigma=0.1)
    np.testing.assert_array_equal(
        moved.cameras[:, [0, 1, 2, 6, 7, 8]], problem.cameras[:, [0, 1, 2, 6, 7, 8]]
    )
    assert (moved.cameras[:, 3:6] != problem.cameras[:, 3:6]).all()


def test_the_noise_has_the_asked_sigma():
    rng = np.random.default_rng(7)
    cameras = np.concatenate([rng.standard_normal((5000, 6)), np.full((5000, 3), 1.0)], axis=1)
    zeros = np.zeros(5000, dtype=int)
    problem = BundleProblem.create(
        cameras, rng.standard_normal((5000, 3)), np.zeros((5000, 2)), zeros, zeros
    )
    noisy = perturb(problem, 8, 0.02, 0.3, 0.05)
    centers = camera_centers(noisy.cameras) - camera_centers(problem.cameras)
    for noise, sigma in (
        (noisy.cameras[:, :3] - cameras[:, :3], 0.02),
        (centers, 0.3),
        (noisy.points - problem.points, 0.05),
    ):
        assert noise.mean() == pytest.approx(0, abs=5 * sigma / np.sqrt(15000))
        assert noise.std() == pytest.approx(sigma, rel=5 / np.sqrt(30000))


@pytest.mark.parametrize("name", ["rotation_sigma", "translation_sigma", "point_sigma"])
def test_a_negative_sigma_is_refused(name):
    with pytest.raises(ProblemError, match=name):
        perturb(small_problem(), 0, **{name: -0.1})


# Real problems


@needs_data
def test_the_cost_of_ladybug_is_the_known_one_also_when_it_is_moved():
    from jaxba.io import read_problem

    problem = read_problem(Path(str(DATA)) / "bal" / "problem-49-7776-pre.txt.bz2")
    assert cost(problem) == pytest.approx(850912.460681, rel=1e-9)  # reference.json
    assert cost(support.at_origin(problem)) == pytest.approx(850912.460681, rel=1e-9)
    assert np.count_nonzero(depths(problem) <= 0) == 31


# Far from the origin


def test_a_shifted_scene_has_the_same_residuals_and_is_shifted_back():
    problem = support.odd()  # with cameras and points that nobody observes
    offset = np.array([3.0, -40.0, 7.0])
    there = shift(problem, offset)
    np.testing.assert_allclose(
        residuals(there), residuals(problem), rtol=0, atol=1e-9 * np.abs(residuals(problem)).max()
    )
    seen = np.unique(problem.camera_index)
    moved = camera_centers(there.cameras[seen]) - camera_centers(problem.cameras[seen])
    np.testing.assert_allclose(moved, np.broadcast_to(offset, moved.shape), atol=1e-9)
    unseen = (
        np.setdiff1d(np.arange(problem.num_cameras), seen),
        np.setdiff1d(np.arange(problem.num_points), problem.point_index),
    )
    assert unseen[0].size
    assert unseen[1].size
    assert np.array_equal(there.cameras[unseen[0]], problem.cameras[unseen[0]])
    assert np.array_equal(there.points[unseen[1]], problem.points[unseen[1]])
    back = shift(there, -offset)
    np.testing.assert_allclose(back.cameras, problem.cameras, atol=1e-12)
    np.testing.assert_allclose(back.points, problem.points, atol=1e-12)


def test_only_scenes_far_from_the_origin_for_their_extent_are_far():
    problem = support.tiny()
    assert not far_middle(problem).any()
    centred = support.at_origin(problem)
    extent = max(
        np.median(np.linalg.norm(centred.points, axis=1)),
        np.median(np.linalg.norm(camera_centers(centred.cameras), axis=1)),
    )
    assert not far_middle(shift(centred, np.array([0.5 * FAR * extent, 0, 0]))).any()
    offset = np.array([0, 0, 2 * FAR * extent])
    np.testing.assert_allclose(far_middle(shift(centred, offset)), offset, atol=1e-9 * extent)


@pytest.mark.parametrize(("dtype", "rtol"), [("float64", 1e-10), ("float32", 1e-3)])
def test_a_scene_far_from_the_origin_is_solved_as_if_it_stood_there(dtype, rtol):
    """As one in the coordinates of a country's grid: in float32 not even its start could be told
    from others."""
    offset = np.array([4e5, 5.6e6, 300.0])
    problem = support.at_origin(support.tiny())
    far = shift(problem, offset)
    near, there = (solve(p, "ceres", dtype=dtype) for p in (problem, far))
    if dtype == "float64":  # in float32 rounding decides when the cost no longer falls
        assert there.iterations == near.iterations
    np.testing.assert_allclose(there.final_cost, near.final_cost, rtol=rtol)
    # put back where it was, every coordinate is rounded: what one rounding can do to the cost, at
    # most
    rays = near.problem.cameras[near.problem.camera_index]
    scale = rays[:, 6] / np.abs(depths(near.problem))  # pixels, of a unit
    rounded = np.spacing(offset.max()) * np.sum(np.abs(residuals(near.problem)) * scale[:, None])
    np.testing.assert_allclose(cost(there.problem), near.final_cost, rtol=rtol, atol=rounded)
    middle = np.median(there.problem.points, axis=0)
    assert np.linalg.norm(middle - np.median(far.points, axis=0)) < 1
