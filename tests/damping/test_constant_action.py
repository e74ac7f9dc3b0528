"""A constant action: the guard without a network, and the policy `bold`."""

from __future__ import annotations

import functools

import jax.numpy as jnp
import numpy as np
import pytest
from agent_steps import ACCEPTED, REJECTED, after, info
from test_learned import random_policy

from jaxba import SolveOptions, StepOptions, make_policy, perturb, random_scene, scene_like, solve
from jaxba.damping import registry
from jaxba.damping.agent_config import AgentConfig
from jaxba.damping.features import begin, observation_size
from jaxba.damping.guard import damping_of
from jaxba.damping.learned import LearnedPolicy, always
from jaxba.damping.policy_file import save_policy
from jaxba.solver.names import parse_solver


def boldest_network(config: AgentConfig) -> LearnedPolicy:
    """No weights, and biases of which the hyperbolic tangent is -1 in float32."""
    zero = [
        layer._replace(kernel=0 * layer.kernel, bias=0 * layer.bias)
        for layer in random_policy(0, config).layers
    ]
    return LearnedPolicy(
        (*zero[:-1], zero[-1]._replace(bias=zero[-1].bias - np.float32(50))), config
    )


@functools.cache
def hard_scene():
    """Starts so far from the solution that steps are shortened and rejected."""
    return perturb(random_scene(scene_like("paper"), 3), 0, point_sigma=0.5)


@pytest.mark.parametrize("embedded", [True, False])
def test_bold_is_a_network_that_always_asks_for_the_smallest_lambda(embedded):
    policy, options = parse_solver("bold" if embedded else "bold+refine0").build()
    found = solve(hard_scene(), policy, options)
    expected = solve(hard_scene(), boldest_network(policy.config), options)
    assert found.iterations == expected.iterations > 3
    np.testing.assert_allclose(found.history.damping, expected.history.damping, rtol=1e-6)
    # two programs, which round differently: one bit of the points changes these costs by 8e-11
    np.testing.assert_allclose(found.history.cost, expected.history.cost, rtol=1e-9)


def test_bolds_lambda_is_the_smallest_of_all_that_the_guard_allows():
    policy = make_policy("bold")
    config = policy.config
    wishes = jnp.linspace(-1, 1, 9, dtype=jnp.float32)
    state = begin(config, info())
    damping = policy.init(info())[1]
    for accepted in (
        ACCEPTED,
        REJECTED,
        ACCEPTED,
        ACCEPTED,
        ACCEPTED,
        REJECTED,
        REJECTED,
        ACCEPTED,
    ):
        allowed = [float(damping_of(config, state.guard, wish)) for wish in wishes]
        assert float(damping) == min(allowed)
        state = after(config, state, accepted, float(jnp.log10(damping)))
        damping = damping_of(
            config, state.guard, policy.act(jnp.zeros(observation_size(policy.config)))[0]
        )


def test_bold_falls_by_the_descent_to_the_lowest_and_rises_after_a_rejection():
    policy = make_policy("bold")
    state = begin(policy.config, info())
    found = []
    for accepted in (ACCEPTED,) * 4 + (REJECTED, ACCEPTED):
        found.append(
            float(
                jnp.log10(
                    damping_of(
                        policy.config,
                        state.guard,
                        policy.act(jnp.zeros(observation_size(policy.config)))[0],
                    )
                )
            )
        )
        state = after(policy.config, state, accepted, found[-1])
    np.testing.assert_allclose(found, [-5, -6.5, -8, -9, -9, -8.5], atol=1e-6)


def test_an_action_between_the_bounds_is_played_as_it_is():
    config = AgentConfig(guard="off", low=-10.0, high=2.0)
    found = solve(hard_scene(), always(0.25, config), SolveOptions(max_iterations=5))
    np.testing.assert_allclose(np.log10(found.history.damping), -2.5, rtol=1e-6)


def test_bold_has_the_step_of_rules_with_embedded_iterations():
    policy, options = parse_solver("bold").build()
    assert options.step_options(policy) == policy.step_options(StepOptions())
    assert options.step_options(policy) == parse_solver("ceres+embedded").build()[1].step_options(
        make_policy("ceres")
    )


@pytest.mark.parametrize("action", [-1.0, -0.25, 1.0])
def test_a_constant_action_can_be_a_policy_file(action, tmp_path):
    config = AgentConfig(history=2)
    save_policy(tmp_path / "constant.safetensors", always(action, config))
    policy = make_policy(str(tmp_path / "constant.safetensors"))
    for seed in range(3):
        seen = np.random.default_rng(seed).normal(size=observation_size(config)).astype(np.float32)
        np.testing.assert_allclose(policy.act(jnp.asarray(seen)), [action], rtol=1e-6)


def test_bold_is_written_by_hand():
    assert not registry.is_learned("bold")


def test_without_options_a_solve_takes_the_step_of_the_policy():
    policy, options = parse_solver("bold").build()
    assert SolveOptions().step_options(policy) == options.step_options(policy)
    assert solve(hard_scene(), "bold").iterations == solve(hard_scene(), policy, options).iterations
