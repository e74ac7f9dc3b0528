"""The agent's side of an iteration: lambda of an action, the guard around it, and what it sees."""

from __future__ import annotations

from dataclasses import asdict, replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support import step_info

from jaxba import Ceres, ProblemInfo, StepOptions
from jaxba.damping.agent import (
    FIRST_DAMPING,
    HEAVY_DECREASE,
    HEAVY_SHARE,
    PAPER_LIMIT,
    RELATIVE_REACH,
    AgentConfig,
    Memory,
    begin,
    config_from,
    damping_of,
    observe,
    record,
)
from jaxba.game.env import _rule_damping
from jaxba.problem.options import ConjugateGradients

_begin = jax.jit(begin, static_argnums=0)
_observe = jax.jit(observe, static_argnums=0)
_damping = jax.jit(damping_of, static_argnums=0)
_record = jax.jit(record, static_argnums=0)

RANGE = {"low": -10.0, "high": 2.0, "first_low": -10.0, "descent": 50.0}
FREE = AgentConfig(guard="off", **RANGE)
REJECTED, ACCEPTED = False, True


def info(cost: float = 100.0, focal: float = 500.0, limit: int = 100) -> ProblemInfo:
    count = lambda n: jnp.asarray(n, jnp.int32)
    return ProblemInfo(
        cost=jnp.asarray(cost),
        observations=count(80),
        cameras=count(4),
        points=count(30),
        unit=jnp.asarray(1.0),
        focal=jnp.asarray(focal),
        max_iterations=count(limit),
    )


def decades(config: AgentConfig, memory: Memory, action: float) -> float:
    """log10 of lambda."""
    return float(jnp.log10(_damping(config, memory, jnp.asarray(action, jnp.float32))))


def after(config: AgentConfig, memory: Memory, accepted: bool, log_damping: float, **changes) -> Memory:
    """Memory after one step; a tenth of the cost goes where it is accepted."""
    before = float(memory.cost)
    values = {
        "gain": 0.5 if accepted else -0.5,
        "cost": 0.9 * before if accepted else before,
        "previous_cost": before,
        "candidate_cost": 0.9 * before if accepted else 2 * before,
        "predicted": 0.2 * before,
        "damping_share": 0.1,
        **changes,
    }
    return _record(config, memory, step_info(accepted, damping=10.0**log_damping, **values))


# Lambda


@pytest.mark.parametrize(("dtype", "least"), [("float64", 1e-10), ("float32", float(np.finfo(np.float32).eps))])
def test_no_lambda_is_below_what_its_type_can_add_to_one(dtype, least):
    start = info()
    start = start._replace(cost=start.cost.astype(dtype), unit=start.unit.astype(dtype))
    for guard in ("off", "pause", "hand-over"):
        memory = _begin(replace(FREE, guard=guard), start)
        found = _damping(replace(FREE, guard=guard), memory, jnp.asarray(-1.0, jnp.float32))
        assert found.dtype == dtype
        np.testing.assert_allclose(float(found), least, rtol=1e-5)
        assert float(found + jnp.ones((), found.dtype)) > 1 or dtype == "float64"


@pytest.mark.parametrize(("low", "high"), [(-10.0, 2.0), (-6.0, 0.0)])
def test_actions_are_decades_from_the_lowest_to_the_highest(low, high):
    for guard in ("off", "pause", "hand-over"):
        config = AgentConfig(low=low, high=high, guard=guard, first_low=low, descent=50.0)
        memory = _begin(config, info())
        found = [decades(config, memory, action) for action in (-1, -0.5, 0, 0.5, 1)]
        np.testing.assert_allclose(found, np.linspace(low, high, 5), atol=1e-6)


def test_a_relative_action_is_a_factor_on_the_last_lambda():
    config = replace(FREE, action="relative")
    memory = _begin(config, info())
    np.testing.assert_allclose(decades(config, memory, 0.5), FIRST_DAMPING + RELATIVE_REACH, atol=1e-6)
    memory = after(config, memory, ACCEPTED, -5.0)
    for action in (-1, -0.3, 0, 1):
        np.testing.assert_allclose(decades(config, memory, action), -5 + RELATIVE_REACH * action, atol=1e-6)
    memory = after(config, memory, ACCEPTED, -9.0)
    np.testing.assert_allclose(decades(config, memory, -1), config.low, atol=1e-6)
    memory = after(config, memory, ACCEPTED, 1.0)
    np.testing.assert_allclose(decades(config, memory, 1), config.high, atol=1e-6)


def test_without_a_guard_an_action_means_the_same_after_any_history():
    memory = _begin(FREE, info())
    for k in range(12):
        memory = after(FREE, memory, k % 5 == 4, -9.0)
        np.testing.assert_allclose(decades(FREE, memory, -1), FREE.low, atol=1e-6)


# The guard


@pytest.mark.parametrize("guard", ["pause", "hand-over"])
@pytest.mark.parametrize("patience", [1, 2, 3])
def test_after_so_many_rejections_in_a_row_the_action_no_longer_matters(guard, patience):
    config = AgentConfig(guard=guard, patience=patience, max_rejections=50, **RANGE)
    memory = _begin(config, info())
    for k in range(patience):
        free = decades(config, memory, 1) - decades(config, memory, -1)
        assert free > 1, k
        memory = after(config, memory, REJECTED, decades(config, memory, -1))
    assert decades(config, memory, 1) == decades(config, memory, -1)
    memory = after(config, memory, ACCEPTED, decades(config, memory, 0))
    freed = decades(config, memory, 1) - decades(config, memory, -1)
    assert (freed > 1) == (guard == "pause")


def test_after_so_many_rejections_in_all_the_guard_stays_in_either_mode():
    config = AgentConfig(guard="pause", patience=2, max_rejections=3, **RANGE)
    memory = _begin(config, info())
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
    """From the moment of the hand-over on, its lambdas are those of `rules.Ceres` started where it stands."""
    config = AgentConfig(patience=2, **RANGE)
    memory = _begin(config, info())
    for log_damping in (-3.0, -2.0):
        memory = after(config, memory, REJECTED, log_damping)
    ours = decades(config, memory, 0.3)
    np.testing.assert_allclose(ours, np.log10(2 * 1e-2), atol=1e-6)  # twice the lambda that failed last
    rule = Ceres(initial=10.0**ours)
    state, damping = rule.init(info())
    # Ceres' own growth for the next rejection after one at this lambda is already doubled
    state = state._replace(growth=jnp.asarray(4.0))
    for accepted, gain in steps:
        gain = gain if accepted else -gain
        step = step_info(accepted, gain, damping, cost=1.0, previous_cost=1.5 if accepted else 1.0, candidate_cost=2.0)
        state, damping = rule.propose(state, step)
        memory = _record(config, memory, step)
        lowest = 10.0**config.low
        if damping < lowest:
            return
        np.testing.assert_allclose(decades(config, memory, 0.9), np.log10(damping), atol=1e-6)


@settings(max_examples=40, deadline=None)
@given(st.lists(st.tuples(st.booleans(), st.floats(1e-3, 1.5)), min_size=1, max_size=20))
def test_what_is_demonstrated_is_ceres_rule_after_any_steps(steps):
    memory = _begin(FREE, info())
    state, damping = Ceres().init(info())
    for accepted, gain in steps:
        np.testing.assert_allclose(float(_rule_damping(FREE, memory)), np.log10(damping), atol=1e-6)
        gain = gain if accepted else -gain
        step = step_info(accepted, gain, damping, cost=1.0, previous_cost=1.5 if accepted else 1.0, candidate_cost=2.0)
        state, damping = Ceres().propose(state, step)
        memory = _record(FREE, memory, step)


@pytest.mark.parametrize(
    ("worked", "rescue"), [(None, FIRST_DAMPING), (-6.0, -6.0), (-2.0, -2.0), (-9.9, FIRST_DAMPING)]
)
def test_a_rescue_starts_at_the_last_lambda_that_worked_or_else_at_ceres_first(worked, rescue):
    """One that worked is no help where a larger one was refused since."""
    config = AgentConfig(patience=2, **RANGE)
    memory = _begin(config, info())
    if worked is not None:
        memory = after(config, memory, ACCEPTED, worked)
    for log_damping in (-9.5, -9.0):
        memory = after(config, memory, REJECTED, log_damping)
    np.testing.assert_allclose(decades(config, memory, -1), rescue, atol=1e-6)


@settings(max_examples=40, deadline=None)
@given(
    st.sampled_from(["pause", "hand-over"]),
    st.sampled_from(["absolute", "relative"]),
    st.integers(1, 4),
    st.lists(st.tuples(st.sampled_from([True, False, False]), st.floats(-1, 1)), min_size=1, max_size=25),
)
def test_guarded_lambda_never_falls_after_a_rejection(guard, action, patience, steps):
    config = AgentConfig(guard=guard, action=action, patience=patience, **RANGE)
    memory = _begin(config, info())
    last, rejected = None, False
    for accepted, wish in steps:
        now = decades(config, memory, wish)
        assert config.low - 1e-6 <= now <= 32 + 1e-6
        if rejected:
            assert now > last
        memory = after(config, memory, accepted, now)
        last, rejected = now, not accepted


def test_the_agent_s_own_lambda_rises_by_so_many_decades_after_a_rejection():
    for escalate in (0.25, 1.0):
        config = AgentConfig(patience=3, escalate=escalate, **RANGE)
        memory = after(config, _begin(config, info()), REJECTED, -5.0)
        np.testing.assert_allclose(decades(config, memory, -1), -5 + escalate, atol=1e-6)
        np.testing.assert_allclose(decades(config, memory, 1), config.high, atol=1e-6)


def test_a_solve_cannot_stand_still_under_a_large_lambda():
    """Accepted, with next to no decrease, and short for its damping: a decade down, at least."""
    config = AgentConfig(**RANGE)
    memory = _begin(config, info())
    tiny = {"cost": 100 * (1 - 0.5 * HEAVY_DECREASE), "damping_share": 0.5 + 0.5 * HEAVY_SHARE}
    capped = after(config, memory, ACCEPTED, 1.0, **tiny)
    np.testing.assert_allclose(decades(config, capped, 1), 0.0, atol=1e-6)
    np.testing.assert_allclose(decades(config, capped, -1), config.low, atol=1e-6)
    for change in ({"cost": 99.0}, {"damping_share": 0.9 * HEAVY_SHARE}, {"share": 0.25}):
        free = after(config, memory, ACCEPTED, 1.0, **{**tiny, **change})
        np.testing.assert_allclose(decades(config, free, 1), config.high, atol=1e-6)


def test_lambda_does_not_fall_after_an_inexact_step_that_it_hardly_changed():
    """Conjugate gradients left more open than lambda did; after an exact step it may fall."""
    config = AgentConfig(**{**RANGE, "descent": 1.5})
    for forcing, share, lowest in [(0.1, 0.9e-2, -5.0), (0.1, 1.1e-2, -6.5), (1e-3, 0.9e-2, -6.5), (0.0, 0.0, -6.5)]:
        memory = after(config, _begin(config, info()), ACCEPTED, -5.0, damping_share=share, forcing=forcing)
        np.testing.assert_allclose(decades(config, memory, -1), lowest, atol=1e-6)
        np.testing.assert_allclose(decades(config, memory, 1), config.high, atol=1e-6)
    rejected = after(config, _begin(config, info()), REJECTED, -5.0, damping_share=0.0, forcing=0.1)
    assert not rejected.idle


def test_lambda_falls_from_one_iteration_to_the_next_by_so_many_decades_at_most():
    config = AgentConfig(**{**RANGE, "first_low": -5.0, "descent": 2.0})
    memory = _begin(config, info())
    np.testing.assert_allclose([decades(config, memory, a) for a in (-1, 0, 1)], [-5, -4, 2], atol=1e-6)
    memory = after(config, memory, ACCEPTED, -4.0)
    np.testing.assert_allclose([decades(config, memory, a) for a in (-1, -0.25, 1)], [-6, -5.5, 2], atol=1e-6)
    memory = after(config, memory, ACCEPTED, -9.5)
    np.testing.assert_allclose(decades(config, memory, -1), config.low, atol=1e-6)
    free = AgentConfig(**{**RANGE, "first_low": -5.0, "descent": 2.0, "guard": "off"})
    np.testing.assert_allclose(decades(free, memory, -1), free.low, atol=1e-6)


# Observations

awkward = st.sampled_from([0.0, 1.0, -1.0, 1e-300, 1e300, -1e300, np.nan, np.inf, -np.inf])


@settings(max_examples=60, deadline=None)
@given(st.sampled_from([0.0, 1e-300, 1.0, 1e300]), st.lists(st.tuples(st.booleans(), *[awkward] * 4), max_size=6))
def test_an_observation_is_finite_and_bounded_whatever_a_step_says(cost, steps):
    config = AgentConfig(history=3)
    memory = _begin(config, info(max(cost, 1e-300)))
    for accepted, candidate, predicted, gain, share in steps:
        memory = _record(
            config,
            memory,
            step_info(
                accepted,
                gain,
                1e-4,
                cost=cost,
                previous_cost=memory.cost,
                candidate_cost=candidate,
                predicted=predicted,
                damping_share=share,
            ),
        )
        seen = np.asarray(_observe(config, memory))
        assert seen.dtype == np.float32
        assert np.isfinite(seen).all()
        assert (np.abs(seen) <= 2).all()
        assert np.isfinite(float(_damping(config, memory, jnp.asarray(0.5, jnp.float32))))


def test_an_observation_has_the_size_that_was_promised():
    for name in ("scale-free", "paper", "released-code", "duration"):
        for history in range(1, 21):
            config = AgentConfig(observation=name, history=history)
            seen = jax.eval_shape(lambda i, config=config: observe(config, begin(config, i)), info())
            assert seen.shape == (config.observation_size,)
            assert seen.dtype == jnp.float32
    assert AgentConfig(observation="paper", history=7).observation_size == 7


def _story(config: AgentConfig, unit: float) -> np.ndarray:
    """Observations of one and the same solve with pixels counted in other units."""
    memory = _begin(config, info(100.0 * unit**2, 500.0 * unit))
    seen = [_observe(config, memory)]
    for accepted, log_damping, cost, candidate, predicted in (
        (ACCEPTED, -4.0, 40.0, 40.0, 65.0),
        (REJECTED, -7.0, 40.0, 900.0, 39.0),
        (ACCEPTED, -6.5, 3.0, 3.0, 35.0),
    ):
        before = 100.0 if len(seen) == 1 else 40.0
        step = step_info(
            accepted,
            (before - candidate) / predicted,
            10.0**log_damping,
            cost=cost * unit**2,
            previous_cost=before * unit**2,
            candidate_cost=candidate * unit**2,
            predicted=predicted * unit**2,
            gradient_max=7.0 * unit**2,
            damping_share=0.2,
        )
        memory = _record(config, memory, step)
        seen.append(_observe(config, memory))
    return np.asarray(seen)


@pytest.mark.parametrize("unit", [1e-3, 7.0, 1e4])
def test_a_scale_free_observation_does_not_know_the_unit_of_a_pixel(unit):
    config = AgentConfig(observation="scale-free", history=4)
    np.testing.assert_allclose(_story(config, unit), _story(config, 1.0), atol=1e-6)
    assert len({row.tobytes() for row in _story(config, 1.0)}) == 4  # but it knows the steps apart
    errors = AgentConfig(observation="paper", history=4)
    assert not np.allclose(_story(errors, unit), _story(errors, 1.0))


def test_the_paper_s_observation_is_the_last_errors_clipped():
    """Root mean square reprojection errors in pixels, the newest first, at most 1000."""
    config = AgentConfig(observation="paper", history=3)
    rms = lambda cost: min(np.sqrt(2 * cost / 80), PAPER_LIMIT)
    costs = [100.0, 60.0, 60.0, 20.0, 1e9]
    memory = _begin(config, info(costs[0]))
    for k, cost in enumerate(costs[1:], 1):
        memory = _record(config, memory, step_info(True, cost=cost, previous_cost=costs[k - 1]))
        expected = [rms(c) for c in reversed(costs[max(0, k - 2) : k + 1])]
        np.testing.assert_allclose(_observe(config, memory)[: len(expected)], expected, rtol=1e-6)
    assert float(_observe(config, memory)[0]) == PAPER_LIMIT == 1000.0
    start = _observe(config, _begin(config, info(1e12)))
    np.testing.assert_allclose(start, [PAPER_LIMIT, 0, 0])


def test_the_released_code_s_observation_is_what_the_linear_model_promised():
    config = AgentConfig(observation="released-code", history=3)
    memory = _begin(config, info())
    np.testing.assert_array_equal(_observe(config, memory), np.zeros(3))
    for predicted in (5.0, 4.0, np.nan, 2.0):
        memory = _record(config, memory, step_info(True, predicted=predicted))
    np.testing.assert_allclose(_observe(config, memory), [2.0, 0.0, 4.0])


def test_the_duration_of_every_iteration_is_one():
    config = AgentConfig(observation="duration", history=3)
    memory = _begin(config, info())
    np.testing.assert_array_equal(_observe(config, memory), np.zeros(3))
    for accepted, seen in ((True, [-1, 0, 0]), (False, [-1, -1, 0]), (True, [-1, -1, -1]), (True, [-1, -1, -1])):
        memory = _record(config, memory, step_info(accepted))
        np.testing.assert_array_equal(_observe(config, memory), seen)


# Its configuration


def _config(effort: str, refine_points: int, **other) -> AgentConfig:
    return AgentConfig(effort=effort, refine_points=max(refine_points, int(effort != "fixed")), **other)


configs = st.builds(
    _config,
    effort=st.sampled_from(["fixed", "points", "points+forcing"]),
    observation=st.sampled_from(["scale-free", "paper", "released-code", "duration"]),
    history=st.integers(1, 20),
    low=st.floats(-15, -3),
    high=st.floats(-2, 10),
    action=st.sampled_from(["absolute", "relative"]),
    guard=st.sampled_from(["off", "pause", "hand-over"]),
    patience=st.integers(1, 9),
    max_rejections=st.integers(1, 99),
    escalate=st.floats(0, 3),
    refine_points=st.integers(0, 5),
    trials=st.integers(1, 6),
    camera_rounds=st.integers(0, 4),
    pattern_moves=st.integers(0, 4),
    camera_damping=st.floats(1e-6, 1e6),
    lens_step=st.sampled_from(["file", "pixels"]),
    point_starts=st.sampled_from(["step", "rays"]),
)


@given(configs)
def test_a_configuration_comes_back_from_its_numbers(config):
    assert config_from(asdict(config)) == config
    made = config.step_options(StepOptions(conjugate_gradients=ConjugateGradients(forcing=0.2)))
    own = "refine_points", "trials", "camera_rounds", "pattern_moves", "camera_damping", "lens_step", "point_starts"
    assert [getattr(made, name) for name in own] == [getattr(config, name) for name in own]
    assert made.cg_forcing == 0.2


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"histroy": 3}, "histroy"),
        ({"history": 3.0}, "history"),
        ({"history": True}, "history"),
        ({"history": "3"}, "history"),
        ({"low": "-3"}, "low"),
        ({"low": None}, "low"),
        ({"guard": 1}, "guard"),
        ({"guard": "none"}, "guard"),
        ({"observation": "everything"}, "observation"),
        ({"action": "both"}, "action"),
        ({"history": 0}, "history"),
        ({"history": 21}, "history"),
        ({"low": 3.0}, "lambda"),
        ({"low": -16.0}, "lambda"),
        ({"low": float("nan")}, "lambda"),
        ({"high": float("inf")}, "lambda"),
        ({"patience": 0}, "patience"),
        ({"max_rejections": 0}, "max_rejections"),
        ({"descent": 0.0}, "descent"),
        ({"descent": float("nan")}, "descent"),
        ({"first_low": 3.0}, "first_low"),
        ({"first_low": float("nan")}, "first_low"),
        ({"min_gain": 1.0}, "min_gain"),
        ({"min_gain": float("nan")}, "min_gain"),
        ({"escalate": -0.1}, "escalate"),
        ({"escalate": float("nan")}, "escalate"),
        ({"escalate": float("inf")}, "escalate"),
        ({"refine_points": -1}, "refine_points"),
        ({"trials": 0}, "trials"),
        ({"camera_rounds": -1}, "camera_rounds"),
        ({"camera_damping": 0.0}, "camera_damping"),
        ({"lens_step": "zoom"}, "lens_step"),
        ({"point_starts": True}, "point_starts"),
        ({"camera_damping": float("inf")}, "camera_damping"),
    ],
)
@pytest.mark.usefixtures("unchecked")
def test_impossible_configurations_are_refused_in_one_line(change, word):
    with pytest.raises(ValueError, match=word) as caught:
        config_from({**asdict(AgentConfig()), **change})
    assert "\n" not in str(caught.value)
