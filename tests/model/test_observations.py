"""Sums over each point's observations: the same as sums of dense Jacobians, in one loop or compiled
fast."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import support
from support import published_loss, start

from jaxba import BundleProblem, Loss, StepOptions, build_layout, initial_state
from jaxba.model.linearize import point_terms, slot_frames
from jaxba.model.observations import point_passes
from jaxba.refinement.points import refine_points
from jaxba.runtime.fusion import fast_compilation
from jaxba.structure.layout import Layout
from jaxba.structure.padding import capacity_of

pytestmark = pytest.mark.step


def two_tracks() -> BundleProblem:
    """`tiny` cut down to tracks of different lengths, so that its layout has several buckets."""
    whole = support.whitened()
    turn = np.zeros(whole.num_observations, int)
    for point in range(whole.num_points):
        own = np.flatnonzero(whole.point_index == point)
        turn[own] = np.arange(len(own))
    kept = turn < np.array([1, 2, 6])[whole.point_index % 3]
    return replace(
        whole,
        observations=whole.observations[kept],
        camera_index=whole.camera_index[kept],
        point_index=whole.point_index[kept],
        whitening=np.asarray(whole.whitening)[kept],
    )


def sums(
    layout: Layout, problem: BundleProblem, loss: Loss, fast: bool, dtype: str = "float64"
) -> np.ndarray:
    """The eleven sums that point iterations need, as [sum, point of the problem]."""

    def found(layout, problem):
        state = initial_state(layout, problem, StepOptions(loss=loss), jnp.dtype(dtype))
        one_pass = point_passes(layout, slot_frames(layout, state.cameras))
        return jnp.stack(one_pass(state.points, lambda views: point_terms(views, loss)))

    columns = np.asarray(layout.points)
    real = columns < problem.num_points
    with fast_compilation(fast):
        values = np.asarray(jax.jit(found)(layout, problem))
    result = np.zeros((len(values), problem.num_points))
    result[:, columns[real]] = values[:, : len(columns)][:, real]
    return result


def dense_sums(problem: BundleProblem, loss: Loss) -> np.ndarray:
    """The same but the last, by matrices."""
    residual, jacobian = support.linear(problem, StepOptions(loss=loss))
    by_point = jacobian[:, problem.cameras.size :]
    hessian = by_point.T @ by_point
    gradient = by_point.T @ residual
    first = 3 * np.arange(problem.num_points)
    entries = [hessian[first + i, first + j] for i in range(3) for j in range(i + 1)]
    unweighted = support.linear(problem, StepOptions())[0].reshape(-1, 2)
    costs = 0.5 * published_loss(loss.rho, loss.scale, np.sum(unweighted**2, axis=1))[0]
    cost = np.bincount(problem.point_index, costs, minlength=problem.num_points)
    return np.stack([*entries, *(gradient[first + i] for i in range(3)), cost])


@pytest.mark.parametrize(
    ("loss", "fast"),
    [(Loss(), True), (Loss("huber", 2.0), False)],
    ids=["squared, fast compilation", "huber, one loop"],
)
@pytest.mark.parametrize("make", [two_tracks, support.odd, support.single])
def test_sums_of_a_pass_are_those_of_dense_jacobians(make, loss, fast):
    problem = make()
    layout = build_layout(problem)
    truth = dense_sums(problem, loss)
    found = sums(layout, problem, loss, fast)[:10]
    scale = np.abs(truth).max(axis=0) + 1e-300
    np.testing.assert_allclose(found / scale, truth / scale, rtol=0, atol=1e-12)


def test_a_padded_layout_gives_the_same_sums():
    problem = two_tracks()
    truth = dense_sums(problem, Loss())
    layout = build_layout(problem, capacity=capacity_of(problem))
    assert layout.point_levels is not None
    scale = np.abs(truth).max(axis=0) + 1e-300
    np.testing.assert_allclose(
        sums(layout, problem, Loss(), False)[:10] / scale, truth / scale, rtol=0, atol=1e-12
    )


def test_the_problem_of_these_tests_has_several_buckets():
    assert len(build_layout(two_tracks()).buckets) > 1


@pytest.mark.parametrize("fast", [False, True], ids=["one loop", "fast compilation"])
def test_a_pass_in_float32_loses_no_more_than_rounding(fast):
    problem = two_tracks()
    layout = build_layout(problem)
    exact, found = (
        sums(layout, problem, Loss(), fast, dtype)[:10] for dtype in ("float64", "float32")
    )
    # the cost and the gradient are sums of terms with residuals, which are differences of pixels
    scale = np.abs(exact).max(axis=0)
    assert (np.abs(found - exact)[:, scale > 0] / scale[scale > 0]).max() < 1e-3


@pytest.mark.slow
def test_vectors_over_slots_reach_the_slots_they_belong_to():
    problem = two_tracks()
    layout, state = start(problem)
    numbers = np.where(layout.slot_mask, np.arange(layout.num_slots, dtype=float), 0.0)
    truth = np.bincount(np.asarray(layout.slot_point), numbers, minlength=layout.num_points)

    for fast in (True, False):
        with fast_compilation(fast):
            one_pass = point_passes(layout, slot_frames(layout, state.cameras))
            found = one_pass(state.points, lambda views, number: [number], jnp.asarray(numbers))[0]
        np.testing.assert_array_equal(found, truth)


@pytest.mark.parametrize("loss", [Loss(), Loss("huber", 2.0)], ids=["squared", "huber"])
def test_point_iterations_are_the_same_in_fast_compilation(loss):
    problem = two_tracks()
    layout, state = start(problem)

    def found(fast: bool):
        with fast_compilation(fast):
            frames = slot_frames(layout, state.cameras)
            return jax.jit(
                lambda layout, points: refine_points(layout, state.cameras, frames, points, loss, 3)
            )(layout, state.points)

    (points, costs) = found(False)
    (stored_points, stored_costs) = found(True)
    np.testing.assert_allclose(points, stored_points, rtol=1e-7, atol=1e-7)
    np.testing.assert_allclose(costs, stored_costs, rtol=1e-9, atol=1e-12)


@pytest.mark.slow
def test_many_scenes_at_once_get_what_each_gets_alone():
    problems = [support.paper(seed) for seed in range(3)]
    layouts = [build_layout(problem) for problem in problems]

    def found(layout, problem):
        state = initial_state(layout, problem, StepOptions(), jnp.float64)
        one_pass = point_passes(layout, slot_frames(layout, state.cameras))
        return jnp.stack(one_pass(state.points, lambda views: point_terms(views, Loss())))

    def stack(trees):
        return jax.tree.map(
            lambda *leaves: jnp.stack([jnp.asarray(leaf) for leaf in leaves]), *trees
        )

    together = jax.jit(jax.vmap(found))(stack(layouts), stack(problems))
    one = jax.jit(found)
    alone = [one(layout, problem) for layout, problem in zip(layouts, problems, strict=True)]
    np.testing.assert_allclose(together, jnp.stack(alone), rtol=1e-11, atol=1e-11)
