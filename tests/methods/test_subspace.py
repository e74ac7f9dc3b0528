"""Steps of earlier iterations: against textbook conjugate gradients and dense algebra, and which ones a solve keeps."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import support
from support import solve, start, step
from textbook_cg import PRECONDITIONERS, SIZE, by_hand, right, spd

from jaxba import LMState, StepOptions, make_method, make_policy, random_scene, rotations
from jaxba.methods.deeplm import GlobalConjugateGradients
from jaxba.methods.poba import PowerSeries
from jaxba.methods.subspace import on_manifold, with_previous
from jaxba.problem.options import ConjugateGradients, Refinement
from jaxba.scenes import SceneConfig

CUT_SHORT = GlobalConjugateGradients(ConjugateGradients(forcing=0.0, max_iterations=20))
SERIES = StepOptions(method=PowerSeries(order=3), refinement=Refinement(previous_steps=2))

combine = jax.jit(
    lambda matrix, b, found, before: with_previous(
        lambda x: (matrix @ x.reshape(-1)).reshape(x.shape), b, found, before
    )
)


@pytest.mark.parametrize("kind", list(PRECONDITIONERS))
def test_a_fixed_solver_and_one_previous_step_are_conjugate_gradients(kind):
    """Newton's iteration on one quadratic: each step a solver's, made the best one together with the last."""
    matrix, b = spd(1e3), right()
    inverse = PRECONDITIONERS[kind](matrix)
    x, before = np.zeros_like(b), np.zeros((1, *b.shape))
    for expected in by_hand(matrix, b, inverse, 8):
        rest = b - (matrix @ x.ravel()).reshape(b.shape)
        made = np.asarray(combine(matrix, rest, (inverse @ rest.ravel()).reshape(b.shape), before))
        x, before = x + made, made[None]
        np.testing.assert_allclose(x.ravel(), expected, rtol=1e-7, atol=1e-10)


@pytest.mark.parametrize("count", [0, 1, 4])
def test_it_is_the_minimum_over_the_span(count):
    """Against a dense solution in an orthonormal basis; what is left of the system is orthogonal to the span."""
    matrix, b, rng = spd(1e4), right(), np.random.default_rng(count)
    found, before = rng.normal(size=b.shape), rng.normal(size=(count, *b.shape))
    basis = np.linalg.qr(np.stack([found, *before]).reshape(count + 1, SIZE).T)[0]
    expected = basis @ np.linalg.solve(basis.T @ matrix @ basis, basis.T @ b.ravel())
    made = np.asarray(combine(matrix, b, found, before)).ravel()
    np.testing.assert_allclose(made, expected, rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(basis.T @ (b.ravel() - matrix @ made), 0, atol=1e-10)


def test_missing_previous_steps_and_parallel_ones_change_nothing():
    matrix, b = spd(1e2), right()
    found = np.random.default_rng(0).normal(size=b.shape)
    alone = combine(matrix, b, found, np.zeros((0, *b.shape)))
    for before in (np.zeros((2, *b.shape)), -3 * found[None]):
        np.testing.assert_allclose(combine(matrix, b, found, before), alone, rtol=1e-9, atol=1e-12)


def test_a_failed_solver_stays_visible():
    matrix, b = spd(1e2), right()
    before = np.random.default_rng(0).normal(size=(1, *b.shape))
    assert not np.isfinite(combine(matrix, b, np.full_like(b, np.nan), before)).any()


def test_changes_of_the_file_are_turned_to_the_manifold():
    """The rotation that a change of the angle-axis vector makes, by finite differences."""
    cameras = np.asarray(support.tiny().cameras).T
    change = np.random.default_rng(1).normal(size=(2, *cameras.shape))
    turned = np.asarray(on_manifold(jnp.asarray(cameras), jnp.asarray(change)))
    small = 1e-6
    for k in range(2):
        moved = rotations.compose_left(jnp.asarray(small * turned[k, :, :3].T), jnp.asarray(cameras[:3]))
        np.testing.assert_allclose((np.asarray(moved) - cameras[:3]) / small, change[k, :3], rtol=1e-4, atol=1e-5)
        np.testing.assert_array_equal(turned[k, :, 3:], change[k, 3:].T)


def test_accepted_changes_of_the_cameras_are_kept_and_refused_ones_are_not():
    problem = support.tiny()
    layout, first = start(problem, SERIES)
    np.testing.assert_array_equal(first.method_state, np.zeros((2, *first.cameras.shape)))
    second, info = step(layout, first, 1e-2, SERIES)
    assert info.accepted
    np.testing.assert_array_equal(second.method_state[0], second.cameras - first.cameras)
    third, info = step(layout, second, 1e-3, SERIES)
    assert info.accepted
    np.testing.assert_array_equal(third.method_state, [third.cameras - second.cameras, second.method_state[0]])
    same, info = step(layout, third, 1e-3, SERIES, 1e9)
    assert not info.accepted
    np.testing.assert_array_equal(same.method_state, third.method_state)


def test_a_step_with_previous_ones_predicts_what_its_own_linear_model_says():
    problem, damping = support.tiny(), 1e-2
    layout, first = start(problem, SERIES)
    before, _ = step(layout, first, 1e-2, SERIES)
    after, info = step(layout, before, damping, SERIES, -1e9)
    assert info.accepted
    there = support.back(problem, first, before)
    made = support.difference(there, support.back(there, before, after), SERIES)
    dense = replace(support.dense(there, SERIES, damping), step=made)
    np.testing.assert_allclose(info.predicted, dense.predicted, rtol=1e-9)
    assert np.linalg.norm(made - support.dense(there, SERIES, damping).step) > 1e-4 * np.linalg.norm(made)


@pytest.mark.parametrize(
    "options",
    [{}, {"linear_solver": "implicit"}, {"method": make_method("stba")}],
    ids=["explicit", "implicit", "stba"],
)
def test_other_solvers_keep_no_steps(options):
    _, state = start(support.tiny(), StepOptions(**options, refinement=Refinement(previous_steps=1)))
    assert isinstance(state, LMState)
    assert state.method_state == ()


@pytest.mark.slow
@pytest.mark.parametrize("method", [PowerSeries(), CUT_SHORT], ids=["poba", "deeplm"])
def test_a_solver_that_keeps_a_step_converges_where_it_crawls_without(method):
    """A sequence of thirty cameras under Ceres' rule, conjugate gradients cut short; to the end of plain LM."""
    problem, ceres = random_scene(SceneConfig(30, 400, 1600), 0), make_policy("ceres")
    best = solve(problem, ceres, StepOptions(refinement=Refinement(points=3))).final_cost
    kept = lambda count: StepOptions(method=method, refinement=Refinement(points=3, previous_steps=count))
    crawling, found = (solve(problem, ceres, kept(count)) for count in (0, 1))
    assert crawling.final_cost > best * (1 + 1e-3)
    assert found.termination.converged
    assert found.final_cost < best * (1 + 1e-4)
    assert found.iterations < 0.7 * crawling.iterations
