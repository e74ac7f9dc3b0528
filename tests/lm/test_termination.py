"""When a small decrease means that a minimum is near, and when only that lambda was large."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import support
from hypothesis import given, settings
from hypothesis import strategies as st
from support import solve, step_info

from jaxba import SceneConfig, Termination, Tolerances, random_scene
from jaxba.lm.termination import (
    LEAST_LEFT,
    MAX_UNDAMPED_RATIO,
    converged_in_cost,
    distance_to_end,
    lost_in_rounding,
    termination_of,
)
from jaxba.problem import geometry

LIMIT = 30


def quadratic_step(curvature: float, damping: float, gradient: float):
    """Decrease, undamped decrease, and damping's share of one step on `h x^2 / 2 + g x`."""
    move = -gradient / (curvature + damping)
    decrease = -(gradient * move + 0.5 * curvature * move**2)
    share = damping * move**2 / ((curvature + damping) * move**2)
    return decrease, gradient**2 / (2 * curvature), share


positive = st.floats(1e-3, 1e3)


@settings(deadline=None)
@given(positive, st.floats(1e-6, 1e3), positive)
def test_the_undamped_decrease_is_told_exactly_on_a_parabola(curvature, damping, gradient):
    decrease, undamped, share = quadratic_step(curvature, damping, gradient)
    np.testing.assert_allclose(decrease / (1 - share**2), undamped, rtol=1e-9)


@settings(deadline=None)
@given(positive, st.floats(1e-6, 1e5), positive, st.floats(-9, -3), st.floats(-4, 4))
def test_on_a_parabola_it_ends_where_the_undamped_decrease_is_small(
    curvature, damping, gradient, digits, over
):
    """`over`: decades by which the cost times ftol exceeds the decrease."""
    decrease, undamped, share = quadratic_step(curvature, damping, gradient)
    ftol = 10.0**digits
    cost = decrease / ftol * 10.0**over
    for edge in (decrease / (ftol * cost), undamped / (MAX_UNDAMPED_RATIO * ftol * cost)):
        if abs(edge - 1) < 1e-4:
            return  # rounding decides
    # no cost is negative, nor is a decrease below its last digits
    if cost - decrease <= 0 or decrease < 1e-11 * cost:
        return
    info = step_info(True, cost=cost - decrease, previous_cost=cost, damping_fraction=share)
    expected = decrease <= ftol * cost and undamped <= MAX_UNDAMPED_RATIO * ftol * cost
    assert bool(converged_in_cost(info, ftol)) == expected


@settings(deadline=None)
@given(positive, st.floats(1e-6, 1e5), positive, st.floats(1e-9, 1e9))
def test_the_estimated_distance_to_the_end_is_not_too_small_on_a_parabola(
    curvature, damping, gradient, end
):
    """`end` is the cost at the minimum."""
    decrease, undamped, share = quadratic_step(curvature, damping, gradient)
    before = end + undamped
    after = end + undamped - decrease
    if decrease < 1e-9 * before or share > 1 - 1e-9:
        return  # rounding decides
    info = step_info(True, cost=after, previous_cost=before, damping_fraction=share)
    assert float(distance_to_end(info)) >= (after - end) / after * (1 - 1e-6)


def test_of_what_comes_after_a_rejected_or_shortened_step_nothing_is_known():
    assert not np.isfinite(distance_to_end(step_info(False, cost=1.0, previous_cost=1.0)))
    assert not np.isfinite(distance_to_end(step_info(True, step_fraction=0.25)))
    assert distance_to_end(step_info(True, cost=1.0, previous_cost=2.0)) == LEAST_LEFT
    steps = step_info(
        True, cost=1.0, previous_cost=2.0, damping_fraction=np.array([1e-9, 1e-4, 1e-2, 0.5])
    )
    assert (np.diff(distance_to_end(steps)[1:]) > 0).all()


@pytest.mark.parametrize("rule", ["nielsen", "ceres"])
def test_a_solve_ends_as_near_to_its_end_as_asked_for(rule):
    scene = random_scene(SceneConfig(cameras=20, points=150), 0)
    whole = solve(scene, rule)
    for within in (1e-1, 1e-3):
        found = solve(scene, rule, within=within)
        assert found.termination == Termination.WITHIN
        assert found.converged
        assert found.iterations < whole.iterations
        assert found.final_cost <= whole.final_cost * (1 + within)
        assert found.distance <= within
    assert solve(scene, rule, within=1e-30).iterations == whole.iterations
    with pytest.raises(ValueError, match="within must not be negative"):
        solve(scene, rule, within=-1.0)


def test_a_rejected_step_never_ends_a_solve_as_converged():
    info = step_info(False, cost=1.0, previous_cost=1.0, step_norm=0.0, damping_fraction=0.0)
    assert not converged_in_cost(info, 1e-6)
    code = termination_of(info, jnp.asarray(False), jnp.asarray(3, jnp.int32), Tolerances(), 100)
    assert int(code) == Termination.RUNNING


@pytest.mark.parametrize(
    ("share", "ends"), [(0.0, True), (0.9, True), (0.999999, False), (1.0, False)]
)
def test_the_same_small_decrease_ends_a_solve_or_not_by_what_made_it_small(share, ends):
    info = step_info(True, cost=1 - 5e-7, previous_cost=1.0, damping_fraction=share)
    assert bool(converged_in_cost(info, 1e-6)) == ends


def test_no_decrease_at_all_is_convergence_whatever_lambda_was():
    """Then the undamped step promises nothing either; without this a solve at the exact minimum
    would never end."""
    assert converged_in_cost(
        step_info(True, cost=1.0, previous_cost=1.0, damping_fraction=0.999), 1e-6
    )


def single(**fields):
    """A refused step in float32."""
    info = step_info(
        False,
        **{"cost": 1.0, "previous_cost": 1.0, "predicted": 5e-7, "damping_fraction": 0.0} | fields,
    )
    return jax.tree.map(lambda x: x.astype(jnp.float32) if x.dtype == jnp.float64 else x, info)


def test_in_float32_a_refused_step_ends_a_solve_if_its_promise_is_below_rounding():
    info = single()
    assert lost_in_rounding(info)
    code = termination_of(
        info, jnp.asarray(False), jnp.asarray(3, jnp.int32), Tolerances(ftol=1e-12), 100
    )
    assert int(code) == Termination.ROUNDING


@pytest.mark.parametrize(
    "fields",
    [
        {"predicted": 5e-6},  # more than rounding
        {"damping_fraction": 1 - 1e-6},  # little only for its damping
        {"step_fraction": 0.25},  # or for having been shortened
        {"predicted": np.nan},  # a factorisation failed
        {"predicted": -1.0},  # or was of no use
        {"step_norm": np.nan},  # a peer refused it, and does not tell more
        {"accepted": True},  # then `ftol` decides
    ],
)
def test_no_other_step_in_float32_ends_a_solve_by_that_rule(fields):
    info = single(**{k: v for k, v in fields.items() if k != "accepted"})
    if "accepted" in fields:
        info = info._replace(accepted=jnp.asarray(True))
    assert not lost_in_rounding(info)


def test_in_float64_the_same_promise_can_be_judged():
    info = step_info(False, cost=1.0, previous_cost=1.0, predicted=5e-7, damping_fraction=0.0)
    assert not lost_in_rounding(info)
    assert lost_in_rounding(info._replace(predicted=jnp.asarray(1e-15)))


def test_a_solve_in_float32_asked_for_more_digits_than_it_has_ends_as_converged_at_the_minimum():
    exact = solve(support.tiny(), "ceres", tolerances=Tolerances(ftol=1e-12))
    rough = solve(
        support.tiny(),
        "ceres",
        dtype="float32",
        max_iterations=100,
        tolerances=Tolerances(ftol=1e-30, xtol=0.0, gtol=0.0),
    )
    assert rough.termination == Termination.ROUNDING
    assert geometry.cost(rough.problem) == pytest.approx(exact.final_cost, rel=1e-5)


def test_a_huge_lambda_does_not_feign_convergence_and_ceres_rule_converges():
    problem = support.tiny()
    ftol_alone = Tolerances(ftol=1e-5, xtol=0.0)
    stuck = solve(problem, "constant:1e6", max_iterations=LIMIT, tolerances=ftol_alone)
    costs = np.concatenate([[stuck.initial_cost], stuck.history.cost])
    assert stuck.accepted > 0
    # each alone would have ended it by the plain rule
    assert (-np.diff(costs) <= 1e-5 * costs[:-1]).all()
    assert stuck.termination == Termination.MAX_ITERATIONS
    fine = solve(problem, "ceres", max_iterations=LIMIT, tolerances=ftol_alone)
    assert fine.termination == Termination.COST
    assert fine.final_cost < 0.9 * stuck.final_cost


def test_nor_does_it_by_the_length_of_its_steps():
    stuck = solve(support.tiny(), "constant:1e6", max_iterations=LIMIT)
    assert stuck.termination == Termination.MAX_ITERATIONS


def test_near_the_minimum_a_small_undamped_step_ends_a_solve():
    problem = solve(support.tiny(), "ceres", max_iterations=LIMIT).problem
    again = solve(problem, "constant:1e-6", max_iterations=LIMIT)
    assert again.termination == Termination.COST
    assert again.iterations <= 2
    damped = solve(problem, "constant:1e6", max_iterations=LIMIT)
    np.testing.assert_allclose(damped.final_cost, again.final_cost, rtol=1e-6)
