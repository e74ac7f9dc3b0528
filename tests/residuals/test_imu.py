"""Preintegrated measurements of an IMU against fine integration, and a solve that finds motion and
biases."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

import jaxba
from jaxba import residuals
from jaxba.problem import geometry

GRAVITY = np.array([0.0, 0.0, -9.81])
BIAS = np.array([0.01, -0.02, 0.015, 0.1, -0.05, 0.08])
NOISE = [1e-3, 1e-2, 1e-4, 1e-3]
MOUNT = np.column_stack([Rotation.from_rotvec([1.3, 0.1, -0.2]).as_matrix(), [0.05, -0.1, 0.02]])
MOMENTS = np.linspace(0.1003, 1.3003, 5)  # between samples


def attitude(t) -> Rotation:
    """From the IMU to the world."""
    return Rotation.from_rotvec(
        np.stack([0.5 * np.sin(2 * t), 0.4 * t, 0.3 * np.cos(3 * t)], axis=-1)
    )


def place(t) -> np.ndarray:
    return np.stack([np.sin(1.5 * t), 0.5 * t**2, 0.3 * np.cos(2 * t)], axis=-1)


def velocity(t) -> np.ndarray:
    return np.stack([1.5 * np.cos(1.5 * t), t, -0.6 * np.sin(2 * t)], axis=-1)


def samples(rate: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times, angular rates and specific forces, without noise or bias."""
    t = np.arange(0, 1.5, 1 / rate)
    h = 1e-4
    rates = (attitude(t - h).inv() * attitude(t + h)).as_rotvec() / (2 * h)
    force = (velocity(t + h) - velocity(t - h)) / (2 * h) - GRAVITY
    return t, rates, attitude(t).inv().apply(force)


def test_an_interval_is_that_of_fine_integration():
    t, rates, forces = samples(200.0)
    found = residuals.preintegrated(t, rates, forces, MOMENTS, bias=BIAS, noise=NOISE)
    start, end = MOMENTS[1:3]

    def rate(time, state):
        def now(x):
            return np.array([np.interp(time, t, column) for column in x.T])

        rotation = state[:9].reshape(3, 3)
        turn = np.cross(np.eye(3), now(rates) - BIAS[:3])
        return np.concatenate(
            [(rotation @ turn).ravel(), rotation @ (now(forces) - BIAS[3:]), state[9:12]]
        )

    whole = solve_ivp(
        rate,
        (start, end),
        np.r_[np.eye(3).ravel(), np.zeros(6)],
        rtol=1e-9,
        atol=1e-11,
        max_step=0.002,
    )
    truth = whole.y[:, -1]
    np.testing.assert_allclose(found["rotation"][1], truth[:9].reshape(3, 3), atol=3e-6)
    np.testing.assert_allclose(found["velocity"][1], truth[9:12], atol=3e-5)
    np.testing.assert_allclose(found["position"][1], truth[12:], atol=3e-5)
    assert found["duration"] == pytest.approx(0.3)


def test_derivatives_by_the_biases_are_those_of_differences():
    t, rates, forces = samples(200.0)

    def at(bias):
        return residuals.preintegrated(t, rates, forces, MOMENTS, bias=bias, noise=NOISE)

    here = at(BIAS)
    step = 1e-5
    for k in range(6):
        one, other = (at(BIAS + sign * step * np.eye(6)[k]) for sign in (1, -1))
        turn = Rotation.from_matrix(here["rotation"]).inv()
        turns = [(turn * Rotation.from_matrix(x["rotation"])).as_rotvec() for x in (one, other)]
        numbers = [
            np.hstack([w, x["velocity"], x["position"]])
            for w, x in zip(turns, (one, other), strict=True)
        ]
        np.testing.assert_allclose(
            here["by_bias"][:, :, k], (numbers[0] - numbers[1]) / (2 * step), atol=1e-7
        )


def test_the_covariance_is_that_of_the_recursion_of_the_paper():
    """Forster et al. 2017, appendix: eqs. A.7 to A.9, by Euler's rule with short steps."""
    t, rates, forces = samples(2000.0)
    found = residuals.preintegrated(t, rates, forces, [t[0], t[600]], noise=NOISE)["whitening"][0]

    def cross(v):
        return geometry.cross_matrices(v[None])[0]

    covariance = np.zeros((9, 9))
    rotation = np.eye(3)
    dt = 1 / 2000.0
    for rate, force in zip(rates[:600], forces[:600], strict=True):
        turn = Rotation.from_rotvec(rate * dt).as_matrix()
        a = np.eye(9)
        b = np.zeros((9, 6))
        a[:3, :3], a[6:, 3:6] = turn.T, np.eye(3) * dt
        a[3:6, :3], a[6:, :3] = (
            -rotation @ cross(force) * dt,
            -0.5 * rotation @ cross(force) * dt**2,
        )
        b[:3, :3], b[3:6, 3:], b[6:, 3:] = np.eye(3) * dt, rotation * dt, 0.5 * rotation * dt**2
        covariance = a @ covariance @ a.T + b @ np.diag(np.repeat([1e-6, 1e-4], 3) / dt) @ b.T
        rotation = rotation @ turn
    np.testing.assert_allclose(found[:9, :9] @ covariance @ found[:9, :9].T, np.eye(9), atol=0.02)
    np.testing.assert_allclose(np.diag(found)[[9, 12]] ** -2, 0.3 * np.array([1e-4, 1e-3]) ** 2)
    assert not found[:9, 9:].any()


@pytest.mark.slow
def test_a_solve_finds_poses_velocities_and_biases():
    """Pixels say nothing about the scale: the IMU does."""
    rng = np.random.default_rng(0)
    to_camera = Rotation.from_matrix(MOUNT[:, :3])
    rotation = (to_camera * attitude(MOMENTS).inv()).as_matrix()
    center = place(MOMENTS) - attitude(MOMENTS).apply(MOUNT[:, :3].T @ MOUNT[:, 3])
    bal = geometry.COLMAP_FLIP[:, None] * rotation
    lens = np.tile([500.0, 0.0, 0.0], (5, 1))
    cameras = np.hstack([geometry.angle_axis(bal), geometry.translations(bal, center), lens])
    local = rng.uniform([-2, -2, 4], [2, 2, 8], (40, 3))
    points = local @ rotation[2] + center[2]
    camera = np.repeat(np.arange(5), 40)
    point = np.tile(np.arange(40), 5)
    truth = jaxba.BundleProblem.create(cameras, points, np.zeros((200, 2)), camera, point)
    truth = truth.replace(observations=geometry.project(truth))
    t, rates, forces = samples(500.0)
    given = residuals.preintegrated(
        t, rates + BIAS[:3], forces + BIAS[3:], MOMENTS, bias=BIAS + 1e-3, noise=NOISE
    )
    one = np.arange(4)
    two = np.arange(1, 5)
    rows = residuals.imu(
        pose=one,
        motion=one,
        pose_2=two,
        motion_2=two,
        **given,
        gravity=GRAVITY[None],
        mount=MOUNT[None],
    )
    moved = truth.cameras.copy()
    moved[1:, :6] += 0.01 * rng.standard_normal((4, 6))
    start = truth.replace(
        cameras=moved, points=1.05 * points + 0.01 * rng.standard_normal(points.shape)
    )
    start = jaxba.hold(start, poses=[0], numbers=["focal", "distortion"])
    problem = jaxba.with_residual(start, rows, unknowns={"motion": np.zeros((5, 9))})
    solution = jaxba.solve(problem, "ceres", jaxba.SolveOptions(max_iterations=100))
    motion = solution.problem.residuals.blocks[0]
    np.testing.assert_allclose(motion[:, :3], velocity(MOMENTS), atol=1e-3)
    np.testing.assert_allclose(motion[:, 3:], np.tile(BIAS, (5, 1)), atol=2e-3)
    np.testing.assert_allclose(geometry.camera_centers(solution.problem.cameras), center, atol=1e-4)
    np.testing.assert_allclose(solution.problem.points, points, atol=1e-3)


@jaxba.residual
def known_motion(motion, *, value, sigma):
    """Velocity and biases of a state that is known."""
    return (motion - value) / sigma


@pytest.mark.slow
def test_a_stiff_chain_of_inertial_states_ends_at_the_truth_in_a_handful_of_iterations():
    """Exact samples of a body on a spiral, priors at both ends, and starts off by 0.1 radians and a
    metre.

    It is the situation of GTSAM's ImuFactorExample, which takes 5 iterations."""
    rng = np.random.default_rng(0)
    seconds = 12
    rate = 100
    spin = np.radians([30.0, -30.0, 0.0])  # in the body's frame, as its velocity
    speed = np.array([2.0, 0.0, 0.0])
    t = np.arange(seconds * rate + 1) / rate
    turns = Rotation.from_rotvec(np.outer(t, spin))
    forces = np.cross(spin, speed) - turns.inv().apply(GRAVITY)
    axis = spin / np.linalg.norm(spin)
    angle = np.linalg.norm(spin) * t[:, None]
    across = np.cross(axis, speed) / np.linalg.norm(spin)
    along = axis * (axis @ speed)
    places = (
        along * t[:, None]
        + np.sin(angle) * (speed - along) / np.linalg.norm(spin)
        + (1 - np.cos(angle)) * across
    )
    states = np.arange(seconds + 1) * rate
    ends = [0, seconds]

    moved = turns[states] * Rotation.from_rotvec(0.1 * rng.standard_normal((len(states), 3)))
    rotation = geometry.COLMAP_FLIP[:, None] * moved.inv().as_matrix()
    centers = places[states] + rng.standard_normal((len(states), 3))
    lens = np.tile([1.0, 0.0, 0.0], (len(states), 1))
    cameras = np.hstack(
        [geometry.angle_axis(rotation), geometry.translations(rotation, centers), lens]
    )
    velocities = turns[states].apply(speed)
    motion = np.hstack(
        [velocities + 0.1 * rng.standard_normal(velocities.shape), np.zeros((len(states), 6))]
    )

    given = residuals.preintegrated(
        t, np.tile(spin, (len(t), 1)), forces, t[states], noise=[1e-3] * 4
    )
    first = np.arange(seconds)
    rows = residuals.imu(
        pose=first,
        motion=first,
        pose_2=first + 1,
        motion_2=first + 1,
        **given,
        gravity=GRAVITY[None],
        mount=np.eye(3, 4)[None],
    )
    problem = jaxba.with_residual(
        jaxba.BundleProblem.create(cameras), rows, unknowns={"motion": motion}
    )
    value = np.hstack([velocities[ends], np.zeros((2, 6))])
    sigma = np.array([0.1] * 3 + [1e-3] * 6)[None]
    problem = jaxba.with_residual(problem, known_motion(motion=ends, value=value, sigma=sigma))
    problem = jaxba.with_position_priors(
        problem, places[states][ends], stddev=0.1, images=ends, align=False
    )
    true = geometry.COLMAP_FLIP[:, None] * turns[states][ends].inv().as_matrix()
    problem = jaxba.with_rotation_priors(
        problem, geometry.angle_axis(true), 0.01 * np.eye(3), images=ends
    )
    solution = jaxba.solve(problem)
    assert solution.converged
    assert solution.iterations <= 8
    assert solution.final_cost < 1e-4
    np.testing.assert_allclose(
        geometry.camera_centers(solution.problem.cameras), places[states], atol=5e-3
    )


def test_wrong_times_are_one_line():
    t, rates, forces = samples(200.0)
    with pytest.raises(ValueError, match="times and moments must ascend"):
        residuals.preintegrated(t, rates, forces, [0.0, 2.0], noise=NOISE)
    with pytest.raises(ValueError, match=r"accelerations must have shape \(300, 3\)"):
        residuals.preintegrated(t, rates, forces[:-1], MOMENTS, noise=NOISE)
    with pytest.raises(ValueError, match="noise must be positive"):
        residuals.preintegrated(t, rates, forces, MOMENTS, noise=[1e-3, 1e-2, 0.0, 1e-3])
