"""Policies of a user: what JAX cannot trace is said in one line."""

from __future__ import annotations

import math
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
import pytest

import jaxba
from jaxba.damping.policy_check import check_traceable


class Rule:
    """What the policies below share."""

    min_gain = 0.0

    def init(self, info):
        return jnp.asarray(1e-4), jnp.asarray(1e-4)


@jaxba.register_pytree
@dataclass(frozen=True)
class Branches(Rule):
    def propose(self, state, step):
        damping = state / 3 if step.accepted else state * 2
        return damping, damping


@jaxba.register_pytree
@dataclass(frozen=True)
class CallsNumPy(Rule):
    def propose(self, state, step):
        damping = np.clip(np.asarray(step.damping), 1e-8, 1.0)
        return damping, damping


@jaxba.register_pytree
@dataclass(frozen=True)
class CallsMath(Rule):
    def propose(self, state, step):
        damping = math.sqrt(step.damping)
        return damping, damping


@jaxba.register_pytree
@dataclass(frozen=True)
class Grows(Rule):
    def propose(self, state, step):
        return jnp.stack([state, state]), state


@jaxba.register_pytree
@dataclass(frozen=True)
class Right(Rule):
    def propose(self, state, step):
        damping = jnp.where(step.accepted, state / 3, state * 2)
        return damping, damping


@pytest.mark.parametrize(
    ("policy", "advice"),
    [
        (Branches(), "use jnp.where"),
        (CallsNumPy(), "use jax.numpy"),
        (CallsMath(), "use jax.numpy"),
        (Grows(), "a state like that of init"),
    ],
)
def test_a_policy_that_jax_cannot_trace_is_refused(policy, advice):
    problem = jaxba.random_scene(jaxba.SceneConfig(4, 30, 100), 0)
    with pytest.raises(ValueError, match=advice) as caught:
        jaxba.solve(problem, policy)
    text = str(caught.value)
    assert text.startswith(f"policy {type(policy).__name__}: propose ")
    assert "\n" not in text
    assert len(text) < 300


def test_a_policy_that_jax_can_trace_is_accepted():
    check_traceable(Right())
