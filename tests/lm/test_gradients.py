"""Derivatives of a step by cameras, points, observations and lambda, both ways, against finite
differences.

Scenes have what makes derivatives NaN where values are fine: a camera in the origin without
rotation, observation slots and points that are empty, observations of no weight, points behind a
camera, cameras that nobody observes."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import support

from jaxba import (
    BundleProblem,
    Lenses,
    Loss,
    StepOptions,
    build_layout,
    initial_state,
    lm_step,
    random_scene,
)
from jaxba.linear.cholesky import lower_cholesky
from jaxba.problem import geometry
from jaxba.problem.options import ConjugateGradients, Coordinates
from jaxba.problem.safe_math import safe_divide, safe_sqrt
from jaxba.scenes import SceneConfig
from jaxba.structure.layout import Layout
from jaxba.structure.observation_order import ObservationOrder
from jaxba.structure.padding import capacity_of, padded_parameters

pytestmark = pytest.mark.step

DAMPING = 1e-2
PLAIN = StepOptions()
TO_THE_END = ConjugateGradients(forcing=0.0, tolerance=1e-14, max_iterations=5000)


def in_first_camera(problem: BundleProblem) -> BundleProblem:
    """The same scene in the coordinates of camera 0, which then stands in the origin without
    rotation."""
    rotations = geometry.rotation_matrices(problem.cameras[:, :3])
    translations = problem.cameras[:, 3:6]
    turned = rotations @ rotations[0].T
    cameras = np.array(problem.cameras)
    cameras[:, :3] = geometry.angle_axis(turned)
    cameras[:, 3:6] = translations - turned @ translations[0]
    cameras[0, :6] = 0
    return problem.replace(
        cameras=cameras, points=problem.points @ rotations[0].T + translations[0]
    )


def sequence() -> BundleProblem:
    """Cameras in a row, each of which sees its neighbours' points only: a band."""
    return random_scene(
        SceneConfig(70, 150, 600, max_depth=4.0, gap_share=0.0, revisit_share=0.0), 0
    )


def shared() -> BundleProblem:
    """`tiny` with three lenses, of which one is held fast and one is not distorted."""
    problem = support.tiny()
    index = np.array([0, 1, 0, 2, 1, 0])
    cameras = np.array(problem.cameras)
    cameras[:, 6:] = cameras[[0, 1, 0, 3, 1, 0], 6:]
    free = np.array([[1, 1, 0], [1, 1, 1], [0, 0, 0]], bool)
    return BundleProblem.create(cameras, *support.arrays(problem)[1:], lenses=Lenses(index, free))


def padded(problem: BundleProblem, _: StepOptions) -> tuple[Layout, BundleProblem]:
    capacity = capacity_of(problem, ObservationOrder.of(problem))
    cameras, points = padded_parameters(problem, capacity)
    return build_layout(problem, capacity=capacity), problem.replace(cameras=cameras, points=points)


def own_size(problem: BundleProblem, options: StepOptions) -> tuple[Layout, BundleProblem]:
    return build_layout(problem, options), problem


FACTORED = {
    "dense": (support.tiny, PLAIN, own_size),
    "band": (sequence, PLAIN, own_size),
    "shared-lenses": (shared, PLAIN, own_size),
    "odd": (support.odd, PLAIN, own_size),
    "manifold": (support.tiny, StepOptions(coordinates=Coordinates(rotation="manifold")), own_size),
    "tukey": (support.odd, StepOptions(loss=Loss("tukey", 8.0)), own_size),
    # jax.scipy's conjugate gradients have the derivatives of the solution, in both modes
    "cg": (
        support.tiny,
        StepOptions(linear_solver="cg", conjugate_gradients=ConjugateGradients(budget=120)),
        own_size,
    ),
}
WITH_LOOPS = {
    "implicit": (
        support.tiny,
        StepOptions(linear_solver="implicit", conjugate_gradients=TO_THE_END),
        own_size,
    ),
    "padded-pairs": (support.odd, PLAIN, padded),
}


def as_function(make, options: StepOptions, lay_out):
    """The step as a function of cameras, points, pixels and lambda, to all its numbers by name; and
    where it starts."""
    layout, given = lay_out(in_first_camera(make()), options)
    state = initial_state(layout, given, options, jnp.float64)
    assert np.any(np.all(np.asarray(state.cameras[:6]) == 0, axis=0))
    layout = jax.device_put(layout)

    @jax.jit
    def step(cameras, points, pixels, damping):
        before = state._replace(cameras=cameras, points=points)
        after, info = lm_step(replace(layout, pixels=pixels), before, damping, options)
        numbers = {
            name: x for name, x in info._asdict().items() if jnp.issubdtype(x.dtype, jnp.floating)
        }
        kinds = {"rotations": slice(0, 3), "translations": slice(3, 6), "intrinsics": slice(6, 9)}
        return {
            **numbers,
            "points": after.points,
            **{kind: after.cameras[rows] for kind, rows in kinds.items()},
        }

    return step, (
        state.cameras,
        state.points,
        jnp.asarray(layout.pixels),
        jnp.asarray(DAMPING),
    )


def directions(at, seed: int = 0):
    """For each argument a random direction of the size of its numbers, the other arguments
    unchanged."""
    rng = np.random.default_rng(seed)
    for k, argument in enumerate(at):
        size = np.abs(argument).max(axis=-1, keepdims=True) if argument.ndim else argument
        moved = jnp.asarray(rng.normal(size=argument.shape) * np.asarray(size))
        yield tuple(moved if k == other else jnp.zeros_like(x) for other, x in enumerate(at))


def differences(function, at, direction, width: float):
    """Central differences of fourth order."""

    def value(scale):
        return function(*(x + scale * width * d for x, d in zip(at, direction, strict=True)))

    near, far = ([value(sign * scale) for sign in (1, -1)] for scale in (1, 2))

    def slope(a, b, c, d):
        return (8 * (a - b) - (c - d)) / (12 * width)

    return jax.tree.map(slope, *near, *far)


def rounding_of(function, at, values) -> dict:
    """How far each number moves where the arguments move in their last digits: what rounding alone
    may change it by."""
    moved = [function(*(x * (1 + sign * 2 * np.finfo(float).eps) for x in at)) for sign in (-1, 1)]

    def size(x):
        return 3e-15 * np.linalg.norm(x)

    return {
        k: size(x) + max(np.linalg.norm(other[k] - x) for other in moved) for k, x in values.items()
    }


def check_forward(function, at, width: float = 3e-7) -> None:
    forward = jax.jit(lambda at, direction: jax.jvp(function, at, direction)[1])
    rounding = rounding_of(function, at, function(*at))
    for direction in directions(at):
        found = forward(at, direction)
        expected = differences(function, at, direction, width)
        for name, slope in found.items():
            assert np.isfinite(slope).all(), name
            error = np.linalg.norm(slope - expected[name])
            size = np.linalg.norm(slope)
            assert error <= 1e-5 * size + 4 * rounding[name] / width, (
                name,
                error,
                size,
                rounding[name] / width,
            )


@pytest.mark.slow
@pytest.mark.parametrize("name", [*FACTORED, *WITH_LOOPS])
def test_forward_derivatives_are_finite_and_those_of_differences(name):
    check_forward(*as_function(*{**FACTORED, **WITH_LOOPS}[name]))


# backwards is what JAX makes of forwards, but for the rules of factorisations and of loops: one of
# each
@pytest.mark.slow
@pytest.mark.parametrize("name", ["dense", "shared-lenses", "cg"])
def test_reverse_derivatives_are_finite_and_the_transposed_of_the_forward_ones(name):
    function, at = as_function(*FACTORED[name])
    rng = np.random.default_rng(1)
    weights = {
        k: jnp.asarray(rng.normal(size=x.shape) / (1 + np.abs(x).max()))
        for k, x in function(*at).items()
    }

    def total(*at):
        return sum(jnp.sum(weights[k] * x) for k, x in function(*at).items())

    gradient = jax.jit(jax.grad(total, argnums=(0, 1, 2, 3)))(*at)
    assert all(np.isfinite(x).all() for x in gradient)
    forward = jax.jit(lambda direction: jax.jvp(total, at, direction)[1])
    for direction in directions(at, seed=2):
        by_parts = [np.sum(g * d) for g, d in zip(gradient, direction, strict=True)]
        size = sum(
            np.linalg.norm(g) * np.linalg.norm(d) for g, d in zip(gradient, direction, strict=True)
        )
        assert abs(forward(direction) - sum(by_parts)) <= 1e-9 * size


# without LLVM's optimisation XLA's older emitters get a batch of derivatives wrong
@pytest.mark.fully_compiled
@pytest.mark.slow
def test_the_jacobian_is_made_of_forward_derivatives():
    function, at = as_function(*FACTORED["dense"])

    def cost(cameras):
        return function(cameras, *at[1:])["candidate_cost"]

    jacobian = jax.jacfwd(cost)(at[0])
    gradient = jax.grad(cost)(at[0])
    np.testing.assert_allclose(jacobian, gradient, rtol=1e-9, atol=1e-9 * np.abs(gradient).max())


@pytest.mark.slow
@pytest.mark.parametrize("loss", ["squared", "tukey"])
def test_nothing_is_nan_where_the_residuals_or_all_weights_are_zero(loss):
    """At zero residuals the step is zero, too; far beyond the scale of a loss most or all of the
    weights are."""
    problem = in_first_camera(support.tiny())
    exact = problem.replace(observations=geometry.project(problem))
    pixels = jnp.asarray(build_layout(exact, PLAIN).pixels)
    function, at = as_function(lambda: exact, StepOptions(loss=Loss(loss, 1.7)), own_size)

    @jax.jit
    def gradient(pixels):
        values, backwards = jax.vjp(function, *at[:2], pixels, at[3])
        return backwards(jax.tree.map(jnp.ones_like, values))

    for offset in (0.0, 1e4):
        assert all(np.isfinite(x).all() for x in gradient(pixels + offset))


def test_the_derivative_of_a_factor_reads_the_lower_triangle_alone():
    rng = np.random.default_rng(0)
    root = rng.normal(size=(3, 5, 5)) + 3 * np.eye(5)
    matrix = root @ root.transpose(0, 2, 1)
    change = rng.normal(size=matrix.shape)
    whole = np.tril(change) + np.tril(change, -1).transpose(0, 2, 1)
    found = jax.jvp(lower_cholesky, (jnp.asarray(np.tril(matrix)),), (jnp.asarray(change),))[1]
    expected = (
        np.linalg.cholesky(matrix + 1e-6 * whole) - np.linalg.cholesky(matrix - 1e-6 * whole)
    ) / 2e-6
    np.testing.assert_allclose(found, expected, atol=1e-7)
    backwards = jax.grad(lambda m: jnp.sum(lower_cholesky(m) ** 3))(jnp.asarray(matrix))
    assert (np.triu(backwards, 1) == 0).all()


def test_safe_operations_have_the_values_of_plain_ones():
    x = np.array([0.0, -0.0, 1.0, 2.5, 1e-300, np.inf, np.nan, -1.0])
    with np.errstate(all="ignore"):
        np.testing.assert_array_equal(safe_sqrt(jnp.asarray(x)), np.sqrt(np.abs(x) * np.sign(x)))
        for y in (0.0, 2.0, -0.0, np.inf):
            np.testing.assert_array_equal(safe_divide(jnp.asarray(x), jnp.asarray(y)), x / y)
    assert jax.grad(safe_sqrt)(0.0) == 0
    assert jax.grad(safe_divide, argnums=(0, 1))(1.0, 0.0) == (0, 0)
