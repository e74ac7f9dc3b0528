"""Loops of one's own: what `prepare` gives is what `lm_step` and `solve_loop` take, and they make
the same solve."""

from __future__ import annotations

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import support
from support import same_bits

import jaxba
from jaxba import SolveOptions, lm_step, prepare, solve_loop
from jaxba.problem.preprocess import FAR, shift

OPTIONS = SolveOptions(compilation="full", max_iterations=30)


def check_same(found: jaxba.BundleProblem, solution: jaxba.Solution) -> None:
    """The same end, to rounding."""
    np.testing.assert_allclose(found.cameras, solution.problem.cameras, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(found.points, solution.problem.points, rtol=1e-6, atol=1e-6)


@pytest.mark.slow
def test_a_loop_of_steps_written_by_hand_is_the_solve():
    """With the rule of `Classic`: lambda is halved after a step with a good gain, doubled after any
    other."""
    rule = jaxba.Classic(initial=0.01)
    solution = jaxba.solve(support.tiny(), rule, OPTIONS)
    prepared = prepare(support.tiny(), rule, OPTIONS)
    step = jax.jit(lm_step, static_argnames="options")
    state = prepared.state
    damping = 0.01
    costs = []
    for _ in range(solution.iterations):
        state, info = step(prepared.layout, state, jnp.asarray(damping), prepared.options)
        damping *= 0.5 if info.accepted and info.gain_ratio > rule.good_gain else 2.0
        costs.append(float(info.cost))
    np.testing.assert_allclose(costs, solution.history.cost, rtol=1e-9)
    check_same(prepared.problem_at(state), solution)


@pytest.mark.parametrize("policy", ["ceres", pytest.param("learned", marks=pytest.mark.slow)])
def test_the_compiled_loop_is_the_solve(policy):
    solution = jaxba.solve(support.tiny(), policy, OPTIONS)
    prepared = prepare(support.tiny(), policy, OPTIONS)
    carry, history = solve_loop(
        prepared.layout,
        prepared.state,
        prepared.policy,
        OPTIONS.tolerances,
        prepared.options,
        OPTIONS.max_iterations,
    )
    assert int(carry.iteration) == solution.iterations
    assert int(carry.termination) == solution.termination
    np.testing.assert_allclose(
        history.cost[: solution.iterations], solution.history.cost, rtol=1e-8
    )
    check_same(prepared.problem_at(carry.state), solution)


@pytest.mark.slow
def test_two_problems_of_equal_shape_are_solved_at_once():
    problems = [support.paper(seed) for seed in (0, 1)]
    prepared = [prepare(problem, "ceres", OPTIONS) for problem in problems]
    assert prepared[0].options == prepared[1].options
    layouts, states = (
        jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees)
        for trees in ([p.layout for p in prepared], [p.state for p in prepared])
    )

    def run(layout, state):
        policy = prepared[0].policy
        options = prepared[0].options
        return solve_loop(
            layout, state, policy, OPTIONS.tolerances, options, OPTIONS.max_iterations
        )

    carries, _ = jax.jit(jax.vmap(run))(layouts, states)
    for k, problem in enumerate(problems):
        solution = jaxba.solve(problem, "ceres", OPTIONS)
        assert int(carries.iteration[k]) == solution.iterations
        np.testing.assert_allclose(carries.state.cost[k], solution.final_cost, rtol=1e-9)
        check_same(
            prepared[k].problem_at(jax.tree.map(lambda leaf, k=k: leaf[k], carries.state)), solution
        )


def test_the_compiled_loop_is_traced_once_for_all_numbers_of_a_policy_and_of_the_stop_rules():
    static = ("options", "max_iterations")
    loop = jax.jit(chex.assert_max_traces(solve_loop.__wrapped__, n=1), static_argnames=static)
    for seed, first, ftol in ((0, 1e-4, 1e-6), (1, 1e-2, 1e-3)):
        prepared = prepare(support.paper(seed), f"ceres:{first}", OPTIONS)
        tolerances = jax.tree.map(jnp.asarray, OPTIONS.tolerances._replace(ftol=ftol))
        loop(
            prepared.layout,
            prepared.state,
            prepared.policy,
            tolerances,
            prepared.options,
            OPTIONS.max_iterations,
        )


@pytest.mark.parametrize(
    "make", [support.tiny, support.odd, support.whitened, lambda: support.paper(0)]
)
def test_the_start_comes_back_bit_by_bit(make):
    prepared = prepare(make(), "ceres")
    assert same_bits(prepared.problem_at(prepared.state), make())


def test_each_point_comes_back_to_its_own_place():
    problem = support.odd()
    prepared = prepare(problem, "ceres")
    moved = prepared.problem_at(prepared.state._replace(points=2 * prepared.state.points))
    seen = np.isin(np.arange(problem.num_points), problem.point_index)
    assert not seen.all()
    np.testing.assert_array_equal(moved.points[seen], 2 * problem.points[seen])
    np.testing.assert_array_equal(moved.points[~seen], problem.points[~seen])
    chex.assert_trees_all_equal(moved.replace(points=problem.points), problem, strict=True)


def test_a_scene_far_from_the_origin_is_prepared_near_it_and_comes_back_where_it_was():
    near = support.at_origin(support.tiny())
    far = shift(near, np.array([100 * FAR, 0.0, 0.0]))
    prepared = prepare(far, "ceres")
    assert np.abs(np.median(prepared.state.points, axis=1)).max() < 10
    np.testing.assert_allclose(prepared.problem_at(prepared.state).points, far.points, rtol=1e-12)


def test_a_padded_problem_comes_back_in_its_own_sizes():
    problem = support.tiny()
    prepared = prepare(problem, "ceres", SolveOptions(pad=True))
    assert prepared.state.cameras.shape[1] > problem.num_cameras
    chex.assert_trees_all_equal(prepared.problem_at(prepared.state), problem, strict=True)


def test_double_precision_without_64_bits_is_refused_in_one_line():
    prepared = prepare(support.tiny(), "ceres", OPTIONS)
    with (
        jax.enable_x64(False),
        pytest.raises(ValueError, match="float64 needs 64 bits in JAX: call jax") as caught,
    ):
        solve_loop(
            prepared.layout,
            prepared.state,
            prepared.policy,
            OPTIONS.tolerances,
            prepared.options,
            3,
        )
    assert "\n" not in str(caught.value)


def test_single_precision_is_prepared_as_such():
    prepared = prepare(support.tiny(), "ceres", SolveOptions(dtype="float32"))
    assert prepared.state.cost.dtype == prepared.state.cameras.dtype == jnp.float32
    assert prepared.problem_at(prepared.state).points.dtype == np.float64
