"""What an agent observes."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from agent_steps import ACCEPTED, REJECTED, begin, damping_of, info, observe, record
from hypothesis import given, settings
from hypothesis import strategies as st
from support import step_info

from jaxba.damping import features
from jaxba.damping.agent_config import AgentConfig
from jaxba.damping.features import DURATIONS, PAPER_LIMIT, duration, observation_size

awkward = st.sampled_from([0.0, 1.0, -1.0, 1e-300, 1e300, -1e300, np.nan, np.inf, -np.inf])


@settings(max_examples=60, deadline=None)
@given(
    st.sampled_from([0.0, 1e-300, 1.0, 1e300]),
    st.lists(st.tuples(st.booleans(), *[awkward] * 4), max_size=6),
)
def test_an_observation_is_finite_and_bounded_whatever_a_step_says(cost, steps):
    config = AgentConfig(history=3)
    memory = begin(config, info(max(cost, 1e-300)))
    for accepted, candidate, predicted, gain, share in steps:
        memory = record(
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
                damping_fraction=share,
            ),
        )
        seen = np.asarray(observe(config, memory))
        assert seen.dtype == np.float32
        assert np.isfinite(seen).all()
        assert (np.abs(seen) <= 2).all()
        assert np.isfinite(float(damping_of(config, memory.guard, jnp.asarray(0.5, jnp.float32))))


def test_an_observation_has_the_size_that_was_promised():
    for name in ("scale-free", "paper", "duration"):
        for history in range(1, 21):
            config = AgentConfig(observation=name, history=history)
            seen = jax.eval_shape(
                lambda i, config=config: features.observe(config, features.begin(config, i)), info()
            )
            assert seen.shape == (observation_size(config),)
            assert seen.dtype == jnp.float32
    assert observation_size(AgentConfig(observation="paper", history=7)) == 7


def _story(config: AgentConfig, unit: float) -> np.ndarray:
    """Observations of one and the same solve with pixels counted in other units."""
    memory = begin(config, info(100.0 * unit**2, 500.0 * unit))
    seen = [observe(config, memory)]
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
            damping_fraction=0.2,
        )
        memory = record(config, memory, step)
        seen.append(observe(config, memory))
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

    def rms(cost):
        return min(np.sqrt(2 * cost / 80), PAPER_LIMIT)

    costs = [100.0, 60.0, 60.0, 20.0, 1e9]
    memory = begin(config, info(costs[0]))
    for k, cost in enumerate(costs[1:], 1):
        memory = record(config, memory, step_info(True, cost=cost, previous_cost=costs[k - 1]))
        expected = [rms(c) for c in reversed(costs[max(0, k - 2) : k + 1])]
        np.testing.assert_allclose(observe(config, memory)[: len(expected)], expected, rtol=1e-6)
    assert float(observe(config, memory)[0]) == PAPER_LIMIT == 1000.0
    start = observe(config, begin(config, info(1e12)))
    np.testing.assert_allclose(start, [PAPER_LIMIT, 0, 0])


def test_the_times_of_the_last_iterations_are_those_of_the_clock_newest_first():
    config = AgentConfig(observation="duration", history=3)
    memory = begin(config, info())
    seen = [0.0, 0.0, 0.0]
    np.testing.assert_array_equal(observe(config, memory), seen)
    for k in range(5):
        step = step_info(k != 2, candidate_cost=50.0 - k)
        memory = record(config, memory, step)
        seen = [-float(duration(step)), *seen[:2]]
        np.testing.assert_allclose(observe(config, memory), seen, rtol=1e-6)
    assert all(-time in np.float32(DURATIONS) for time in np.float32(seen))
    assert np.mean(DURATIONS) == pytest.approx(1, abs=1e-3)
