"""The camera's derivatives and the rotation group, at ordinary places and at the degenerate
ones."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import support
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from jaxba import rotations
from jaxba.model import camera
from jaxba.problem import geometry

THRESHOLD = np.sqrt(rotations.SMALL_ANGLE_SQUARED)
ANGLES = [
    0.0,
    1e-160,
    1e-12,
    1e-8,
    1e-4,
    *(THRESHOLD * np.array([0.5, 1 - 1e-9, 1.0, 1 + 1e-9, 2.0])),
    0.03,
    0.5,
    1.0,
]
ANGLES += [2.0, 3.0, np.pi - 1e-7, np.pi, np.pi + 1e-7, 4.0]
"""From nothing through the switch to the series, to half a turn and past it."""

IDENTITY = np.eye(3)


def vectors(angles=ANGLES, seed=0) -> np.ndarray:
    """Angle-axis vectors of all angles about random axes and about the coordinate axes, shape (n,
    3)."""
    rng = np.random.default_rng(seed)
    axes = rng.normal(size=(3, 3))
    axes = np.vstack([axes / np.linalg.norm(axes, axis=1, keepdims=True), IDENTITY, -IDENTITY[:1]])
    return (np.array(angles)[:, None, None] * axes).reshape(-1, 3)


def matrices(function, w: np.ndarray) -> np.ndarray:
    """Result of a jaxba function of vectors as (n, 3, 3)."""
    return np.moveaxis(np.asarray(function(jnp.asarray(w.T))), -1, 0)


# Rotations


def test_rotation_matrices_are_those_of_scipy():
    w = vectors([*ANGLES, 6.0, 2 * np.pi, 10.0])
    np.testing.assert_allclose(
        matrices(rotations.rotation_matrix, w), Rotation.from_rotvec(w).as_matrix(), atol=4e-15
    )


def test_rotation_matrices_are_orthogonal_with_determinant_one():
    found = matrices(rotations.rotation_matrix, vectors())
    np.testing.assert_allclose(
        found @ found.transpose(0, 2, 1), np.broadcast_to(IDENTITY, found.shape), atol=4e-15
    )
    np.testing.assert_allclose(np.linalg.det(found), 1, atol=4e-15)


def test_zero_rotation_is_exactly_the_identity():
    assert np.array_equal(matrices(rotations.rotation_matrix, np.zeros((1, 3)))[0], IDENTITY)


def test_rotation_is_differentiable_at_zero_with_the_generators_as_derivative():
    derivative = jax.jacfwd(lambda w: rotations.rotation_matrix(w[:, None])[..., 0])(jnp.zeros(3))
    for k in range(3):
        np.testing.assert_array_equal(
            np.asarray(derivative)[:, :, k], np.cross(IDENTITY, IDENTITY[k]).T * -1
        )


def test_left_jacobian_is_the_derivative_of_the_exponential():
    """`exp(w + h e) exp(w)^-1 = exp(J h e)`, by central differences on the group; error h^2 + eps /
    h."""
    w = vectors()
    h = 1e-5
    found = matrices(rotations.left_jacobian, w)
    for k in range(3):
        ahead, behind = (Rotation.from_rotvec(w + s * h * IDENTITY[k]) for s in (1, -1))
        np.testing.assert_allclose(
            found[:, :, k], (ahead * behind.inv()).as_rotvec() / (2 * h), atol=2e-10
        )


def test_left_jacobian_is_the_mean_of_the_rotations_on_the_way():
    """`J(w)` is the integral of `exp(s w)` over s in [0, 1]; twenty Gauss nodes are exact to
    rounding."""
    nodes, weights = np.polynomial.legendre.leggauss(20)
    w = vectors()
    mean = sum(
        0.5 * weight * Rotation.from_rotvec(0.5 * (node + 1) * w).as_matrix()
        for node, weight in zip(nodes, weights, strict=True)
    )
    np.testing.assert_allclose(matrices(rotations.left_jacobian, w), mean, atol=1e-14)


def test_left_jacobian_inverse_is_the_inverse():
    w = vectors([*ANGLES, 5.0])
    product = matrices(rotations.left_jacobian, w) @ matrices(rotations.left_jacobian_inverse, w)
    np.testing.assert_allclose(product, np.broadcast_to(IDENTITY, product.shape), atol=2e-14)


def test_left_jacobian_inverse_is_the_derivative_of_the_logarithm():
    """`log(exp(h e) exp(w)) = w + J^-1 h e`, by central differences, away from half a turn where
    the log jumps."""
    w = vectors([a for a in ANGLES if a < 3.1])
    h = 1e-5
    found = matrices(rotations.left_jacobian_inverse, w)
    for k in range(3):
        ahead, behind = (
            Rotation.from_rotvec(s * h * IDENTITY[k]) * Rotation.from_rotvec(w) for s in (1, -1)
        )
        np.testing.assert_allclose(
            found[:, :, k], (ahead.as_rotvec() - behind.as_rotvec()) / (2 * h), atol=1e-9
        )


def test_composition_is_that_of_scipy():
    """Every pair of steps and rotations, among them those that cancel and those that pass half a
    turn."""
    some = vectors(
        [0.0, 1e-12, 1e-8, THRESHOLD * (1 - 1e-9), THRESHOLD * (1 + 1e-9), 0.3, 2.5, np.pi]
    )
    step = np.repeat(some, len(some), axis=0)
    w = np.tile(some, (len(some), 1))
    step = np.vstack([step, -some])
    w = np.vstack([w, some])
    found = np.array(rotations.compose_left(jnp.asarray(step.T), jnp.asarray(w.T))).T
    expected = Rotation.from_rotvec(step) * Rotation.from_rotvec(w)
    np.testing.assert_allclose(
        Rotation.from_rotvec(found).as_matrix(), expected.as_matrix(), atol=1e-14
    )
    assert np.linalg.norm(found, axis=1).max() <= np.pi * (1 + 1e-14)
    np.testing.assert_allclose(found[-len(some) :], 0, atol=1e-14)


def test_composition_with_a_tiny_step_loses_no_digit_of_the_step():
    step = 1e-9 * vectors([1.0])
    found = np.asarray(rotations.compose_left(jnp.asarray(step.T), jnp.zeros((3, len(step))))).T
    # a cosine in between would leave 7 digits of 16
    np.testing.assert_allclose(found, step, rtol=1e-14)


@settings(max_examples=100, deadline=None)
@given(st.lists(st.floats(-3, 3), min_size=6, max_size=6))
def test_composition_multiplies_matrices(numbers):
    step = np.array(numbers[:3])
    w = np.array(numbers[3:])
    found = np.asarray(
        rotations.compose_left(jnp.asarray(step[:, None]), jnp.asarray(w[:, None]))
    ).T
    both = geometry.rotation_matrices(np.stack([step, w]))
    np.testing.assert_allclose(geometry.rotation_matrices(found)[0], both[0] @ both[1], atol=2e-14)


def test_single_precision_stays_single():
    w = jnp.asarray(vectors().T, jnp.float32)
    functions = [
        rotations.rotation_matrix,
        rotations.left_jacobian,
        rotations.left_jacobian_inverse,
    ]
    assert {f(w).dtype for f in functions} == {jnp.dtype("float32")}
    assert rotations.compose_left(w, w).dtype == jnp.float32
    found = np.moveaxis(np.asarray(rotations.rotation_matrix(w)), -1, 0)
    np.testing.assert_allclose(found, Rotation.from_rotvec(vectors()).as_matrix(), atol=1e-6)


# Projection and derivatives


def scenes() -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Cameras (n, 9) and points (n, 3) by kind."""
    rng = np.random.default_rng(1)
    n = 25
    lens = np.column_stack(
        [rng.uniform(300, 3000, n), rng.uniform(-0.2, 0.2, n), rng.uniform(-0.05, 0.05, n)]
    )

    def facing(
        rotations: np.ndarray, depth: float | np.ndarray, spread=0.5
    ) -> tuple[np.ndarray, np.ndarray]:
        """Points at P = (x, y, -depth) in their camera's frame, |x|, |y| up to spread * |depth|."""
        depth = np.broadcast_to(depth, n)
        local = np.column_stack(
            [rng.uniform(-spread, spread, (n, 2)) * np.abs(depth)[:, None], -depth]
        )
        shift = rng.normal(size=(n, 3))
        points = Rotation.from_rotvec(rotations).inv().apply(local - shift)
        return np.column_stack([rotations, shift, lens]), points

    turns = rng.normal(size=(n, 3))
    unit = turns / np.linalg.norm(turns, axis=1, keepdims=True)
    huge = facing(turns, 3.0, spread=2.0)
    huge[0][:, 7:] = rng.uniform(-1e3, 1e3, (n, 2))
    return {
        "random": facing(turns, rng.uniform(1, 50, n)),
        "zero rotation": facing(np.zeros((n, 3)), 4.0),
        "tiny rotation": facing(unit * np.geomspace(1e-12, 1e-2, n)[:, None], 4.0),
        "series threshold": facing(unit * THRESHOLD * np.linspace(0.99, 1.01, n)[:, None], 4.0),
        "half a turn": facing(unit * (np.pi + np.linspace(-1e-3, 1e-3, n))[:, None], 4.0),
        "behind the camera": facing(turns, -rng.uniform(1, 50, n)),
        "near the camera plane": facing(turns, 10.0 ** rng.uniform(-6, -2, n)),
        "huge distortion": huge,
    }


def analytic(cameras: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixels (n, 2) and derivatives (n, 2, 9), (n, 2, 3) by jaxba."""
    frame = camera.frames(jnp.asarray(cameras.T))
    projection = camera.project(frame, jnp.asarray(points.T))
    found = camera.derivatives(frame, projection)
    by_camera, by_point = (np.moveaxis(np.array(rows), -1, 0) for rows in found)
    return np.asarray(projection.pixel).T, by_camera, by_point


@jax.jit
def by_autodiff(cameras, points):
    """The same by automatic differentiation of the support module's camera, rotation on the
    manifold."""
    zero = jnp.zeros((cameras.shape[0], 3))
    turn, rest, point = jax.vmap(jax.jacfwd(support.project_one, argnums=(0, 1, 2)))(
        zero, cameras, points
    )
    return (
        jax.vmap(support.project_one)(zero, cameras, points),
        jnp.concatenate([turn, rest[..., 3:]], axis=-1),
        point,
    )


@pytest.mark.parametrize("kind", list(scenes()))
def test_derivatives_equal_automatic_differentiation(kind):
    cameras, points = scenes()[kind]
    pixel, by_camera, by_point = analytic(cameras, points)
    expected = by_autodiff(cameras, points)
    # the depth is a difference of numbers near one, so what is near the plane is known to eps /
    # depth
    depth = np.abs((Rotation.from_rotvec(cameras[:, :3]).apply(points) + cameras[:, 3:6])[:, 2])
    tolerance = 1e-13 * np.maximum(1, 10 / depth)
    for found, truth in zip((pixel, by_camera, by_point), map(np.asarray, expected), strict=True):
        error = np.abs(found - truth).reshape(len(truth), -1).max(axis=1)
        assert (error <= tolerance * np.abs(truth).reshape(len(truth), -1).max(axis=1)).all()


@pytest.mark.parametrize("kind", list(scenes()))
def test_derivatives_equal_central_differences(kind):
    """Of jaxba's host camera in NumPy; each column to 1e-6 of its own size."""
    cameras, points = scenes()[kind]
    _, by_camera, by_point = analytic(cameras, points)
    depth = np.abs((Rotation.from_rotvec(cameras[:, :3]).apply(points) + cameras[:, 3:6])[:, 2])

    def pixels(turn: np.ndarray, cameras: np.ndarray, points: np.ndarray) -> np.ndarray:
        rotation = geometry.rotation_matrices(turn) @ geometry.rotation_matrices(cameras[:, :3])
        local = np.einsum("nij,nj->ni", rotation, points) + cameras[:, 3:6]
        return support.distort(local[:, :2] / -local[:, 2:], cameras[:, 6:])

    def central(parameter: int, k: int, h: np.ndarray) -> np.ndarray:
        ends = []
        for sign in (1, -1):
            values = [np.zeros_like(points), cameras.copy(), points.copy()]
            values[parameter][:, k] += sign * h
            ends.append(pixels(*values))
        return (ends[0] - ends[1]) / (2 * h)[:, None]

    # h far below the depth; f, k1 and k2 enter linearly
    small = 1e-5 * np.minimum(depth, 1)
    unit = np.ones(len(points))
    columns = [(0, k, small, by_camera[:, :, k]) for k in range(3)]
    columns += [(1, k, small if k < 6 else unit, by_camera[:, :, k]) for k in range(3, 9)]
    columns += [(2, k, small, by_point[:, :, k]) for k in range(3)]
    for parameter, k, h, found in columns:
        group = (
            by_point
            if parameter == 2
            else by_camera[:, :, k : k + 1]
            if k >= 6
            else by_camera[:, :, :6]
        )
        size = np.abs(group).reshape(len(points), -1).max(axis=1)
        error = np.abs(found - central(parameter, k, h)).max(axis=1)
        tolerance = 1e-6 * np.maximum(1, 1e-3 / depth)
        assert (error <= tolerance * size).all(), (parameter, k, (error / size).max())


@pytest.mark.parametrize("kind", list(scenes()))
def test_pixels_equal_the_host_camera(kind):
    cameras, points = scenes()[kind]
    local = (
        np.einsum("nij,nj->ni", geometry.rotation_matrices(cameras[:, :3]), points)
        + cameras[:, 3:6]
    )
    expected = support.distort(local[:, :2] / -local[:, 2:], cameras[:, 6:])
    tolerance = 1e-12 * np.maximum(1, 1 / np.abs(local[:, 2]))[:, None]
    assert (
        np.abs(analytic(cameras, points)[0] - expected)
        <= tolerance * np.abs(expected).max(axis=1)[:, None]
    ).all()


def test_on_the_camera_plane_nothing_is_finite_and_nothing_is_raised():
    cameras = np.array([[0, 0, 0, 0, 0, 0, 500.0, 0.1, 0.01]] * 2)
    points = np.array([[1.0, 2.0, 0.0], [0.0, 0.0, 0.0]])
    pixel, by_camera, by_point = analytic(cameras, points)
    assert not np.isfinite(pixel).all(axis=1).any()
    assert not np.isfinite(by_camera).all(axis=(1, 2)).any()
    assert not np.isfinite(by_point).all(axis=(1, 2)).any()


def test_a_masked_observation_is_exactly_zero_even_on_the_camera_plane():
    cameras = np.array([[0.1, 0.2, 0.3, 0, 0, 0, 500.0, 0.1, 0.01]] * 2)
    points = np.zeros((2, 3))
    frame = camera.frames(jnp.asarray(cameras.T))
    projection = camera.project(frame, jnp.asarray(points.T), jnp.zeros(2, bool))
    found = camera.derivatives(frame, projection)
    assert not np.any(projection.pixel)
    assert not np.any(np.array(found[0]))
    assert not np.any(np.array(found[1]))
