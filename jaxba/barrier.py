"""Boundaries: one that XLA does not fuse across, and one that makes it do one thing after another."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Float


def materialized(rows: Float[Array, "k n"]) -> Float[Array, "k n"]:
    """The same rows, made once and stored, for values that many later expressions share.

    XLA fuses what makes a value into everything that reads it and computes it again each time; it fused the rotation of
    a camera into the gather for its observations, and so took its sine once per observation (docs/optimisations.md). On
    a CPU `optimization_barrier` is dropped before fusion, so there an exact product with the unit matrix stands in for
    it: products are never fused. A non-finite entry spoils its column.
    """
    return lax.platform_dependent(rows, cpu=_times_one, default=lax.optimization_barrier)


def _times_one(rows: Array) -> Array:
    return jnp.matmul(jnp.eye(rows.shape[0], dtype=rows.dtype), rows, precision="highest")


def after(first: Array, then: Array) -> Array:
    """`then`, but not before `first` is there. A first entry of `first` that is not finite spoils it.

    For two batched LAPACK calls that do not need each other: XLA on a CPU runs them side by side, each waits for the
    threads that the other holds, and with two threads a solve stood still for ever (jax 0.10.2; random clusters on
    333 cameras). Zero times a float is not folded.
    """
    return then + 0 * jnp.ravel(first)[0]
