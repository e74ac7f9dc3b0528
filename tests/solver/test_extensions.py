"""A loss and a policy of one's own, written as somebody would who has only read the
documentation."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import support

import jaxba
from jaxba import DampingPolicy, Loss, ProblemInfo, SolveOptions, StepInfo, register_pytree
from jaxba.problem import geometry


def huber(s: jax.Array) -> jax.Array:
    return jnp.where(s <= 1, s, 2 * jnp.sqrt(jnp.maximum(s, 1)) - 1)


def cauchy(s: jax.Array) -> jax.Array:
    return jnp.log1p(s)


def geman_mcclure(s: jax.Array) -> jax.Array:
    return s / (1 + s)


def with_loss(loss: Loss, **asked) -> jaxba.Solution:
    options = SolveOptions(loss=loss, compilation="full", **asked)
    return jaxba.solve(support.tiny(), "ceres", options, callback=lambda record: None)


@pytest.mark.parametrize(
    ("name", "rho", "asked"),
    [("huber", huber, {"refinement": jaxba.Refinement(points=2)}), ("cauchy", cauchy, {})],
    ids=["refined", "plain"],
)
def test_a_loss_written_by_hand_is_the_named_one(name, rho, asked):
    named = with_loss(Loss(name, 1.7), **asked)
    own = with_loss(Loss(rho, 1.7), **asked)
    assert (own.iterations, own.termination) == (named.iterations, named.termination)
    np.testing.assert_allclose(own.history.cost, named.history.cost, rtol=1e-9)
    np.testing.assert_allclose(own.problem.points, named.problem.points, rtol=1e-6, atol=1e-7)


def test_geman_mcclure_counts_what_its_formula_says():
    """`rho(s) = s / (1 + s)`, of `s = r^2 / scale^2`; no pixel costs more than half of the squared
    scale."""
    scale = 2.5
    solution = with_loss(Loss(geman_mcclure, scale))

    def cost(problem: jaxba.BundleProblem) -> float:
        squared = np.sum(geometry.residuals(problem) ** 2, axis=1)
        return 0.5 * float(np.sum(squared / (1 + squared / scale**2)))

    assert solution.converged
    np.testing.assert_allclose(solution.initial_cost, cost(support.tiny()), rtol=1e-12)
    np.testing.assert_allclose(solution.final_cost, cost(solution.problem), rtol=1e-10)
    assert (
        solution.final_cost
        < solution.initial_cost
        < 0.5 * scale**2 * support.tiny().num_observations
    )


@register_pytree
@dataclass(frozen=True)
class Steady:
    """Lambda is divided by one number after an accepted step and multiplied by another after a
    rejected one."""

    initial: float = 1e-2
    fall: float = 3.0
    rise: float = 10.0
    min_gain: float = 0.1

    def init(self, info: ProblemInfo) -> tuple[jax.Array, jax.Array]:
        damping = jnp.asarray(self.initial, info.cost.dtype)
        return damping, damping

    def propose(self, state: jax.Array, step: StepInfo) -> tuple[jax.Array, jax.Array]:
        damping = state * jnp.where(step.accepted, 1 / self.fall, self.rise).astype(state.dtype)
        return damping, damping


@pytest.mark.parametrize("callback", [None, lambda record: None], ids=["compiled", "stepwise"])
def test_a_policy_written_by_hand_drives_a_solve(callback):
    assert isinstance(Steady(), DampingPolicy)
    options = SolveOptions(compilation="full")
    solution = jaxba.solve(support.tiny(), Steady(initial=0.5), options, callback=callback)
    assert solution.converged
    factors = np.where(solution.history.accepted[:-1], 1 / 3, 10.0)
    np.testing.assert_allclose(solution.history.damping[0], 0.5)
    np.testing.assert_allclose(
        solution.history.damping[1:] / solution.history.damping[:-1], factors, rtol=1e-12
    )
    assert (solution.history.gain_ratio[solution.history.accepted] > 0.1).all()
    best = jaxba.solve(support.tiny(), "ceres", options, callback=callback)
    np.testing.assert_allclose(solution.final_cost, best.final_cost, rtol=1e-4)


def test_a_policy_written_by_hand_brings_a_plain_step():
    assert jaxba.prepare(support.tiny(), Steady()).options == jaxba.StepOptions()


def test_policies_that_jax_cannot_tell_apart_are_refused():
    """Their programs would be mistaken for each other, now and then, without a word."""

    def make(fall: float) -> object:
        @jax.tree_util.register_dataclass
        @dataclass(frozen=True)
        class Twin(Steady):
            def propose(self, state: jax.Array, step: StepInfo) -> tuple[jax.Array, jax.Array]:
                return state / fall, state / fall

        return Twin()

    first = make(2.0)
    second = make(3.0)
    jaxba.prepare(support.tiny(), first)
    with pytest.raises(
        ValueError,
        match=r"Twin cannot be told from policy Twin of this process.*jaxba\.register_pytree",
    ):
        jaxba.prepare(support.tiny(), second)
    jaxba.prepare(support.tiny(), first)


class OnlyStarts:
    def init(self, info):
        return info.cost, info.cost


@dataclass(frozen=True)
class Unregistered(Steady):
    """As `Steady`, without the decorator."""


@pytest.mark.parametrize(
    ("policy", "message"),
    [
        (object(), "policy must be the name of a policy or a policy, not <object"),
        (Steady, "policy must be the name of a policy or a policy, not <class"),
        (OnlyStarts(), "policy OnlyStarts has no min_gain and no propose"),
        (Unregistered(), "policy Unregistered is no pytree: decorate its dataclass"),
    ],
)
def test_what_is_no_policy_is_refused_in_one_line(policy, message, unchecked):
    with pytest.raises(ValueError, match=message) as caught:
        jaxba.solve(support.tiny(), policy)
    assert "\n" not in str(caught.value)
