"""Damping rules against the formulas of their sources, and names."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support import step_info

from jaxba import (
    POLICIES,
    Ceres,
    Classic,
    DampingPolicy,
    Geometric,
    ProblemInfo,
    Schedule,
    make_policy,
)
from jaxba.damping.policy import trained_step
from jaxba.typing import InputError


def count(n):
    return jnp.asarray(n, jnp.int32)


def info(unit: float = 1.0, dtype=jnp.float64, observations: int = 100) -> ProblemInfo:
    return ProblemInfo(
        cost=jnp.asarray(1.0, dtype),
        observations=count(observations),
        cameras=count(4),
        points=count(30),
        unit=jnp.asarray(unit, dtype),
        focal=jnp.asarray(500.0, dtype),
        max_iterations=count(100),
    )


def lambdas(
    policy: DampingPolicy, steps: list[tuple[bool, float]], unit: float = 1.0
) -> list[float]:
    """First lambda, and the one after each (accepted, gain ratio)."""
    state, damping = policy.init(info(unit))
    found = [float(damping)]
    for accepted, gain in steps:
        state, damping = policy.propose(state, step_info(accepted, gain, damping))
        found.append(float(damping))
    return found


REJECTED = (False, -1.0)
gains = st.floats(1e-3, 1.5)
histories = st.lists(st.tuples(st.booleans(), gains), max_size=25).map(
    lambda steps: [(a, g if a else -g) for a, g in steps]
)


# Ceres


def test_ceres_divides_by_three_where_the_model_is_perfect_and_keeps_lambda_at_gain_one_half():
    np.testing.assert_allclose(lambdas(Ceres(), [(True, 1.0)]), [1e-4, 1e-4 / 3], rtol=1e-15)
    np.testing.assert_allclose(lambdas(Ceres(), [(True, 0.5)]), [1e-4, 1e-4], rtol=1e-15)
    np.testing.assert_allclose(lambdas(Ceres(), [(True, 7.0)]), [1e-4, 1e-4 / 3], rtol=1e-15)


@given(gains)
def test_ceres_radius_is_divided_by_the_published_factor(gain):
    """`R <- R / max(1/3, 1 - (2 rho - 1)^3)`, reference section 5.1."""
    radius = 1e4 / max(1 / 3, 1 - (2 * gain - 1) ** 3)
    np.testing.assert_allclose(lambdas(Ceres(), [(True, gain)])[1], 1 / radius, rtol=1e-13)


def test_ceres_grows_by_two_four_eight_and_starts_over_after_success():
    found = lambdas(Ceres(initial=1.0), [REJECTED] * 4 + [(True, 0.5)] + [REJECTED] * 2)
    np.testing.assert_allclose(found, [1, 2, 8, 64, 1024, 1024, 2048, 8192], rtol=1e-15)


@settings(max_examples=50, deadline=None)
@given(histories)
def test_ceres_follows_its_own_minimizer(steps):
    """The trust-region strategy written down once more, radius and all."""
    radius = 1e4
    factor = 2.0
    expected = [1e-4]
    for accepted, gain in steps:
        if accepted:
            radius = min(1e16, radius / max(1 / 3, 1 - (2 * gain - 1) ** 3))
            factor = 2.0
        else:
            radius = radius / factor
            factor = 2 * factor
        expected.append(min(1 / radius, 1e32))
        radius = max(radius, 1e-32)
    np.testing.assert_allclose(lambdas(Ceres(), steps), expected, rtol=1e-9)


def test_ceres_stays_within_its_bounds():
    assert lambdas(Ceres(), [(True, 1.0)] * 60)[-1] == 1e-16
    assert lambdas(Ceres(), [REJECTED] * 40)[-1] == 1e32
    assert Ceres().min_gain == 1e-3


def test_a_gain_that_is_not_a_number_is_a_rejection_like_any_other():
    assert lambdas(Ceres(initial=1.0), [(False, np.nan)] * 2) == [1, 2, 8]
    assert lambdas(Classic(initial=1.0), [(False, np.nan)] * 2) == [1, 2, 4]


# The others


def test_classic_halves_after_a_good_step_and_doubles_after_any_other():
    steps = [
        (True, 1.0),
        (True, 0.41),
        (True, 0.4),
        (True, 0.1),
        REJECTED,
        (False, 0.9),
        (True, 5.0),
    ]
    assert lambdas(Classic(), steps) == [0.25, 0.125, 0.0625, 0.125, 0.25, 0.5, 1.0, 0.5]
    assert Classic().min_gain == 0


def test_gtsam_goes_by_tens_within_its_bounds():
    found = lambdas(make_policy("gtsam"), [(True, 0.01), REJECTED, REJECTED])
    np.testing.assert_allclose(found, [1e-5, 1e-6, 1e-5, 1e-4], rtol=1e-14)
    assert lambdas(make_policy("gtsam"), [REJECTED] * 20)[-1] == 1e5


def test_nielsen_always_shrinks_after_success():
    rule = make_policy("nielsen")
    np.testing.assert_allclose(lambdas(rule, [(True, 1.0)])[1] / 1e-5, 1 / 3, rtol=1e-14)
    np.testing.assert_allclose(lambdas(rule, [(True, 0.5)])[1] / 1e-5, 2 / 3, rtol=1e-14)
    np.testing.assert_allclose(lambdas(rule, [(True, 1e-6)])[1] / 1e-5, 2 / 3, rtol=1e-14)
    np.testing.assert_allclose(lambdas(rule, [(True, 0.9)])[1] / 1e-5, 1 - 0.8**3, rtol=1e-14)
    np.testing.assert_allclose(lambdas(rule, [REJECTED] * 3)[1:], [2e-5, 8e-5, 64e-5], rtol=1e-14)


def test_nielsen_starts_in_units_of_the_largest_hessian_entry():
    np.testing.assert_allclose(lambdas(make_policy("nielsen"), [], unit=4e7), [4e2], rtol=1e-14)
    np.testing.assert_allclose(lambdas(make_policy("ceres"), [], unit=4e7), [1e-4], rtol=1e-14)


def test_stba_goes_by_threes_and_theseus_by_nine_and_eleven():
    steps = [(True, 0.01), REJECTED, REJECTED]
    np.testing.assert_allclose(
        lambdas(make_policy("stba"), steps), 1e-4 * np.array([1, 1 / 3, 1, 3]), rtol=1e-14
    )
    np.testing.assert_allclose(
        lambdas(make_policy("theseus"), steps),
        1e-3 * np.array([1, 1 / 9, 11 / 9, 121 / 9]),
        rtol=1e-14,
    )
    assert make_policy("theseus").min_gain == 0.1
    assert lambdas(make_policy("theseus"), [(True, 1.0)] * 9)[-1] == 1e-7
    assert lambdas(make_policy("theseus"), [REJECTED] * 12)[-1] == 1e7


def test_the_schedule_goes_round_whatever_happens():
    cycle = [1e-15, 1e-15, 0.194, 0.551]
    assert lambdas(make_policy("schedule"), [(True, 1.0), REJECTED] * 5) == (cycle * 3)[:11]


@given(st.floats(1e-12, 1e3), histories)
@settings(max_examples=20, deadline=None)
def test_a_constant_is_constant(value, steps):
    assert set(lambdas(make_policy(f"constant:{value!r}"), steps)) == {value}


def test_gauss_newton_is_next_to_no_damping():
    assert lambdas(make_policy("gauss-newton"), [(True, 1.0), REJECTED]) == [1e-10] * 3


def played(policy: DampingPolicy, *steps: dict, observations: int = 100) -> list[float]:
    """log10 of the first lambda, and of the one after each accepted step of full length with these
    changes."""
    state, damping = policy.init(info(observations=observations))
    found = [float(jnp.log10(damping))]
    for changes in steps:
        step = step_info(**{"accepted": True, "gain": 0.8, "damping": damping, **changes})
        state, damping = policy.propose(state, step)
        found.append(float(jnp.log10(damping)))
    return found


def test_guarded_starts_at_its_least_lambda_and_rises_half_a_decade_for_each_failure():
    full = {}
    rejected = {"accepted": False, "gain": -1.0}
    shortened = {"step_fraction": 1 / 16}
    inexact = {"forcing": 0.1, "damping_fraction": 9e-3}
    pattern = {"step_fraction": 2.0}
    found = played(make_policy("guarded"), full, rejected, full, shortened, inexact, pattern, full)
    np.testing.assert_allclose(found, [-6, -8, -7.5, -8, -7, -7, -8, -8], atol=1e-12)
    above = played(
        make_policy("guarded:1e-5"), full, rejected, full, shortened, inexact, pattern, full
    )
    np.testing.assert_allclose(above, [-5, *found[1:]], atol=1e-12)
    twice = played(make_policy("guarded"), shortened, shortened, rejected, full)
    np.testing.assert_allclose(twice, [-6, -5, -4, -3.5, -8], atol=1e-12)


def test_guarded_goes_to_a_smaller_lambda_where_there_are_no_pixels():
    rejected = {"accepted": False, "gain": -1.0}
    chosen = played(make_policy("guarded"), {}, rejected, {}, observations=0)
    np.testing.assert_allclose(chosen, [-6, -12, -11.5, -12], atol=1e-12)


def test_guarded_gives_way_to_ceres_rule_after_two_rejections_in_a_row_or_eight_in_all():
    rejected = {"accepted": False, "gain": np.nan}
    perfect = {"gain": 1.0}
    third = np.log10(1 / 3)
    two = np.log10(2)
    found = played(make_policy("guarded"), rejected, rejected, perfect, rejected, rejected, perfect)
    # begins again where the last accepted step was, if no larger one failed
    ceres = -4 + np.cumsum([0, third, two])
    np.testing.assert_allclose(
        found, [-6, -5.5, *ceres, -4 + third + 3 * two, -4 + 2 * third + 3 * two], atol=1e-12
    )
    worked = played(
        make_policy("guarded"), {"damping": 1e-2}, {"damping": 1e-7, **rejected}, {**rejected}
    )
    np.testing.assert_allclose(worked[-1], -2, atol=1e-12)
    found = played(make_policy("guarded"), *[rejected, perfect] * 8)
    # never less
    np.testing.assert_allclose(found, [-6, -5.5, *[-8, -7.5] * 6, -8, -8 + two, -8], atol=1e-12)


def test_guarded_has_the_step_of_the_agents():
    assert trained_step(make_policy("guarded")) == trained_step(make_policy("bold"))
    assert make_policy("guarded").min_gain == make_policy("bold").min_gain == 0.25


# Pytrees


ALL = {
    "ceres": lambda x: Ceres(initial=x),
    "classic": lambda x: Classic(initial=x),
    "geometric": lambda x: Geometric(x, 0.5, 2.0, 0.0, 1e9 * x),
    "schedule": lambda x: Schedule(values=(x, 2 * x)),
}


@pytest.mark.parametrize("kind", list(ALL))
def test_the_constants_of_a_policy_are_traced_and_never_recompile(kind):
    traces = []

    @jax.jit
    def two_rounds(policy, step):
        traces.append(1)
        state, first = policy.init(info())
        state, second = policy.propose(state, step)
        return first, second, policy.propose(state, step._replace(damping=second))[1]

    for value in (0.1, 0.25, 0.7):
        found = [float(x) for x in two_rounds(ALL[kind](value), step_info(False, -1.0, value))]
        np.testing.assert_allclose(found, lambdas(ALL[kind](value), [REJECTED] * 2), rtol=1e-13)
    assert len(traces) == 1


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
@pytest.mark.parametrize("name", [*POLICIES, "constant:0.5"])
def test_every_policy_keeps_types_and_shapes_from_step_to_step(name, dtype):
    """So that it can be the carry of a loop."""
    policy = make_policy(name)
    assert isinstance(policy, DampingPolicy)
    state, damping = policy.init(info(dtype=dtype))
    kinds = jax.tree.map(lambda x: (jnp.shape(x), jnp.result_type(x)), (state, damping))
    for accepted in (True, False):
        after = policy.propose(state, step_info(accepted, 0.3, 0.1, dtype))
        assert jax.tree.map(lambda x: (jnp.shape(x), jnp.result_type(x)), after) == kinds
    assert damping.dtype == dtype


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
@pytest.mark.parametrize("name", ["ceres", "classic", "gtsam", "nielsen", "stba", "theseus"])
def test_a_lambda_that_shrank_for_a_hundred_iterations_can_grow_again(name, dtype):
    """At zero, where float32 underflows to, no factor would bring it back."""
    policy = make_policy(name)
    state, damping = policy.init(info(dtype=dtype))
    for accepted in [True] * 100 + [False]:
        before = float(damping)
        state, damping = policy.propose(state, step_info(accepted, 1.0, damping, dtype))
    assert 0 < before < damping


# Names


def test_every_name_makes_its_policy_with_the_lambda_that_was_asked_for():
    for name in POLICIES:
        assert make_policy(name) == POLICIES[name][0]()
    assert make_policy("classic:0.03") == Classic(initial=0.03)
    assert make_policy("ceres:1e-2") == Ceres(initial=1e-2)
    assert make_policy("nielsen:1e-3") == replace(make_policy("nielsen"), initial=1e-3)
    assert make_policy("constant:1e+2") == Schedule(values=(100.0,))


@pytest.mark.parametrize(
    ("name", "message"),
    [
        (
            "cerse",
            "unknown damping policy 'cerse', did you mean ceres? known: ",
        ),
        ("", "unknown damping policy ''"),
        ("ceres+embedded", "unknown damping policy 'ceres+embedded': its name has no '+'"),
        ("ceres:x", "must be a positive number, not 'x'"),
        ("ceres:-1", "must be a positive number, not '-1'"),
        ("ceres:nan", "must be a positive number, not 'nan'"),
        ("classic:inf", "must be a positive number"),
        ("constant", "must be a positive number, not ''"),
        ("constant:", "must be a positive number, not ''"),
        ("constant:0", "must be a positive number, not '0'"),
        ("bold:0.1", "'bold' has no first lambda to set; use constant:LAMBDA"),
        ("schedule:0.1", "has no first lambda to set; use constant:LAMBDA"),
        ("gauss-newton:1", "has no first lambda to set"),
        ("ceres:", "must be a positive number"),
        ("two\nlines", "unknown damping policy"),
    ],
)
def test_a_name_that_is_no_policy_is_one_clear_line(name, message):
    with pytest.raises(InputError) as caught:
        make_policy(name)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)
