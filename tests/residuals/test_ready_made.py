"""Ready-made residuals against truths that are computed otherwise, and solves that find what was
simulated."""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm, logm
from scipy.spatial.transform import Rotation

import jaxba
from jaxba import residuals
from jaxba.problem import geometry
from jaxba.problem.residuals import Residuals
from jaxba.problem.row_value import Lens, Pose
from jaxba.scenes import SceneConfig

UP = np.array([0.0, 0.0, 2.0])
NORTH = np.array([0.0, 3.0, 1.0])
EAST = np.array([1.0, 0.0, 0.0])


def scene() -> jaxba.BundleProblem:
    return jaxba.random_scene(SceneConfig(5, 30, 150, noise=0.0), 3)


def truth_and_start(change: float = 0.02) -> tuple[jaxba.BundleProblem, jaxba.BundleProblem]:
    """A scene with pixels as they should be, and one whose poses and points are moved."""
    problem = scene()
    problem = problem.replace(observations=geometry.project(problem))
    rng = np.random.default_rng(5)
    cameras = problem.cameras.copy()
    cameras[:, :6] += change * rng.standard_normal((5, 6))
    points = problem.points + change * rng.standard_normal(problem.points.shape)
    return problem, problem.replace(cameras=cameras, points=points)


def poses_of(problem: jaxba.BundleProblem) -> list[Pose]:
    given = geometry.camera_poses(problem.cameras)
    return [
        Pose(jnp.asarray(one[:, :3].T), jnp.asarray(-one[:, :3].T @ one[:, 3])) for one in given
    ]


def centers(problem: jaxba.BundleProblem) -> np.ndarray:
    return geometry.camera_centers(problem.cameras)


def random_pose(rng: np.random.Generator) -> Pose:
    return Pose(
        jnp.asarray(Rotation.from_rotvec(rng.standard_normal(3)).as_matrix()),
        jnp.asarray(rng.standard_normal(3)),
    )


def to_world(pose: Pose) -> np.ndarray:
    """The pose from the camera to the world as a matrix of 4 x 4."""
    return np.linalg.inv(
        np.vstack([np.column_stack([pose.rotation, pose.translation]), [0, 0, 0, 1]])
    )


def solved(problem: jaxba.BundleProblem, iterations: int = 60) -> jaxba.BundleProblem:
    tight = jaxba.SolveOptions(
        tolerances=jaxba.Tolerances(1e-16, 1e-16, 1e-16), max_iterations=iterations
    )
    found = jaxba.solve(problem, "ceres", tight)
    assert found.final_cost < 1e-12
    return found.problem


def test_a_relative_pose_is_the_logarithm_of_the_measured_motion_undone():
    rng = np.random.default_rng(0)
    one = random_pose(rng)
    two = random_pose(rng)
    between = np.linalg.inv(to_world(one)) @ to_world(two)
    measured = between @ expm(
        np.array([[0, -0.3, 0.5, 1], [0.3, 0, 0.9, -2], [-0.5, -0.9, 0, 0.4], [0, 0, 0, 0]])
    )
    whitening = rng.standard_normal((6, 6))

    def of(m):
        return residuals.relative_pose.function(
            one, two, rotation=m[:3, :3], translation=m[:3, 3], whitening=whitening
        )

    error = np.real(np.asarray(logm(np.linalg.inv(measured) @ between)))
    expected = np.array([error[2, 1], error[0, 2], error[1, 0], *error[:3, 3]])
    np.testing.assert_allclose(of(measured), whitening @ expected, atol=1e-12)
    np.testing.assert_allclose(of(between), 0, atol=1e-12)


def test_inclinometer_and_compass_measure_angles():
    """A camera that looks 40 degrees east of north and 20 degrees up, rolled."""
    rng = np.random.default_rng(1)
    azimuth, tilt = np.deg2rad([40.0, 20.0])
    north = np.array([0.0, 1.0, 0.0])
    up = np.array([0.0, 0.0, 1.0])
    forward = np.cos(tilt) * (np.cos(azimuth) * north + np.sin(azimuth) * EAST) + np.sin(tilt) * up
    right = np.cross(forward, up) / np.cos(tilt)
    level = np.stack([right, np.cross(forward, right), forward])
    pose = Pose(
        jnp.asarray(Rotation.from_rotvec([0, 0, 0.3]).as_matrix() @ level),
        jnp.asarray(rng.standard_normal(3)),
    )

    def of(azimuth):
        return residuals.heading.function(pose, azimuth=azimuth, north=NORTH, up=UP, sigma=0.1)

    assert of(azimuth) == pytest.approx(0, abs=1e-12)
    assert of(azimuth - 0.02) == pytest.approx(0.2)
    assert of(azimuth + 2 * np.pi - 0.02) == pytest.approx(0.2)
    measured = np.asarray(pose.rotation) @ up * 9.81
    turned = Rotation.from_rotvec(
        0.01 * np.cross(measured, [1, 0, 0]) / np.linalg.norm(np.cross(measured, [1, 0, 0]))
    )

    def of(direction):
        return residuals.gravity.function(pose, direction=direction, up=UP, sigma=0.1)

    np.testing.assert_allclose(of(measured), 0, atol=1e-12)
    assert np.linalg.norm(of(turned.apply(measured))) == pytest.approx(0.1, rel=1e-4)


@pytest.mark.slow
def test_a_survey_finds_the_scene_from_points_antennas_baselines_and_planes():
    """Without pixels that say anything about position, orientation and scale of the whole."""
    truth, start = truth_and_start(0.005)
    poses = poses_of(truth)
    each = np.arange(5)
    arm = np.array([0.1, -0.2, 0.3])
    antennas = np.array([to_world(pose)[:3, :3] @ arm + to_world(pose)[:3, 3] for pose in poses])
    up = np.array([pose.rotation @ UP for pose in poses])
    first = poses[0]
    second = poses[1]
    z = np.linalg.inv(to_world(first)) @ to_world(second)
    forward = np.array([pose.rotation[2] for pose in poses])
    azimuth = np.arctan2(forward[:, 0], forward[:, 1])
    normals = np.random.default_rng(2).standard_normal((10, 3))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    along = np.cross(normals, [1.0, 2.0, 3.0])
    length = np.linalg.norm(centers(truth)[2] - centers(truth)[4])
    every = (
        residuals.control_point(
            point=[0, 1, 2], position=truth.points[:3], whitening=np.eye(3)[None] / 0.01
        ),
        residuals.position(
            pose=each, position=antennas, lever_arm=arm[None], whitening=np.eye(3) / 0.02
        ),
        residuals.gravity(pose=each, direction=up, up=UP, sigma=0.01),
        residuals.heading(pose=each, azimuth=azimuth, north=NORTH, up=UP, sigma=0.01),
        residuals.baseline(pose=2, pose_2=4, length=length, sigma=0.001),
        residuals.relative_pose(
            pose=0, pose_2=1, rotation=z[:3, :3], translation=z[:3, 3], whitening=np.eye(6)[None]
        ),
        residuals.point_to_plane(
            point=np.arange(10),
            normal=normals,
            on_plane=truth.points[:10] + along,
            sigma=np.full(10, 0.01),
        ),
    )

    # without the checks of with_residual
    def indexed(rows):
        return tuple(x.astype(np.int32) for x in rows.index)

    rows = [
        replace(x, size=n, index=indexed(x))
        for x, n in zip(every, (3, 3, 3, 1, 1, 6, 1), strict=True)
    ]
    found = solved(start.replace(residuals=Residuals(tuple(rows))))
    np.testing.assert_allclose(found.points, truth.points, atol=1e-7)
    np.testing.assert_allclose(centers(found), centers(truth), atol=1e-7)


def test_depth_maps_find_points_and_their_own_scales():
    truth, start = truth_and_start()
    start = jaxba.hold(
        start.replace(cameras=truth.cameras), poses="all", numbers=["focal", "distortion"]
    )
    camera = truth.camera_index
    point = truth.point_index
    scale = np.linspace(0.5, 2.0, 5)
    shift = np.linspace(-1.0, 1.0, 5)
    measured = scale[camera] * geometry.depths(truth) + shift[camera]
    rows = residuals.depth(pose=camera, point=point, image=camera, measured=measured, sigma=0.1)
    found = solved(
        jaxba.with_residual(start, rows, unknowns={"image": np.tile([1.0, 0.0], (5, 1))})
    )
    np.testing.assert_allclose(
        found.residuals.blocks[0], np.stack([scale, shift], axis=1), atol=1e-6
    )
    np.testing.assert_allclose(found.points, truth.points, atol=1e-7)


def test_a_scale_bar_measures_the_distance_of_two_points():
    one = np.array([1.0, 2.0, 3.0])
    two = np.array([1.0, 5.0, 7.0])
    assert residuals.distance.function(one, two, length=4.5, sigma=0.1) == pytest.approx(5.0)


@pytest.mark.slow
def test_a_rolling_shutter_moves_as_the_camera_does():
    """Pixels of a camera that is moved in many small steps; a solve finds its velocities."""
    truth, _ = truth_and_start()
    rng = np.random.default_rng(4)
    velocity = 0.3 * rng.standard_normal((5, 6))
    time = rng.uniform(-0.4, 0.4, truth.num_observations)
    steps = 2000
    # to the world
    rotation = np.array([pose.rotation.T for pose in poses_of(truth)])[truth.camera_index]
    small = Rotation.from_rotvec(
        velocity[truth.camera_index, :3] * time[:, None] / steps
    ).as_matrix()
    for _ in range(steps):
        rotation = rotation @ small
    at = centers(truth)[truth.camera_index] + time[:, None] * velocity[truth.camera_index, 3:]
    local = np.einsum("nji,nj->ni", rotation, truth.points[truth.point_index] - at)
    pixel = geometry.pixels(truth, np.asarray(truth.camera_index), local)
    rows = residuals.rolling_shutter(
        pose=truth.camera_index,
        lens=truth.camera_index,
        point=truth.point_index,
        velocity=truth.camera_index,
        pixel=pixel,
        time=time,
        sigma=1.0,
    )
    unseen = truth.replace(whitening=np.zeros((truth.num_observations, 2, 2)))
    held = jaxba.hold(unseen, poses=[0], numbers=["focal", "distortion"], points=[0, 1, 2])
    problem = jaxba.with_residual(held, rows, unknowns={"velocity": np.zeros((5, 6))})
    np.testing.assert_allclose(solved(problem).residuals.blocks[0], velocity, atol=1e-6)


def test_bounds_of_lenses_are_a_smooth_hinge_that_acts_everywhere():
    def lens(*x):
        return Lens(jnp.asarray(x), jnp.asarray(0), ())

    low = np.array([400.0, -1.0, -1.0])
    high = np.array([600.0, 1.0, 1.0])

    def of(f):
        return np.asarray(
            residuals.lens_bounds.function(lens(f, 0.0, 0.0), low=low, high=high, sigma=2.0)
        )

    np.testing.assert_allclose(of(500.0)[[0, 3]], 1 / (2 * (50 + np.sqrt(2501))), rtol=1e-12)
    assert of(400.0)[0] == 0.5
    assert of(700.0)[3] == pytest.approx(50, rel=1e-3)
    assert (np.diff([of(f)[3] for f in np.linspace(0, 1200, 50)]) > 0).all()
    problem = scene()  # far inside, where a hinge that is zero would be refused
    rows = residuals.lens_bounds(
        lens=np.arange(5), low=low[None] - 1e3, high=high[None] + 1e3, sigma=0.01
    )
    assert len(jaxba.with_residual(problem, rows).residuals.rows[0]) == 5
