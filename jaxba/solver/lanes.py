"""Many problems of one shape as one program, each to its end.

On a GPU so many at a time are *lanes*: when a problem ends, its lane takes the next one at once, so
that none waits for the slowest (`refill`, which the game's `rollout` uses, too). On a CPU the
program solves one after the other, and every core runs its own (many.py): that has no waiting at
all, and arrays stay in the core's cache. Eight lanes side by side took three times as long per
problem there."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Bool, Float, Int

from jaxba.damping import DampingPolicy
from jaxba.lm.records import LMState, StepInfo
from jaxba.lm.step import state_of
from jaxba.lm.termination import Termination, Tolerances
from jaxba.problem.options import StepOptions
from jaxba.runtime import loops
from jaxba.runtime.groups import step_groups
from jaxba.solver.iteration import Carry, begin, iterate, problem_info
from jaxba.solver.loop import loop_from
from jaxba.structure.layout import Layout
from jaxba.typing import AnyArray

Found = TypeVar("Found")

Row = Int[Array, ""]
"""Which problem."""


class Ends(NamedTuple):
    """Ends of solves, along a leading axis."""

    state: LMState
    initial_cost: Float[Array, " rows"]
    iterations: Int[Array, " rows"]
    termination: Int[Array, " rows"]
    history: StepInfo  # [rows, iterations], zero after the end


class Starts(NamedTuple):
    """Problems of one shape, along a leading axis."""

    layout: Layout
    cameras: Float[AnyArray, "rows cameras parameters"]
    points: Float[AnyArray, "rows points 3"]


def solve_rows(
    starts: Starts,
    policy: DampingPolicy,
    tolerances: Tolerances,
    limit: Int[Array, ""],
    used: Int[Array, ""],
    options: StepOptions,
    length: int,
    lanes: int,
) -> Ends:
    """Solves the first `used` problems; the others give anything.

    Args:
        starts: the problems, padded.
        policy: chooses lambda.
        tolerances: convergence tests.
        limit: most iterations of each, at most `length`.
        used: number of problems.
        options: of the steps, static.
        length: length of the histories, static.
        lanes: problems at a time, static."""

    def start(one: Starts) -> Carry:
        state = state_of(*one, options, one.cameras.dtype)
        return begin(problem_info(one.layout, state, options, limit), policy, state)

    def whole(one: Starts) -> Ends:
        carry = start(one)
        end, history = loop_from(one.layout, carry, policy, tolerances, options, length, limit)
        return Ends(end.state, carry.state.cost, end.iteration, end.termination, history)

    if lanes == 1:
        return loops.map_rows(whole, starts, used)
    rows = starts.cameras.shape[0]

    def at(row):
        return jax.tree.map(lambda x: x[row], starts)

    def fresh(row):
        return start(at(row))

    first = jax.vmap(fresh)(jnp.arange(rows))

    def one(row, carry):
        return iterate(at(row).layout, carry, policy, tolerances, options, limit)

    def advance(row: Row, carry: Carry) -> tuple[Carry, StepInfo, Bool[Array, ""]]:
        carry, step = one(row, carry)
        return carry, step, carry.termination != Termination.RUNNING

    def note(found: Ends, row: Int[Array, " lanes"], carry: Carry, step: StepInfo, _: Any) -> Ends:
        def put(every, own):
            return every.at[row].set(own, mode="drop")

        return Ends(
            jax.tree.map(put, found.state, carry.state),
            found.initial_cost,
            put(found.iterations, carry.iteration),
            put(found.termination, carry.termination),
            jax.tree.map(
                lambda every, own: every.at[row, carry.iteration - 1].set(own, mode="drop"),
                found.history,
                step,
            ),
        )

    shapes = jax.eval_shape(one, jnp.zeros((), jnp.int32), jax.tree.map(lambda x: x[0], first))[1]
    history = jax.tree.map(lambda x: jnp.zeros((rows, length), x.dtype), shapes)
    nothing = Ends(first.state, first.state.cost, first.iteration, first.termination, history)
    return refill(used, rows, min(lanes, rows), fresh, advance, note, nothing)


def refill(
    count: int | Int[Array, ""],
    rows: int,
    lanes: int,
    fresh: Callable[[Row], Any],
    advance: Callable[[Row, Any], tuple[Any, Any, Bool[Array, ""]]],
    note: Callable[..., Found],
    found: Found,
) -> Found:
    """Runs rows to their ends, some at a time: a lane whose row ends takes the next one.

    Args:
        count: number of rows that are run, the first ones.
        rows: number of rows that there are.
        lanes: rows at a time.
        fresh: the state of a lane at the start of a row.
        advance: from row and state the next state, a record, and whether the row ends.
        note: what was found, after all lanes have advanced: from what was found before, and rows,
            states, records and ends of lanes. Rows of idle lanes are out of range.
        found: what was found at first."""

    def body(loop: tuple[Any, ...]) -> tuple[Any, ...]:
        row, lane, following, found = loop
        inside = jnp.minimum(row, count - 1).astype(jnp.int32)  # idle lanes repeat the last row
        lane, record, done = step_groups(advance, inside, lane)
        found = note(found, jnp.where(row < count, row, rows), lane, record, done)
        new_row = (following + jnp.cumsum(done) - 1).astype(jnp.int32)
        new = jax.vmap(fresh)(jnp.minimum(new_row, count - 1).astype(jnp.int32))

        def pick(new, old):
            return jnp.where(done.reshape(-1, *[1] * (old.ndim - 1)), new, old)

        row, lane = jax.tree.map(pick, (new_row, new), (row, lane))
        return row, lane, (following + jnp.sum(done)).astype(jnp.int32), found

    first = jnp.arange(lanes, dtype=jnp.int32)
    start = jax.vmap(fresh)(jnp.minimum(first, count - 1).astype(jnp.int32))
    loop = first, start, jnp.asarray(lanes, jnp.int32), found
    return lax.while_loop(lambda loop: jnp.any(loop[0] < count), body, loop)[3]
