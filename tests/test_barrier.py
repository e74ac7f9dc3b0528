"""What is stored once is what was computed, also under JAX's transformations."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxba.barrier import materialized


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
