"""A function of one row, as operations on vectors, has the values and derivatives of JAX's mapped
function."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxba.model.vectors import Traced, numbers_of

FUNCTIONS = {
    "matrices": lambda a, b, s: jnp.concatenate(
        [a @ b, b @ a, (a.T @ a).ravel(), jnp.outer(b, b)[1], a.sum(axis=1) * s]
    ),
    "parts": lambda a, b, s: jnp.concatenate(
        [b[::-1], a[1:, 0], jnp.cross(b, a[0]), jnp.split(b, 3)[1], a.T[2] / s]
    ),
    "rows and columns": lambda a, b, s: jnp.stack([*b, *a[:, 1]]) + jnp.broadcast_to(s, 6),
    "branches": lambda a, b, s: (
        jnp.where(b > 0, jnp.sin(b), jnp.exp(-b)) + jnp.maximum(s, a[0]) + jnp.clip(b, -1, 1)
    ),
    "jitted": lambda a, b, s: jnp.linalg.norm(a, axis=1) * jnp.arctan2(b, s) + jnp.square(b) ** 3,
    "constants": lambda a, b, s: np.arange(3.0) * b + np.eye(3)[1] @ a - 2,
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_vectors_are_those_of_the_mapped_function(name):
    function = FUNCTIONS[name]
    random = np.random.default_rng(0)
    given = [jnp.asarray(random.standard_normal((*shape, 7))) for shape in ((3, 3), (3,), ())]
    numbers = [numbers_of(x, x.ndim - 1) for x in given]
    traced = Traced(function, *numbers)
    np.testing.assert_allclose(
        jnp.stack([*traced(*numbers).flat]), jax.vmap(function, -1, -1)(*given), rtol=1e-12
    )

    def last(second):
        return traced(numbers[0], numbers_of(second, 1), numbers[2]).flat[-1].sum()

    wanted = jax.grad(
        lambda second: jax.vmap(function, -1, -1)(given[0], second, given[2])[-1].sum()
    )(given[1])
    np.testing.assert_allclose(jax.grad(last)(given[1]), wanted, rtol=1e-12, atol=1e-15)


def test_a_function_without_a_rule_is_refused():
    numbers = numbers_of(jnp.ones((3, 7)), 1)
    with pytest.raises(NotImplementedError, match="sort"):
        Traced(jnp.sort, numbers)(numbers)
