"""A boundary that XLA does not fuse across."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Float


def materialized(rows: Float[Array, "k n"]) -> Float[Array, "k n"]:
    """The same rows, made once and stored, for values that many later expressions share.

    XLA fuses what makes a value into everything that reads it and computes it again each time; it fused the rotation of
    a camera into the gather for its observations, and so took its sine once per observation (docs/performance.md). On
    a CPU `optimization_barrier` is dropped before fusion, so there an exact product with the unit matrix stands in for
    it: products are never fused. A non-finite entry spoils its column.
    """
    return lax.platform_dependent(rows, cpu=_times_one, default=lax.optimization_barrier)


def _times_one(rows: Array) -> Array:
    return jnp.matmul(jnp.eye(rows.shape[0], dtype=rows.dtype), rows, precision="highest")
