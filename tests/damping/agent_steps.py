"""Made-up steps that an agent records, for the tests of its guard and its features."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from support import step_info

from jaxba import ProblemInfo
from jaxba.damping import features, guard
from jaxba.damping.agent_config import AgentConfig
from jaxba.damping.features import Memory

begin = jax.jit(features.begin, static_argnums=0)
observe = jax.jit(features.observe, static_argnums=0)
damping_of = jax.jit(guard.damping_of, static_argnums=0)
record = jax.jit(features.record, static_argnums=0)

RANGE = {"low": -10.0, "high": 2.0, "first_low": -10.0, "descent": 50.0}
FREE = AgentConfig(guard="off", **RANGE)
REJECTED = False
ACCEPTED = True


def info(cost: float = 100.0, focal: float = 500.0, limit: int = 100) -> ProblemInfo:
    def count(n):
        return jnp.asarray(n, jnp.int32)

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
    return float(jnp.log10(damping_of(config, memory.guard, jnp.asarray(action, jnp.float32))))


def after(
    config: AgentConfig, memory: Memory, accepted: bool, logdamping: float, **changes
) -> Memory:
    """Memory after one step; a tenth of the cost goes where it is accepted."""
    before = float(memory.cost)
    values = {
        "gain": 0.5 if accepted else -0.5,
        "cost": 0.9 * before if accepted else before,
        "previous_cost": before,
        "candidate_cost": 0.9 * before if accepted else 2 * before,
        "predicted": 0.2 * before,
        "damping_fraction": 0.1,
        **changes,
    }
    return record(config, memory, step_info(accepted, damping=10.0**logdamping, **values))
