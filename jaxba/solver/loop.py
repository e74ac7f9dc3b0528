"""The iterations of a solve as one loop of a compiled program."""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Int

from jaxba.damping import DampingPolicy
from jaxba.lm.records import LMState, StepInfo
from jaxba.lm.termination import Termination, Tolerances
from jaxba.problem.options import StepOptions
from jaxba.runtime.jit import jit
from jaxba.runtime.numerics import check_x64, for_traces
from jaxba.solver.iteration import Carry, begin, iterate, problem_info
from jaxba.structure.layout import Layout
from jaxba.typing import AnyArray


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
) -> tuple[Carry, StepInfo]:
    """The solve loop as one compiled program. It can be vmapped over layouts and states of equal
    shapes. Returns the final carry, and the record: arrays of length `max_iterations`, zero after
    the last iteration. Raises ValueError: the state is float64, and 64 bits are not enabled in JAX.

    Args:
        layout: the problem's observations.
        state: start.
        policy: chooses lambda.
        tolerances: convergence tests.
        options: static options of the step.
        max_iterations: length of the record, static.
        limit: a lower limit of iterations, not static."""
    check_x64(state.cost.dtype)
    iteration_limit = max_iterations if limit is None else jnp.minimum(limit, max_iterations)
    carry = begin(problem_info(layout, state, options, iteration_limit), policy, state)
    return loop_from(layout, carry, policy, tolerances, options, max_iterations, iteration_limit)


def loop_from(
    layout: Layout,
    carry: Carry,
    policy: DampingPolicy,
    tolerances: Tolerances,
    options: StepOptions,
    length: int,
    limit: Any,
) -> tuple[Carry, StepInfo]:
    """The loop from a carry to its end; the record has the given length. Other arguments as for
    `solve_loop`."""

    def once(carry):
        return iterate(layout, carry, policy, tolerances, options, limit)

    shapes = jax.eval_shape(once, carry)[1]
    empty = jax.tree.map(lambda s: jnp.zeros((length, *s.shape), s.dtype), shapes)

    def body(loop: tuple[Carry, StepInfo]) -> tuple[Carry, StepInfo]:
        before, history = loop
        after, step = once(before)
        history = jax.tree.map(lambda all_, one: all_.at[before.iteration].set(one), history, step)
        return after, history

    return lax.while_loop(
        lambda loop: loop[0].termination == Termination.RUNNING, body, (carry, empty)
    )
