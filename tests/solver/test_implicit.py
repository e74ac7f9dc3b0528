"""Derivatives of a solution are those of differences of solutions."""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxba
from jaxba import ProblemError, SceneConfig, SolveOptions, Tolerances, differentiable_solve, inputs_of
from jaxba.problem import geometry

TIGHT = SolveOptions(tolerances=Tolerances(ftol=1e-15, xtol=1e-15, gtol=1e-13), max_iterations=300)


def scene() -> jaxba.BundleProblem:
    config = SceneConfig(cameras=6, points=40, mean_track=5.0, trajectory="orbit", max_depth=10.0)
    return jaxba.random_scene(config, seed=0)


def constrained() -> jaxba.BundleProblem:
    """One lens for all, a constant pose, a constant point and number, and measured positions of four cameras."""
    plain, rng = scene(), np.random.default_rng(0)
    cameras = np.array(plain.cameras)
    cameras[:, 6:] = cameras[0, 6:]
    lenses = jaxba.Lenses(np.zeros(6, np.int32), np.ones((1, 3), bool))
    problem = jaxba.hold(plain.replace(cameras=cameras, lenses=lenses), poses=[0], points=[3], numbers=["k2"])
    places = geometry.camera_centers(cameras)[1:5] + 0.05 * rng.normal(size=(4, 3))
    return jaxba.with_position_priors(problem, places, 0.01 * np.eye(3), images=[1, 2, 3, 4], align=False)


@pytest.mark.slow
@pytest.mark.parametrize("linear_solver", ["explicit", "implicit"])
def test_derivatives_by_observations_priors_and_constants_are_those_of_differences(linear_solver):
    problem, rng = constrained(), np.random.default_rng(1)
    inputs = jax.tree.map(jnp.asarray, inputs_of(problem))
    weights = rng.normal(size=problem.cameras.shape) * [1, 1, 1, 1, 1, 1, 1e-3, 1, 1], rng.normal(size=(40, 3))

    def value(linear_solver: str, inputs) -> jax.Array:
        options = dataclasses.replace(TIGHT, linear_solver=linear_solver)
        cameras, points = differentiable_solve(problem, "ceres", options)(inputs)
        return jnp.sum(weights[0] * cameras) + jnp.sum(weights[1] * points)

    found = jax.grad(functools.partial(value, linear_solver))(inputs)
    steps = {
        "observations": inputs.observations.at[7, 1].add(1.0) - inputs.observations,
        "positions": inputs.positions.at[2, 1].add(1.0) - inputs.positions,
        "cameras": jnp.zeros_like(inputs.cameras).at[0, 4].set(1.0).at[:, 8].set(0.3),  # k2 is one number of all
        "points": jnp.zeros_like(inputs.points).at[3, 0].set(1.0),
    }
    for name, change in steps.items():
        start = getattr(inputs, name)
        ends = [value("explicit", inputs._replace(**{name: start + step * change})) for step in (1e-3, -1e-3)]
        wanted = float(ends[0] - ends[1]) / 2e-3
        np.testing.assert_allclose(float(jnp.sum(getattr(found, name) * change)), wanted, rtol=5e-3)
    # what is not constant is only where the solve begins
    assert float(found.cameras[3, 0]) == 0
    assert float(found.points[5, 1]) == 0


@pytest.mark.slow
def test_a_value_that_depends_on_a_free_gauge_has_no_derivative():
    problem = scene()
    find = differentiable_solve(problem, "ceres", TIGHT)
    inputs = jax.tree.map(jnp.asarray, inputs_of(problem))
    with pytest.raises(ProblemError, match="the solution is not determined well enough for derivatives"):
        jax.grad(lambda inputs: find(inputs)[0][2, 3])(inputs)
