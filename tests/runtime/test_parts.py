"""A program over parts gives what `jax.vmap` with an axis name gives, and keeps one part in memory
at a time."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from jaxba.runtime import loops
from jaxba.runtime.parts import in_turns, kept

PARTS = 4
SIZE = 5


def compare(function, divided, outputs, *arguments):
    """Both ways, on arguments of which the divided ones have a leading axis."""

    def axes(flags):
        return jax.tree.map(lambda one: 0 if one else None, flags)

    batched = jax.vmap(function, axes(divided), axes(outputs), axis_name="parts")
    in_parts = jax.jit(lambda *given: in_turns(function, "parts", given, divided, outputs))
    for found, wanted in zip(
        jax.tree.leaves(in_parts(*arguments)), jax.tree.leaves(batched(*arguments)), strict=True
    ):
        np.testing.assert_allclose(found, wanted, rtol=1e-12, atol=1e-12)


@pytest.fixture
def rows():
    return jnp.asarray(np.random.default_rng(0).normal(size=(PARTS, SIZE)))


def test_sums_of_sums_maxima_and_divided_results_are_those_of_a_batch(rows):
    def function(x, y):
        scaled = kept(jnp.sin(x) * y)
        total = lax.psum((scaled.sum(), x), "parts")
        greatest = lax.pmax(scaled.max(), "parts")
        return (
            total[0] * greatest,
            lax.psum(scaled * greatest, "parts"),
            scaled + total[1],
            lax.psum(y, "parts"),
        )

    compare(function, (True, False), (False, False, True, False), rows, jnp.asarray(2.0))


def test_loops_whose_state_is_divided_in_part_and_conditions_are_those_of_a_batch(rows):
    def function(x, tolerance):
        def body(state):
            values, _, count = state
            change = lax.psum(jnp.sum(values * x), "parts") / 50
            return jnp.where(count > 1, values * 0.5, values) + change, jnp.abs(change), count + 1

        start = x * 2, jnp.asarray(np.inf), jnp.asarray(0)
        values, change, count = loops.while_loop(
            lambda now: (now[1] > tolerance) & (now[2] < 20), body, start
        )

        def squares():
            return lax.psum(jnp.sum(values**2), "parts")

        inner = lax.cond(count > 3, squares, lambda: change)
        refined = loops.run_if(
            count > 2, lambda y: y + lax.psum(y.sum(), "parts"), (values,), values
        )
        return values, count, inner, refined

    compare(function, (True, False), (True, False, False, True), rows, jnp.asarray(1e-3))


def test_loops_and_conditions_of_a_single_part_are_its_own(rows):
    def function(x):
        root = lax.while_loop(
            lambda y: jnp.abs(y * y - x[0] ** 2) > 1e-12, lambda y: (y + x[0] ** 2 / y) / 2, 1.0
        )
        signed = lax.cond(x[0] > 0, lambda: root, lambda: -root)
        return signed, lax.psum(signed, "parts")

    compare(function, (True,), (True, False), rows)


def test_a_result_that_should_be_the_same_everywhere_is_refused_if_it_differs(rows):
    with pytest.raises(ValueError, match=r"results \[0\] differ between the parts"):
        in_turns(lambda x: x.sum(), "parts", (rows,), (True,), False)


def test_memory_is_that_of_one_part():
    parts = 64
    size = 1024
    width = 32

    def function(x):
        wide = jnp.sin(jnp.outer(jnp.arange(1.0, width), x))

        def product(y):
            return lax.psum(wide @ (wide.T @ y), "parts")

        return loops.fori_loop(
            0, 3, lambda _, y: product(y) / jnp.linalg.norm(y), jnp.ones(width - 1)
        )

    x = jnp.zeros((parts, size))
    program = (
        jax.jit(lambda x: in_turns(function, "parts", (x,), (True,), False)).lower(x).compile()
    )
    memory = program.memory_analysis()
    assert memory is not None
    # of all parts it would be 64 times as much
    assert memory.temp_size_in_bytes < 4 * width * size * x.itemsize
