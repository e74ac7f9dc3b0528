"""Cholesky factorisation of many 3 x 3 systems, one per column, entry by entry."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

# least pivot, in machine epsilons of its diagonal: with parallel rays a step stays finite
PIVOT_FLOOR = 16.0


class Cholesky3(NamedTuple):
    """Lower factor; diagonal entries are stored as reciprocals."""

    r00: Float[Array, " n"]
    l10: Float[Array, " n"]
    r11: Float[Array, " n"]
    l20: Float[Array, " n"]
    l21: Float[Array, " n"]
    r22: Float[Array, " n"]

    def forward(self, b: list[Array]) -> list[Array]:
        """Solves `L x = b` for right-hand sides given as three vectors."""
        x0 = b[0] * self.r00
        x1 = (b[1] - self.l10 * x0) * self.r11
        x2 = (b[2] - self.l20 * x0 - self.l21 * x1) * self.r22
        return [x0, x1, x2]

    def backward(self, b: list[Array]) -> list[Array]:
        """Solves `L^T x = b`."""
        x2 = b[2] * self.r22
        x1 = (b[1] - self.l21 * x2) * self.r11
        x0 = (b[0] - self.l10 * x1 - self.l20 * x2) * self.r00
        return [x0, x1, x2]


def cholesky3(matrix: list[Array]) -> Cholesky3:
    """Factors matrices given as the six vectors (00, 10, 11, 20, 21, 22)."""
    a00, a10, a11, a20, a21, a22 = matrix
    floor = PIVOT_FLOOR * jnp.finfo(a00.dtype).eps
    r00 = _reciprocal_root(a00, a00 * floor)
    l10 = a10 * r00
    r11 = _reciprocal_root(a11 - l10 * l10, a11 * floor)
    l20 = a20 * r00
    l21 = (a21 - l20 * l10) * r11
    r22 = _reciprocal_root(a22 - l20 * l20 - l21 * l21, a22 * floor)
    return Cholesky3(r00, l10, r11, l20, l21, r22)


def _reciprocal_root(pivot: Array, floor: Array) -> Array:
    return 1 / jnp.sqrt(jnp.maximum(pivot, floor))
