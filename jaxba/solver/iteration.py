"""One iteration of a solve: an LM step, the policy's next lambda, the stopping rules.

`solve` repeats it as one program (loop.py), from Python (stepwise.py) or on several devices
(sharded.py); the game repeats it for many scenes at once."""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float, Int

from jaxba.damping import DampingPolicy, ProblemInfo
from jaxba.lm.damped_step import largest_diagonal
from jaxba.lm.records import LMState, StepInfo
from jaxba.lm.step import lm_step
from jaxba.lm.termination import Termination, Tolerances, termination_of
from jaxba.model.linearize import linearize, only_free
from jaxba.problem.options import StepOptions
from jaxba.structure.devices import sum_over_devices
from jaxba.structure.layout import Layout, num_partitions
from jaxba.structure.segment_sums import point_sum


class Carry(NamedTuple):
    """The state of the loop between iterations."""

    state: Any
    """`LMState`, or None where parameters are left out."""

    policy: Any
    """State of the damping policy."""

    damping: Float[Array, ""]
    """Lambda of the next iteration."""

    iteration: Int[Array, ""]
    """Number of iterations so far."""

    termination: Int[Array, ""]
    """Integer of a `Termination`."""


def problem_info(
    layout: Layout, state: LMState, options: StepOptions, max_iterations: Any
) -> ProblemInfo:
    """The information that a policy gets before the first iteration."""
    unit: Any = 1.0
    if options.coordinates.scaling == "identity":
        linear = linearize(layout, state.cameras, state.points, options.loss)
        unit = largest_diagonal(layout, only_free(layout, linear, "free"))
    tracks = point_sum(layout, jnp.asarray(layout.slot_mask, state.cost.dtype)[None])
    observations, points = sum_over_devices(
        layout, (jnp.sum(layout.slot_mask), jnp.sum(tracks > 0))
    )
    return ProblemInfo.of(
        state.cost, observations, points, layout.camera_seen, state.cameras[6], max_iterations, unit
    )


def begin(info: ProblemInfo, policy: DampingPolicy, state: Any) -> Carry:
    """The carry before the first iteration."""
    policy_state, damping = policy.init(info)

    def count(n):
        return jnp.asarray(n, jnp.int32)

    return Carry(state, policy_state, damping, count(0), count(Termination.RUNNING))


def advance(
    carry: Carry,
    state: Any,
    step: StepInfo,
    policy: DampingPolicy,
    tolerances: Tolerances,
    max_iterations: Any,
    partitions: Any = 1,
) -> Carry:
    """The carry after a step: the policy's update, and the stopping rules. The state after the step
    is passed on unseen, and may be None. With several random partitions (`layout.num_partitions`) a
    step from the same state and lambda differs from the one before."""
    iteration = carry.iteration + 1
    after, damping = policy.propose(carry.policy, step)
    # same policy state and lambda after a rejection: the same step would be rejected forever
    same = [
        jnp.all(old == new)
        for old, new in zip(*map(jax.tree.leaves, (carry.policy, after)), strict=True)
    ]
    stuck = functools.reduce(jnp.logical_and, same, damping == step.damping) & (
        jnp.asarray(partitions) == 1
    )
    end = termination_of(step, stuck, iteration, tolerances, max_iterations)
    return Carry(state, after, damping, iteration, end)


def iterate(
    layout: Layout,
    carry: Carry,
    policy: DampingPolicy,
    tolerances: Tolerances,
    options: StepOptions,
    limit: Any,
) -> tuple[Carry, StepInfo]:
    """The carry after one iteration, and its record. Arguments as for `loop.solve_loop`."""
    state, step = lm_step(
        layout, carry.state, carry.damping, options, policy.min_gain, carry.iteration
    )
    return advance(carry, state, step, policy, tolerances, limit, num_partitions(layout)), step
