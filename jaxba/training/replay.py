"""Replay buffer: a ring buffer of transitions in one float32 array.

Transitions with a number that is not finite are dropped. Replacing the number by zero would teach
the critic a wrong value; a game that wants to penalise failures must give a finite reward."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float, Int


class Transition(NamedTuple):
    """One transition of an environment; leading axes are a batch."""

    observation: Float[Array, "*batch features"]
    action: Float[Array, "*batch actions"]
    reward: Float[Array, "*batch"]
    next_observation: Float[Array, "*batch features"]  # before any reset
    discount: Float[Array, "*batch"]  # 0 if the episode was terminated, else 1


class Replay(NamedTuple):
    """The buffer. Rows hold observation, action, next observation, reward and discount, in this
    order."""

    rows: Float[Array, "capacity numbers"]
    action: Float[Array, " actions"]  # zeros; holds the size of an action
    position: Int[Array, ""]  # next row to write
    size: Int[Array, ""]  # rows that hold a transition
    dropped: Int[Array, ""]  # transitions dropped so far


def init(capacity: int, observation_size: int, action_size: int) -> Replay:
    """An empty buffer; takes `4 capacity (2 observation_size + action_size + 2)` bytes."""
    rows = jnp.zeros((capacity, 2 * observation_size + action_size + 2), jnp.float32)

    # separate arrays, since a buffer can be donated only once
    def zero():
        return jnp.zeros((), jnp.int32)

    return Replay(rows, jnp.zeros(action_size, jnp.float32), zero(), zero(), zero())


def add(buffer: Replay, transitions: Transition) -> Replay:
    """Writes a batch of transitions, over the oldest ones if the buffer is full. The buffer has a
    capacity of at least the batch; transitions have one leading axis, and are of any floating point
    type."""
    capacity = buffer.rows.shape[0]
    columns = [jnp.asarray(x, jnp.float32) for x in transitions]
    observation, action, reward, next_observation, discount = columns
    rows = jnp.concatenate(
        [observation, action, next_observation, reward[:, None], discount[:, None]], axis=1
    )
    count = rows.shape[0]
    if count > capacity:
        raise ValueError(f"a batch of {count} transitions does not fit a buffer of {capacity}")
    finite = jnp.all(jnp.isfinite(rows), axis=1)
    after = jnp.cumsum(finite, dtype=jnp.int32)
    indices = jnp.where(finite, (buffer.position + after - 1) % capacity, capacity)
    written = after[-1]
    return buffer._replace(
        rows=buffer.rows.at[indices].set(rows, mode="drop"),
        position=(buffer.position + written) % capacity,
        size=jnp.minimum(buffer.size + written, capacity),
        dropped=buffer.dropped + count - written,
    )


def sample(buffer: Replay, key: Array, batch: int) -> Transition:
    """Transitions drawn uniformly with replacement; zeros from an empty buffer."""
    indices = jax.random.randint(key, (batch,), 0, jnp.maximum(buffer.size, 1), jnp.int32)
    rows = buffer.rows[indices]
    actions = buffer.action.shape[0]
    features = (rows.shape[1] - actions - 2) // 2
    observation, action, next_observation, last = jnp.split(
        rows, [features, features + actions, 2 * features + actions], axis=1
    )
    return Transition(observation, action, last[:, 0], next_observation, last[:, 1])
