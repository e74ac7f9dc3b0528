"""What is stored once, or computed apart, is what was computed, also under JAX's transformations."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxba.runtime.barriers import apart, materialized


def rows(dtype=np.float64) -> np.ndarray:
    """Every magnitude that has no subnormal numbers in it, both signs, and zero."""
    rng = np.random.default_rng(0)
    limits = np.finfo(dtype)
    exponent = rng.uniform(np.log2(float(limits.tiny)), np.log2(float(limits.max)) - 1, size=(12, 50))
    values = (rng.choice([-1, 1], size=exponent.shape) * rng.uniform(1, 2, exponent.shape)).astype(dtype)
    values = np.ldexp(values, np.floor(exponent).astype(int))
    values[3, 7] = 0
    return values


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("wrap", [lambda f: f, jax.jit], ids=["plain", "jit"])
def test_every_value_stays_exactly_the_same(dtype, wrap):
    values = rows(dtype)
    found = wrap(materialized)(jnp.asarray(values))
    assert found.dtype == dtype
    assert np.array_equal(found, values)


def test_a_batch_is_materialized_as_its_members_are():
    batch = np.stack([rows(), -rows(), 0 * rows()])
    assert np.array_equal(jax.jit(jax.vmap(materialized))(batch), batch)
    assert np.array_equal(
        jax.jit(jax.vmap(materialized, in_axes=1, out_axes=1))(batch.swapaxes(0, 1)).swapaxes(0, 1), batch
    )


def test_derivatives_pass_through_unchanged_in_both_modes():
    values = np.random.default_rng(1).normal(size=(4, 6))
    weight = np.random.default_rng(2).normal(size=(4, 6))
    backward = jax.jit(jax.grad(lambda x: jnp.sum(weight * materialized(x) ** 2)))(values)
    np.testing.assert_allclose(backward, 2 * weight * values, rtol=1e-14)
    primal, tangent = jax.jit(lambda x, t: jax.jvp(materialized, (x,), (t,)))(values, weight)
    assert np.array_equal(primal, values)
    assert np.array_equal(tangent, weight)


def test_a_value_that_is_not_finite_stays_in_its_column():
    values = np.ones((3, 4))
    values[1, 2] = np.nan
    found = np.asarray(jax.jit(materialized)(values))
    assert np.isnan(found[1, 2])
    assert np.array_equal(np.delete(found, 2, axis=1), np.ones((3, 3)))


INDEX = np.arange(3, dtype=np.int32)


def squares(x, y):
    return x[:, :, None] * x[:, None, :] + y


@pytest.mark.parametrize("wrap", [lambda f: f, jax.jit], ids=["plain", "jit"])
def test_what_is_computed_apart_is_what_was_asked_for(wrap):
    x, y = jnp.asarray(np.random.default_rng(0).normal(size=(5, 4))), jnp.asarray(0.5)
    found = wrap(lambda x, y, index: apart(squares, x, y, index=index))(x, y, INDEX)
    assert np.array_equal(found, squares(x, y))


def test_a_batch_is_computed_apart_as_its_members_are():
    x, y = np.random.default_rng(0).normal(size=(3, 5, 4)), np.ones(3)
    found = jax.jit(jax.vmap(lambda x, y, index: apart(squares, x, y, index=index)))(x, y, np.stack([INDEX] * 3))
    assert np.array_equal(found, np.stack([squares(*one) for one in zip(x, y, strict=True)]))


def test_derivatives_pass_through_what_is_computed_apart():
    x, y = np.random.default_rng(0).normal(size=(5, 4)), jnp.asarray(0.5)
    there = jax.jit(jax.grad(lambda x, index: jnp.sum(apart(squares, x, y, index=index) ** 2)))(x, INDEX)
    here = jax.grad(lambda x: jnp.sum(squares(x, y) ** 2))(jnp.asarray(x))
    np.testing.assert_allclose(there, here, rtol=1e-13)


@pytest.mark.xla
@pytest.mark.skipif(jax.default_backend() != "cpu", reason="what XLA does on a CPU")
def test_what_is_computed_apart_is_a_computation_of_its_own():
    """So nothing is fused with it: what would be one kernel without is two, and a branch."""
    x, y = jnp.ones((5, 4)), jnp.asarray(0.5)
    fused = jax.jit(lambda x, index: squares(x, y) + index[0]).lower(x, INDEX).compile().as_text()
    walled = jax.jit(lambda x, index: apart(squares, x, y, index=index) + index[0]).lower(x, INDEX).compile().as_text()
    assert "conditional(" not in fused
    assert walled.count("conditional(") == 1
