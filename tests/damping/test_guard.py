"""The guard: lambda of an action, its limits, and when Ceres' rule takes over."""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from agent_steps import (
    ACCEPTED,
    FREE,
    RANGE,
    REJECTED,
    after,
    begin,
    damping_of,
    decades,
    info,
    record,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from support import step_info

from jaxba import Ceres
from jaxba.damping.agent_config import AgentConfig
from jaxba.damping.default_policy import FIRST_DAMPING
from jaxba.damping.guard import OVERDAMPED_DECREASE, OVERDAMPED_FRACTION
from jaxba.game.env import _rule_damping


@pytest.mark.parametrize(
    ("dtype", "least"), [("float64", 1e-10), ("float32", float(np.finfo(np.float32).eps))]
)
def test_no_lambda_is_below_what_its_type_can_add_to_one(dtype, least):
    start = info()
    start = start._replace(cost=start.cost.astype(dtype), unit=start.unit.astype(dtype))
    for guard in ("off", "hand-over"):
        memory = begin(replace(FREE, guard=guard), start)
        found = damping_of(replace(FREE, guard=guard), memory.guard, jnp.asarray(-1.0, jnp.float32))
        assert found.dtype == dtype
        np.testing.assert_allclose(float(found), least, rtol=1e-5)
        assert float(found + jnp.ones((), found.dtype)) > 1 or dtype == "float64"


@pytest.mark.parametrize(("low", "high"), [(-10.0, 2.0), (-6.0, 0.0)])
def test_actions_are_decades_from_the_lowest_to_the_highest(low, high):
    for guard in ("off", "hand-over"):
        config = AgentConfig(low=low, high=high, guard=guard, first_low=low, descent=50.0)
        memory = begin(config, info())
        found = [decades(config, memory, action) for action in (-1, -0.5, 0, 0.5, 1)]
        np.testing.assert_allclose(found, np.linspace(low, high, 5), atol=1e-6)


def test_without_a_guard_an_action_means_the_same_after_any_history():
    memory = begin(FREE, info())
    for k in range(12):
        memory = after(FREE, memory, k % 5 == 4, -9.0)
        np.testing.assert_allclose(decades(FREE, memory, -1), FREE.low, atol=1e-6)


# The guard


@pytest.mark.parametrize("patience", [1, 2, 3])
def test_after_so_many_rejections_in_a_row_the_action_no_longer_matters(patience):
    config = AgentConfig(patience=patience, max_rejections=50, **RANGE)
    memory = begin(config, info())
    for k in range(patience):
        free = decades(config, memory, 1) - decades(config, memory, -1)
        assert free > 1, k
        memory = after(config, memory, REJECTED, decades(config, memory, -1))
    assert decades(config, memory, 1) == decades(config, memory, -1)
    memory = after(config, memory, ACCEPTED, decades(config, memory, 0))
    assert decades(config, memory, 1) == decades(config, memory, -1)


def test_after_so_many_rejections_in_all_the_action_no_longer_matters():
    config = AgentConfig(patience=2, max_rejections=3, **RANGE)
    memory = begin(config, info())
    for k in range(3):
        memory = after(config, memory, ACCEPTED, -2.0)
        assert decades(config, memory, 1) - decades(config, memory, -1) > 1, k
        memory = after(config, memory, REJECTED, -4.0)
    for accepted in (ACCEPTED, ACCEPTED, REJECTED, ACCEPTED):
        assert decades(config, memory, 1) == decades(config, memory, -1)
        memory = after(config, memory, accepted, decades(config, memory, 1))


@settings(max_examples=40, deadline=None)
@given(st.lists(st.tuples(st.booleans(), st.floats(1e-3, 1.5)), min_size=1, max_size=20))
def test_in_charge_the_guard_is_ceres_rule(steps):
    """From the moment of the hand-over on, its lambdas are those of `rules.Ceres` started where it
    stands."""
    config = AgentConfig(patience=2, **RANGE)
    memory = begin(config, info())
    for log_damping in (-3.0, -2.0):
        memory = after(config, memory, REJECTED, log_damping)
    ours = decades(config, memory, 0.3)
    # twice the lambda that failed last
    np.testing.assert_allclose(ours, np.log10(2 * 1e-2), atol=1e-6)
    rule = Ceres(initial=10.0**ours)
    _, damping = rule.init(info())
    # the growth of the next rejection after one at this lambda is already doubled
    state = jnp.asarray(4.0)
    for accepted, gain in steps:
        gain = gain if accepted else -gain
        step = step_info(
            accepted,
            gain,
            damping,
            cost=1.0,
            previous_cost=1.5 if accepted else 1.0,
            candidate_cost=2.0,
        )
        state, damping = rule.propose(state, step)
        memory = record(config, memory, step)
        lowest = 10.0**config.low
        if damping < lowest:
            return
        np.testing.assert_allclose(decades(config, memory, 0.9), np.log10(damping), atol=1e-6)


@settings(max_examples=40, deadline=None)
@given(st.lists(st.tuples(st.booleans(), st.floats(1e-3, 1.5)), min_size=1, max_size=20))
def test_what_is_demonstrated_is_ceres_rule_after_any_steps(steps):
    memory = begin(FREE, info())
    state, damping = Ceres().init(info())
    for accepted, gain in steps:
        np.testing.assert_allclose(float(_rule_damping(memory)), np.log10(damping), atol=1e-6)
        gain = gain if accepted else -gain
        step = step_info(
            accepted,
            gain,
            damping,
            cost=1.0,
            previous_cost=1.5 if accepted else 1.0,
            candidate_cost=2.0,
        )
        state, damping = Ceres().propose(state, step)
        memory = record(FREE, memory, step)


@pytest.mark.parametrize(
    ("worked", "rescue"), [(None, FIRST_DAMPING), (-6.0, -6.0), (-2.0, -2.0), (-9.9, FIRST_DAMPING)]
)
def test_a_rescue_starts_at_the_last_lambda_that_worked_or_else_at_ceres_first(worked, rescue):
    """One that worked is no help where a larger one was refused since."""
    config = AgentConfig(patience=2, **RANGE)
    memory = begin(config, info())
    if worked is not None:
        memory = after(config, memory, ACCEPTED, worked)
    for log_damping in (-9.5, -9.0):
        memory = after(config, memory, REJECTED, log_damping)
    np.testing.assert_allclose(decades(config, memory, -1), rescue, atol=1e-6)


@settings(max_examples=40, deadline=None)
@given(
    st.integers(1, 4),
    st.lists(
        st.tuples(st.sampled_from([True, False, False]), st.floats(-1, 1)), min_size=1, max_size=25
    ),
)
def test_guarded_lambda_never_falls_after_a_rejection(patience, steps):
    config = AgentConfig(patience=patience, **RANGE)
    memory = begin(config, info())
    last = None
    rejected = False
    for accepted, wish in steps:
        now = decades(config, memory, wish)
        assert config.low - 1e-6 <= now <= 32 + 1e-6
        if rejected:
            assert now > last or now > 32 - 1e-6  # the bound of every lambda
        memory = after(config, memory, accepted, now)
        last = now
        rejected = not accepted


def test_the_agent_s_own_lambda_rises_by_so_many_decades_after_a_rejection():
    for escalate in (0.25, 1.0):
        config = AgentConfig(patience=3, escalate=escalate, **RANGE)
        memory = after(config, begin(config, info()), REJECTED, -5.0)
        np.testing.assert_allclose(decades(config, memory, -1), -5 + escalate, atol=1e-6)
        np.testing.assert_allclose(decades(config, memory, 1), config.high, atol=1e-6)


def test_a_solve_cannot_stand_still_under_a_large_lambda():
    """Accepted, with next to no decrease, and short for its damping: a decade down, at least."""
    config = AgentConfig(**RANGE)
    memory = begin(config, info())
    tiny = {
        "cost": 100 * (1 - 0.5 * OVERDAMPED_DECREASE),
        "damping_fraction": 0.5 + 0.5 * OVERDAMPED_FRACTION,
    }
    capped = after(config, memory, ACCEPTED, 1.0, **tiny)
    np.testing.assert_allclose(decades(config, capped, 1), 0.0, atol=1e-6)
    np.testing.assert_allclose(decades(config, capped, -1), config.low, atol=1e-6)
    for change in (
        {"cost": 99.0},
        {"damping_fraction": 0.9 * OVERDAMPED_FRACTION},
        {"step_fraction": 0.25},
    ):
        free = after(config, memory, ACCEPTED, 1.0, **{**tiny, **change})
        np.testing.assert_allclose(decades(config, free, 1), config.high, atol=1e-6)


def test_lambda_does_not_fall_after_an_inexact_step_that_it_hardly_changed():
    """Conjugate gradients left more open than lambda did; after an exact step it may fall."""
    config = AgentConfig(**{**RANGE, "descent": 1.5})
    for forcing, share, lowest in [
        (0.1, 0.9e-2, -5.0),
        (0.1, 1.1e-2, -6.5),
        (1e-3, 0.9e-2, -6.5),
        (0.0, 0.0, -6.5),
    ]:
        memory = after(
            config, begin(config, info()), ACCEPTED, -5.0, damping_fraction=share, forcing=forcing
        )
        np.testing.assert_allclose(decades(config, memory, -1), lowest, atol=1e-6)
        np.testing.assert_allclose(decades(config, memory, 1), config.high, atol=1e-6)
    rejected = after(
        config, begin(config, info()), REJECTED, -5.0, damping_fraction=0.0, forcing=0.1
    )
    # for the rejection alone
    np.testing.assert_allclose(decades(config, rejected, -1), -4.5, atol=1e-6)


def test_lambda_falls_from_one_iteration_to_the_next_by_so_many_decades_at_most():
    config = AgentConfig(**{**RANGE, "first_low": -5.0, "descent": 2.0})
    memory = begin(config, info())
    np.testing.assert_allclose(
        [decades(config, memory, a) for a in (-1, 0, 1)], [-5, -4, 2], atol=1e-6
    )
    memory = after(config, memory, ACCEPTED, -4.0)
    np.testing.assert_allclose(
        [decades(config, memory, a) for a in (-1, -0.25, 1)], [-6, -5.5, 2], atol=1e-6
    )
    memory = after(config, memory, ACCEPTED, -9.5)
    np.testing.assert_allclose(decades(config, memory, -1), config.low, atol=1e-6)
    free = AgentConfig(**{**RANGE, "first_low": -5.0, "descent": 2.0, "guard": "off"})
    np.testing.assert_allclose(decades(free, memory, -1), free.low, atol=1e-6)
