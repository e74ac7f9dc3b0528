"""The replay buffer: order, wrap-around, sampling, and what it leaves out."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxba.training import replay
from jaxba.training.replay import Transition

FEATURES = 3
ACTIONS = 2


def transitions(first: int, count: int) -> Transition:
    """Transitions that carry their number in every place, each place with another fraction."""
    number = np.arange(first, first + count, dtype=np.float64)

    def wide(width, shift):
        return number[:, None] + shift + np.arange(width) / 64

    columns = (
        wide(FEATURES, 0.0),
        wide(ACTIONS, 0.25),
        number + 0.5,
        wide(FEATURES, 0.75),
        number % 2,
    )
    return Transition(*map(jnp.asarray, columns))


def numbers(buffer: replay.Replay) -> list[int]:
    """Numbers of the transitions in the buffer, in the order of its rows."""
    return [int(x) for x in buffer.rows[: int(buffer.size), 0]]


def test_wraps_around() -> None:
    buffer = replay.init(7, FEATURES, ACTIONS)
    for first in (0, 3, 6):
        buffer = replay.add(buffer, transitions(first, 3))
    assert numbers(buffer) == [7, 8, 2, 3, 4, 5, 6]
    assert int(buffer.position) == 2
    assert int(buffer.size) == 7
    assert numbers(replay.add(buffer, transitions(9, 7))) == [14, 15, 9, 10, 11, 12, 13]


def test_samples_what_was_added() -> None:
    buffer = replay.add(replay.init(8, FEATURES, ACTIONS), transitions(10, 5))
    got = replay.sample(buffer, jax.random.key(0), 2000)
    which = np.asarray(got.observation[:, 0], int)
    expected = transitions(10, 5)
    for column, everything in zip(got, expected, strict=True):
        assert column.dtype == jnp.float32
        np.testing.assert_array_equal(column, np.asarray(everything)[which - 10])
    shares = np.bincount(which - 10, minlength=5) / 2000
    np.testing.assert_allclose(shares, 0.2, atol=0.04)  # 4.5 standard deviations


def test_an_empty_buffer_gives_zeros() -> None:
    got = replay.sample(replay.init(4, FEATURES, ACTIONS), jax.random.key(0), 3)
    assert all(not np.any(column) for column in got)


@pytest.mark.parametrize("column", Transition._fields)
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e300])
def test_what_is_not_finite_is_left_out(column: str, bad: float) -> None:
    batch = transitions(0, 4)
    spoilt = np.array(getattr(batch, column))
    spoilt[1, ...] = bad  # 1e300 overflows float32
    buffer = replay.init(5, FEATURES, ACTIONS)
    for _ in range(2):
        buffer = replay.add(buffer, batch._replace(**{column: jnp.asarray(spoilt)}))
    assert numbers(buffer) == [3, 2, 3, 0, 2]
    assert np.all(np.isfinite(buffer.rows))
    assert int(buffer.dropped) == 2
    assert int(buffer.position) == 1


def test_a_batch_larger_than_the_buffer_is_refused() -> None:
    with pytest.raises(ValueError, match="does not fit"):
        replay.add(replay.init(3, FEATURES, ACTIONS), transitions(0, 4))


def test_compiled_and_batched() -> None:
    add = jax.jit(replay.add)
    buffer = replay.init(7, FEATURES, ACTIONS)
    for first in (0, 3, 6):
        buffer = add(buffer, transitions(first, 3))
    assert numbers(buffer) == [7, 8, 2, 3, 4, 5, 6]
    both = jax.tree.map(lambda x: jnp.stack([x, x]), buffer)
    batches = jax.tree.map(lambda *x: jnp.stack(x), transitions(20, 2), transitions(30, 2))
    added = jax.vmap(replay.add)(both, batches)
    for i, first in enumerate((20, 30)):
        assert numbers(jax.tree.map(lambda x, i=i: x[i], added)) == [
            7,
            8,
            first,
            first + 1,
            4,
            5,
            6,
        ]
