"""What changes how XLA fuses a computation changes no result, also under JAX's transformations."""

from __future__ import annotations

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from absl.testing import parameterized

from jaxba.runtime.fusion import (
    compute_in_one_loop,
    compute_unfused,
    computed_after,
    fast_compilation,
    fusion_barrier,
)


def rows(dtype=np.float64) -> np.ndarray:
    """Every magnitude that has no subnormal numbers in it, both signs, and zero."""
    rng = np.random.default_rng(0)
    limits = np.finfo(dtype)
    exponent = rng.uniform(
        np.log2(float(limits.tiny)), np.log2(float(limits.max)) - 1, size=(12, 50)
    )
    values = (rng.choice([-1, 1], size=exponent.shape) * rng.uniform(1, 2, exponent.shape)).astype(
        dtype
    )
    values = np.ldexp(values, np.floor(exponent).astype(int))
    values[3, 7] = 0
    return values


class JittedAndNot(chex.TestCase):
    """Every test runs twice: `self.variant` is `jax.jit`, or leaves a function as it is."""

    @chex.variants(with_jit=True, without_jit=True)
    @parameterized.parameters(np.float32, np.float64)
    def test_a_barrier_changes_no_bit(self, dtype):
        values = rows(dtype)
        found = self.variant(fusion_barrier)(jnp.asarray(values))
        assert found.dtype == dtype
        assert np.array_equal(found, values)

    @chex.variants(with_jit=True, without_jit=True)
    def test_unfused_computation_changes_no_bit(self):
        x = jnp.asarray(np.random.default_rng(0).normal(size=(5, 4)))
        y = jnp.asarray(0.5)
        found = self.variant(lambda x, y, index: compute_unfused(squares, x, y, index=index))(
            x, y, INDEX
        )
        assert np.array_equal(found, squares(x, y))


def test_a_barrier_maps_over_a_batch():
    batch = np.stack([rows(), -rows(), 0 * rows()])
    assert np.array_equal(jax.jit(jax.vmap(fusion_barrier))(batch), batch)
    assert np.array_equal(
        jax.jit(jax.vmap(fusion_barrier, in_axes=1, out_axes=1))(batch.swapaxes(0, 1)).swapaxes(
            0, 1
        ),
        batch,
    )


def test_derivatives_pass_a_barrier_unchanged_in_both_modes():
    values = np.random.default_rng(1).normal(size=(4, 6))
    weight = np.random.default_rng(2).normal(size=(4, 6))
    backward = jax.jit(jax.grad(lambda x: jnp.sum(weight * fusion_barrier(x) ** 2)))(values)
    np.testing.assert_allclose(backward, 2 * weight * values, rtol=1e-14)
    primal, tangent = jax.jit(lambda x, t: jax.jvp(fusion_barrier, (x,), (t,)))(values, weight)
    assert np.array_equal(primal, values)
    assert np.array_equal(tangent, weight)


def test_a_value_that_is_not_finite_stays_in_its_column():
    values = np.ones((3, 4))
    values[1, 2] = np.nan
    found = np.asarray(jax.jit(fusion_barrier)(values))
    assert np.isnan(found[1, 2])
    assert np.array_equal(np.delete(found, 2, axis=1), np.ones((3, 3)))


INDEX = np.arange(3, dtype=np.int32)


def squares(x, y):
    return x[:, :, None] * x[:, None, :] + y


def test_unfused_computation_maps_over_a_batch():
    x = np.random.default_rng(0).normal(size=(3, 5, 4))
    y = np.ones(3)
    found = jax.jit(jax.vmap(lambda x, y, index: compute_unfused(squares, x, y, index=index)))(
        x, y, np.stack([INDEX] * 3)
    )
    assert np.array_equal(found, np.stack([squares(*one) for one in zip(x, y, strict=True)]))


def test_derivatives_pass_unfused_computation():
    x = np.random.default_rng(0).normal(size=(5, 4))
    y = jnp.asarray(0.5)
    there = jax.jit(
        jax.grad(lambda x, index: jnp.sum(compute_unfused(squares, x, y, index=index) ** 2))
    )(x, INDEX)
    here = jax.grad(lambda x: jnp.sum(squares(x, y) ** 2))(jnp.asarray(x))
    np.testing.assert_allclose(there, here, rtol=1e-13)


def test_a_dependency_leaves_the_value_as_it_is():
    first = jnp.asarray([2.0, jnp.inf])
    value = jnp.asarray([[1.0, -3.0], [0.0, 5.0]])
    assert np.array_equal(jax.jit(computed_after)(first, value), value)
    assert np.isnan(computed_after(first[1:], value)).all()


@pytest.mark.xla
@pytest.mark.skipif(jax.default_backend() != "cpu", reason="what XLA does on a CPU")
def test_unfused_computation_is_a_branch_of_its_own():
    """XLA fuses nothing into a branch: one kernel becomes two and a conditional."""
    x = jnp.ones((5, 4))
    y = jnp.asarray(0.5)
    fused = jax.jit(lambda x, index: squares(x, y) + index[0]).lower(x, INDEX).compile().as_text()
    unfused = (
        jax.jit(lambda x, index: compute_unfused(squares, x, y, index=index) + index[0])
        .lower(x, INDEX)
        .compile()
        .as_text()
    )
    assert "conditional(" not in fused
    assert unfused.count("conditional(") == 1


def vectors(pair, scale, mask):
    """Three vectors that share a quotient; some of it is masked, as padding is."""
    shared = jnp.where(mask, pair[0] / pair[1], 0)
    return [shared * scale, shared * shared - pair[0], jnp.sqrt(jnp.abs(shared)) + scale]


def given(dtype=np.float64, n=37):
    rng = np.random.default_rng(0)
    return (
        jnp.asarray(rng.normal(size=(2, n)), dtype),
        jnp.asarray(rng.normal(size=n), dtype),
        rng.random(n) < 0.8,
    )


@pytest.mark.parametrize("fast", [False, True], ids=["optimised", "fast"])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_each_vector_is_what_it_is_in_a_loop_of_its_own(dtype, fast):
    operands = given(dtype)
    with fast_compilation(fast):
        found = jax.jit(lambda *x: compute_in_one_loop(vectors, *x))(*operands)
    for row, truth in zip(found, jax.jit(vectors)(*operands), strict=True):
        assert row.dtype == dtype
        np.testing.assert_allclose(
            row, truth, rtol=4 * np.finfo(dtype).eps, atol=np.finfo(dtype).eps
        )


def test_numbers_that_are_not_finite_stay_in_their_vector():
    """The half of the loop that is dropped must not spoil the other: nothing is multiplied by
    zero."""
    x = jnp.asarray([1.0, np.nan, np.inf, -np.inf, 0.0])
    first, second = jax.jit(lambda x: compute_in_one_loop(lambda x: [x, 1 / x], x))(x)
    np.testing.assert_array_equal(first, x)
    np.testing.assert_array_equal(second, [1, np.nan, 0, 0, np.inf])


def test_one_loop_maps_over_a_batch():
    one, scale, mask = given()
    many = jnp.stack([one, -one, 2 * one])
    found = jax.jit(jax.vmap(lambda pair: compute_in_one_loop(vectors, pair, scale, mask)))(many)
    alone = [compute_in_one_loop(vectors, pair, scale, mask) for pair in many]
    for row, truth in zip(found, zip(*alone, strict=True), strict=True):
        np.testing.assert_allclose(row, jnp.stack(truth), rtol=1e-14, atol=1e-15)


def test_derivatives_pass_through_one_loop():
    pair, scale, mask = given()

    def both(make):
        return lambda pair: sum(jnp.sum(row**2) for row in make(vectors, pair, scale, mask))

    ours = both(compute_in_one_loop)
    truth = both(lambda function, *operands: function(*operands))
    np.testing.assert_allclose(
        jax.jit(jax.grad(ours))(pair), jax.grad(truth)(pair), rtol=1e-12, atol=1e-12
    )
    np.testing.assert_allclose(
        jax.jvp(ours, (pair,), (pair,))[1], jax.jvp(truth, (pair,), (pair,))[1], rtol=1e-12
    )


def test_trees_of_vectors_are_taken_as_operands():
    pair, scale, mask = given()
    found = compute_in_one_loop(
        lambda tree, mask: vectors(tree["pair"], tree["scale"], mask),
        {"pair": list(pair), "scale": scale},
        mask,
    )
    for row, truth in zip(found, vectors(pair, scale, mask), strict=True):
        np.testing.assert_allclose(row, truth, rtol=1e-14, atol=1e-15)


@pytest.mark.xla
@pytest.mark.skipif(jax.default_backend() != "cpu", reason="what XLA does on a CPU")
def test_many_vectors_come_out_of_one_loop():
    """As a reduction with as many results as there are vectors; one by one each has its own
    loop."""

    def results(fast: bool) -> list[int]:
        with fast_compilation(fast):
            lowered = jax.jit(
                lambda x, y: compute_in_one_loop(lambda x, y: [x * y + k for k in range(9)], x, y)
            ).lower(*given()[0])
        text = lowered.compile().as_text()
        entry = text[text.index("ENTRY") :].splitlines()
        return [line.split(" fusion(")[0].count("f64[") for line in entry if " fusion(" in line]

    assert max(results(False)) == 9
    assert max(results(True)) == 1


def test_fast_compilation_is_traced_anew():
    """The same function is another program then."""
    seen = []

    @jax.jit
    def function(x):
        seen.append(fast_compilation.value)
        return x

    for fast in (False, True, False, True):
        with fast_compilation(fast):
            function(1.0)
    assert seen == [False, True]


@pytest.mark.xla
@pytest.mark.skipif(jax.default_backend() != "cpu", reason="what XLA does on a CPU")
def test_a_single_vector_is_no_sum():
    """XLA hands a sum of one operand to a library, with its operand stored for both halves."""
    text = (
        jax.jit(lambda x: compute_in_one_loop(lambda x: [x * x + 1], x))
        .lower(given()[1])
        .compile()
        .as_text()
    )
    assert "reduce(" not in text
