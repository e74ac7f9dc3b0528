"""Square roots and quotients whose derivatives are finite wherever their values are.

The derivative of `sqrt` at zero is infinite, and `jnp.where` does not hide it: reverse
differentiation multiplies it by the zero of the branch that was not taken, which gives NaN. So the
operand is replaced before the operation where its value does not matter. Values are those of the
plain operations, bit by bit."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Float


def safe_sqrt(x: Float[Array, "..."]) -> Float[Array, "..."]:
    """`sqrt(x)` with derivative zero at zero; NaN and infinity as `jnp.sqrt`."""
    zero = x == 0
    return jnp.where(zero, jnp.zeros_like(x), jnp.sqrt(jnp.where(zero, jnp.ones_like(x), x)))


def safe_divide(x: Float[Array, "..."], y: Float[Array, "..."]) -> Float[Array, "..."]:
    """`x / y`; where y is zero it is infinite or NaN as always, and a constant to
    differentiation."""
    zero = y == 0
    return jnp.where(zero, lax.stop_gradient(x / y), x / jnp.where(zero, jnp.ones_like(y), y))
