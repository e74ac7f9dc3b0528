"""Vectors that are made together are what they are one by one, in one loop on a CPU."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxba.runtime.single_loop import in_haste, together


def vectors(pair, scale, mask):
    """Three vectors that share a quotient; some of it is masked, as empty slots are."""
    shared = jnp.where(mask, pair[0] / pair[1], 0)
    return [shared * scale, shared * shared - pair[0], jnp.sqrt(jnp.abs(shared)) + scale]


def given(dtype=np.float64, n=37):
    rng = np.random.default_rng(0)
    return jnp.asarray(rng.normal(size=(2, n)), dtype), jnp.asarray(rng.normal(size=n), dtype), rng.random(n) < 0.8


@pytest.mark.parametrize("haste", [False, True], ids=["together", "in haste"])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_each_vector_is_what_it_is_alone(dtype, haste):
    operands = given(dtype)
    with in_haste(haste):
        found = jax.jit(lambda *x: together(vectors, *x))(*operands)
    for row, truth in zip(found, jax.jit(vectors)(*operands), strict=True):
        assert row.dtype == dtype
        np.testing.assert_allclose(row, truth, rtol=4 * np.finfo(dtype).eps, atol=np.finfo(dtype).eps)


def test_numbers_that_are_not_finite_stay_where_they_are():
    """The half of the loop that is dropped must not spoil the other: nothing is multiplied by zero."""
    x = jnp.asarray([1.0, np.nan, np.inf, -np.inf, 0.0])
    first, second = jax.jit(lambda x: together(lambda x: [x, 1 / x], x))(x)
    np.testing.assert_array_equal(first, x)
    np.testing.assert_array_equal(second, [1, np.nan, 0, 0, np.inf])


def test_a_batch_is_made_as_its_members_are():
    one, scale, mask = given()
    many = jnp.stack([one, -one, 2 * one])
    found = jax.jit(jax.vmap(lambda pair: together(vectors, pair, scale, mask)))(many)
    alone = [together(vectors, pair, scale, mask) for pair in many]
    for row, truth in zip(found, zip(*alone, strict=True), strict=True):
        np.testing.assert_allclose(row, jnp.stack(truth), rtol=1e-14, atol=1e-15)


def test_derivatives_pass_through_what_is_made_together():
    pair, scale, mask = given()
    both = lambda make: lambda pair: sum(jnp.sum(row**2) for row in make(vectors, pair, scale, mask))
    ours, truth = both(together), both(lambda function, *operands: function(*operands))
    np.testing.assert_allclose(jax.jit(jax.grad(ours))(pair), jax.grad(truth)(pair), rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(jax.jvp(ours, (pair,), (pair,))[1], jax.jvp(truth, (pair,), (pair,))[1], rtol=1e-12)


def test_trees_of_vectors_are_taken_as_operands():
    pair, scale, mask = given()
    found = together(
        lambda tree, mask: vectors(tree["pair"], tree["scale"], mask), {"pair": list(pair), "scale": scale}, mask
    )
    for row, truth in zip(found, vectors(pair, scale, mask), strict=True):
        np.testing.assert_allclose(row, truth, rtol=1e-14, atol=1e-15)


@pytest.mark.xla
@pytest.mark.skipif(jax.default_backend() != "cpu", reason="what XLA does on a CPU")
def test_many_vectors_come_out_of_one_loop():
    """As a reduction with as many results as there are vectors; one by one each has its own loop."""

    def results(haste: bool) -> list[int]:
        with in_haste(haste):
            lowered = jax.jit(lambda x, y: together(lambda x, y: [x * y + k for k in range(9)], x, y)).lower(
                *given()[0]
            )
        text = lowered.compile().as_text()
        entry = text[text.index("ENTRY") :].splitlines()
        return [line.split(" fusion(")[0].count("f64[") for line in entry if " fusion(" in line]

    assert max(results(False)) == 9
    assert max(results(True)) == 1


def test_what_is_compiled_in_haste_is_traced_anew():
    """The same function is another program then."""
    seen = []

    @jax.jit
    def function(x):
        seen.append(in_haste.value)
        return x

    for haste in (False, True, False, True):
        with in_haste(haste):
            function(1.0)
    assert seen == [False, True]


@pytest.mark.xla
@pytest.mark.skipif(jax.default_backend() != "cpu", reason="what XLA does on a CPU")
def test_a_single_vector_is_no_sum():
    """XLA hands a sum of one operand to a library, with its operand stored for both halves."""
    text = jax.jit(lambda x: together(lambda x: [x * x + 1], x)).lower(given()[1]).compile().as_text()
    assert "reduce(" not in text
