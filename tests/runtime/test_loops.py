"""Loops that XLA does not take for small ones compute what those of `jax.lax` do."""

from __future__ import annotations

import re

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from jaxba.runtime import loops


def _collatz(loop, start):
    """Steps to one, and the largest number on the way."""

    def more(state):
        return state[0] > 1

    def step(state):
        return (
            n := jnp.where(state[0] % 2 == 0, state[0] // 2, 3 * state[0] + 1),
            jnp.maximum(state[1], n),
        )

    def count(state):
        return (*step(state[:2]), state[2] + 1)

    _, largest, steps = loop(more, count, (start, start, jnp.zeros_like(start)))
    return largest, steps


def test_a_while_loop_ends_by_its_condition():
    assert [int(x) for x in jax.jit(lambda n: _collatz(loops.while_loop, n))(27)] == [9232, 111]
    assert [int(x) for x in _collatz(loops.while_loop, jnp.asarray(1))] == [1, 0]


def test_scenes_of_a_batch_end_on_their_own():
    starts = jnp.arange(1, 40)
    found, right = (
        jax.vmap(lambda n, loop=loop: _collatz(loop, n))(starts)
        for loop in (loops.while_loop, lax.while_loop)
    )
    chex.assert_trees_all_equal(found, right)


@pytest.mark.parametrize(("first", "end"), [(0, 5), (3, 5), (2, 2), (4, 1)])
def test_a_counted_loop_has_the_counts_of_lax(first, end):
    def body(k, total):
        return 10 * total + k

    found = jax.jit(lambda end: loops.fori_loop(first, end, body, jnp.asarray(7)))(end)
    assert int(found) == int(lax.fori_loop(first, end, body, jnp.asarray(7)))


def test_rows_are_mapped_in_order():
    rows = {"a": jnp.arange(12.0).reshape(4, 3), "b": jnp.arange(4)}

    def function(row):
        return (row["a"].sum() + row["b"], row["b"] > 1)

    chex.assert_trees_all_equal(
        jax.jit(lambda r: loops.map_rows(function, r))(rows), lax.map(function, rows)
    )


@pytest.mark.xla
@pytest.mark.skipif(jax.default_backend() != "cpu", reason="about XLA on a CPU")
def test_xla_does_not_take_a_loop_over_long_vectors_for_a_small_one():
    """It compiles small loops to calls of one function, marked as such, which runs on one core."""

    def program(fori_loop):
        def body(k, x):
            return lax.cond(x[0] > k, lambda x: x[::-1] + 1, lambda x: 2 * x, x)

        return (
            jax.jit(lambda x: fori_loop(0, 10, body, x)).lower(np.ones(100_000)).compile().as_text()
        )

    assert "xla_cpu_small_call" not in program(loops.fori_loop)
    if "xla_cpu_small_call" not in program(lax.fori_loop):
        pytest.skip("this jaxlib takes no such loop for a small one: the loops of jax.lax would do")


@pytest.mark.parametrize("needed", [True, False])
def test_what_is_not_needed_is_the_other_value(needed):
    found = jax.jit(lambda n, x: loops.run_if(n, lambda x: 2 * x, (x,), x + 1))(
        needed, jnp.arange(3.0)
    )
    np.testing.assert_array_equal(found, [0, 2, 4] if needed else [1, 2, 3])


def test_members_of_a_batch_need_it_or_not():
    needed = jnp.asarray([True, False])
    x = jnp.arange(6.0).reshape(2, 3)
    found = jax.vmap(lambda n, x: loops.run_if(n, lambda x: 2 * x, (x,), -x))(needed, x)
    np.testing.assert_array_equal(found, jnp.stack([2 * x[0], -x[1]]))


def _always(text: str, operation: str) -> bool:
    """Whether a compiled program has an operation outside of its loops."""
    parts = {
        name: part
        for part in text.split("\n\n")
        if (name := re.search(r"^(?:ENTRY )?%?([\w.-]+) ", part, re.M))
    }
    parts = {name[1]: part for name, part in parts.items()}
    (entry,) = (part for part in parts.values() if part.lstrip().startswith("ENTRY"))
    fused = [parts[name] for name in re.findall(r"calls=%?([\w.-]+)", entry)]
    return any(f" {operation}(" in part for part in [entry, *fused])


@pytest.mark.xla
def test_what_is_not_needed_is_not_computed():
    """XLA takes what does not change in a loop out of it: so it does where the arguments pass no
    barrier."""

    def without(needed, f, x, otherwise):
        return loops.fori_loop(0, needed.astype(int), lambda *_: f(*x), otherwise)

    text = {
        run: jax.jit(lambda n, x, run=run: run(n, jnp.sin, (x,), x))
        .lower(True, np.ones(1000))
        .compile()
        .as_text()
        for run in (loops.run_if, without)
    }
    assert "sine" in text[loops.run_if]
    assert not _always(text[loops.run_if], "sine")
    assert _always(text[without], "sine")
