"""Types of arithmetic end at the same cost, and ways of forming one system give the same step."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import support
from support import solve

from jaxba import StepOptions, build_layout, initial_state, lm_step, random_scene, scene_like
from jaxba.problem import geometry
from jaxba.structure.segment_sums import total


@pytest.mark.slow
@pytest.mark.parametrize(
    ("linear_solver", "dtype", "gap"),
    [("explicit", "mixed", 1e-6), ("implicit", "float32", 1e-4)],
)
def test_every_type_ends_at_the_cost_of_float64(linear_solver, dtype, gap):
    problem = random_scene(
        replace(scene_like("random-150"), cameras=12, points=300, observations=1300), 3
    )
    exact, rough = (
        solve(problem, linear_solver=linear_solver, dtype=name) for name in ("float64", dtype)
    )
    assert exact.converged
    assert rough.converged
    assert exact.initial_cost > 2 * exact.final_cost
    assert geometry.cost(rough.problem) == pytest.approx(exact.final_cost, rel=gap)


@pytest.mark.slow
def test_one_dense_product_and_chosen_pairs_make_the_same_step():
    problem = support.tiny()
    steps = []
    for grid in (True, False):
        layout = jax.tree.map(jnp.asarray, build_layout(problem, grid=grid))
        assert (layout.pairs is None) == grid
        state = initial_state(layout, problem, StepOptions())
        steps.append(lm_step(layout, state, jnp.asarray(1e-3), StepOptions())[0])
    one, other = steps
    np.testing.assert_allclose(one.cameras, other.cameras, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(one.points, other.points, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(one.cost, other.cost, rtol=1e-9)


@pytest.mark.slow
def test_a_mixed_step_is_the_full_one_up_to_its_forcing_term():
    problem = support.tiny()
    layout = jax.tree.map(jnp.asarray, build_layout(problem))
    state = initial_state(layout, problem, StepOptions())
    full, _ = lm_step(layout, state, jnp.asarray(1e-2), StepOptions())
    mixed, info = lm_step(layout, state, jnp.asarray(1e-2), StepOptions(mixed_precision=True))
    moved = np.linalg.norm(np.asarray(full.cameras - state.cameras))
    assert np.linalg.norm(np.asarray(mixed.cameras - full.cameras)) < 1e-3 * moved
    assert mixed.cameras.dtype == jnp.float64
    assert 1 <= int(info.cg_iterations) <= 5


def test_a_total_in_float32_keeps_what_a_running_sum_would_lose():
    values = jnp.asarray(np.random.default_rng(0).uniform(size=1_000_003), jnp.float32)
    exact = np.sum(np.asarray(values, np.float64))
    assert abs(float(total(values)) / exact - 1) < 1e-6
    assert float(total(jnp.arange(10.0))) == 45.0
    assert float(total(jnp.zeros(0))) == 0.0
