"""The solve loop: an LM step, the policy's next lambda, the stopping rules, again.

`solve_loop` is the whole loop as one compiled program; callback_loop.py runs the same iteration from Python.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Float, Int

from jaxba.damping import DampingPolicy, ProblemInfo
from jaxba.lm.damped_step import largest_diagonal
from jaxba.lm.records import LMState, StepInfo
from jaxba.lm.step import lm_step
from jaxba.lm.termination import Termination, Tolerances, termination_of
from jaxba.model.linearize import linearize, only_free
from jaxba.problem.options import StepOptions
from jaxba.runtime.jit import jit
from jaxba.runtime.numerics import check_x64, for_traces
from jaxba.structure.devices import sum_over_devices
from jaxba.structure.layout import Layout, num_partitions
from jaxba.structure.segment_sums import point_sum
from jaxba.typing import AnyArray, differ, outline, same


class History(NamedTuple):
    """Records of a solve, one entry per iteration; in a `Solution` they are NumPy arrays of equal length."""

    cost: AnyArray
    """Accepted cost after the iteration, pixels^2."""

    candidate_cost: AnyArray
    """Cost of the proposed step, pixels^2."""

    damping: AnyArray
    """Lambda of the iteration."""

    gain_ratio: AnyArray
    """Actual over predicted decrease."""

    accepted: AnyArray
    """Whether the step was accepted."""

    cg_iterations: AnyArray
    """Iterations of conjugate gradients; 0 for a factorisation."""

    gradient_max: AnyArray
    """Largest absolute gradient entry before the step."""

    step_norm: AnyArray
    """Norm of the candidate's step."""

    __eq__, __ne__, __repr__, __hash__ = same, differ, outline, None  # pyright: ignore[reportAssignmentType]


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


def problem_info(layout: Layout, state: LMState, options: StepOptions, max_iterations: Any) -> ProblemInfo:
    """The information that a policy gets before the first iteration."""
    unit: Any = 1.0
    if options.coordinates.scaling == "identity":
        linear = linearize(layout, state.cameras, state.points, options.loss)
        unit = largest_diagonal(layout, only_free(layout, linear, "free"))
    tracks = point_sum(layout, jnp.asarray(layout.slot_mask, state.cost.dtype)[None])
    observations, points = sum_over_devices(layout, (jnp.sum(layout.slot_mask), jnp.sum(tracks > 0)))
    return ProblemInfo.of(state.cost, observations, points, layout.camera_seen, state.cameras[6], max_iterations, unit)


def begin(info: ProblemInfo, policy: DampingPolicy, state: Any) -> Carry:
    """The carry before the first iteration."""
    policy_state, damping = policy.init(info)
    count = lambda n: jnp.asarray(n, jnp.int32)
    return Carry(state, policy_state, damping, count(0), count(Termination.RUNNING))


def after_step(
    policy: DampingPolicy,
    policy_state: Any,
    step: StepInfo,
    iteration: Int[Array, ""],
    tolerances: Tolerances,
    max_iterations: Any,
    partitions: Any = 1,
) -> tuple[Any, Float[Array, ""], Int[Array, ""]]:
    """The policy's update and the stopping rules after a step.

    Args:
        policy: the damping policy.
        policy_state: its state before the step.
        step: record of the iteration.
        iteration: number of iterations so far, this one included.
        tolerances: convergence tests.
        max_iterations: limit of iterations.
        partitions: number of random partitions (`layout.num_partitions`); with several, a step from the same state and
            lambda differs from the one before.

    Returns:
        The next state of the policy, the next lambda, and the integer of a `Termination`.
    """
    after, damping = policy.propose(policy_state, step)
    # same policy state and lambda after a rejection: the same step would be rejected forever
    same = [jnp.all(old == new) for old, new in zip(*map(jax.tree.leaves, (policy_state, after)), strict=True)]
    stuck = functools.reduce(jnp.logical_and, same, damping == step.damping) & (jnp.asarray(partitions) == 1)
    return after, damping, termination_of(step, stuck, iteration, tolerances, max_iterations)


def advance(
    carry: Carry,
    state: Any,
    step: StepInfo,
    policy: DampingPolicy,
    tolerances: Tolerances,
    max_iterations: Any,
    partitions: Any,
) -> Carry:
    """The carry after a step. `state` is passed on unseen, and may be None; other arguments as for `after_step`."""
    iteration = carry.iteration + 1
    policy_state, damping, end = after_step(
        policy, carry.policy, step, iteration, tolerances, max_iterations, partitions
    )
    return Carry(state, policy_state, damping, iteration, end)


def history_of(step: StepInfo) -> History:
    """The fields of a record that are kept in the history."""
    return History(
        cost=step.cost,
        candidate_cost=step.candidate_cost,
        damping=step.damping,
        gain_ratio=step.gain_ratio,
        accepted=step.accepted,
        cg_iterations=step.cg_iterations,
        gradient_max=step.gradient_max,
        step_norm=step.step_norm,
    )


@for_traces
@functools.partial(jit, static_argnames=("options", "max_iterations"))
def solve_loop(
    layout: Layout,
    state: LMState,
    policy: DampingPolicy,
    tolerances: Tolerances,
    options: StepOptions,
    max_iterations: int,
    limit: Int[AnyArray, ""] | None = None,
) -> tuple[Carry, History]:
    """The solve loop as one compiled program. It can be vmapped over layouts and states of equal shapes.

    Args:
        layout: the problem's observations.
        state: start.
        policy: chooses lambda.
        tolerances: convergence tests.
        options: static options of the step.
        max_iterations: length of the histories, static.
        limit: a lower limit of iterations, not static.

    Returns:
        Final carry, and histories of length `max_iterations`, zero after the last iteration.

    Raises:
        ValueError: the state is float64, and 64 bits are not enabled in JAX.
    """
    check_x64(state.cost.dtype)
    iteration_limit = max_iterations if limit is None else jnp.minimum(limit, max_iterations)
    carry = begin(problem_info(layout, state, options, iteration_limit), policy, state)
    return loop_from(layout, carry, policy, tolerances, options, max_iterations, iteration_limit)


def iterate(
    layout: Layout,
    carry: Carry,
    policy: DampingPolicy,
    tolerances: Tolerances,
    options: StepOptions,
    limit: Any,
) -> tuple[Carry, StepInfo]:
    """One iteration of the loop. Arguments as for `solve_loop`."""
    state, step = lm_step(layout, carry.state, carry.damping, options, policy.min_gain, carry.iteration)
    return advance(carry, state, step, policy, tolerances, limit, num_partitions(layout)), step


def loop_from(
    layout: Layout,
    carry: Carry,
    policy: DampingPolicy,
    tolerances: Tolerances,
    options: StepOptions,
    length: int,
    limit: Any,
) -> tuple[Carry, History]:
    """The loop from a carry to its end; histories have the given length. Other arguments as for `solve_loop`."""
    once = lambda carry: iterate(layout, carry, policy, tolerances, options, limit)
    shapes = jax.eval_shape(lambda carry: history_of(once(carry)[1]), carry)
    empty = jax.tree.map(lambda s: jnp.zeros((length, *s.shape), s.dtype), shapes)

    def body(loop: tuple[Carry, History]) -> tuple[Carry, History]:
        before, history = loop
        after, step = once(before)
        history = jax.tree.map(lambda all_, one: all_.at[before.iteration].set(one), history, history_of(step))
        return after, history

    return lax.while_loop(lambda loop: loop[0].termination == Termination.RUNNING, body, (carry, empty))
