"""Cholesky factorisation and solution of one dense system.

On a CPU the factorisation of a large system runs in panels whose updates are matrix products: these use all cores and
the widest vectors, LAPACK's own one core (`process.single_blas_thread` says why). The diagonal block of a panel is
inverted, so that the rows below are a product too. Source: Golub and Van Loan, "Matrix Computations", section 4.2.9
(blocked left-looking Cholesky); inverted diagonal blocks as in MAGMA's trsm.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array, lax
from jax.scipy.linalg import solve_triangular
from jaxtyping import Float

PANEL = 128
"""Columns of a panel: 1350 unknowns took 11 ms with 128, 13 with 192, 16 with 256 and 20 in one LAPACK call."""

MAX_PANELS = 24
"""Panels are written out one by one, so that their number is a program size."""

MIN_UNKNOWNS = 512
"""Smaller systems are left to LAPACK: 441 unknowns take 1 ms either way."""


class Panels(NamedTuple):
    """A Cholesky factor by panels."""

    inverses: list[Float[Array, "size size"]]  # of the diagonal blocks
    below: list[Float[Array, "rest size"]]  # rows below them

    def solve(self, right: Float[Array, " n"]) -> Float[Array, " n"]:
        """Solves `L L^T x = b`."""
        halves = []
        for inverse, below in zip(self.inverses, self.below, strict=True):
            size = inverse.shape[0]
            half = jnp.matmul(inverse, right[:size], precision="highest")
            right = right[size:] - jnp.matmul(below, half, precision="highest")
            halves.append(half)
        after = right  # empty by now
        for inverse, below, half in zip(reversed(self.inverses), reversed(self.below), reversed(halves), strict=True):
            known = jnp.matmul(below.T, after, precision="highest")
            after = jnp.concatenate([jnp.matmul(inverse.T, half - known, precision="highest"), after])
        return after


def factor_and_solve(matrix: Float[Array, "n n"], right: Float[Array, " n"]) -> Float[Array, " n"]:
    """Solves `A x = b` for a symmetric positive definite matrix after Jacobi scaling.

    Args:
        matrix: only its lower triangle is read.
        right: `b`.

    Returns:
        The solution; not finite where the matrix is not positive definite.
    """
    scale = lax.rsqrt(jnp.diagonal(matrix))
    scaled = matrix * scale[:, None] * scale
    if matrix.shape[0] < MIN_UNKNOWNS:
        return _whole(scaled, right * scale) * scale
    by_panels = lambda a, b: factor_panels(a).solve(b)
    return lax.platform_dependent(scaled, right * scale, cpu=by_panels, default=_whole) * scale


def _whole(matrix: Array, right: Array) -> Array:
    factor = jnp.linalg.cholesky(matrix, symmetrize_input=False)
    half = solve_triangular(factor, right, lower=True)
    return solve_triangular(factor, half, lower=True, trans="T")


def factor_panels(matrix: Float[Array, "n n"], least: int | None = None) -> Panels:
    """Left-looking factorisation of a matrix with a diagonal near one: a panel subtracts all earlier ones first.

    Args:
        matrix: symmetric; its lower triangle is read.
        least: columns of a panel at least, `PANEL` where nothing is said.
    """
    n = matrix.shape[0]
    width = max(least or PANEL, -(-n // MAX_PANELS))
    inverses, belows = [], []
    for number, start in enumerate(range(0, n, width)):
        size = min(width, n - start)
        panel = matrix[start:, start : start + size]
        if number:
            # the rows below panel k begin where panel k + 1 begins
            parts = [below[(number - 1 - k) * width :] for k, below in enumerate(belows)]
            earlier = jnp.concatenate(parts, axis=1)
            panel = panel - jnp.matmul(earlier, earlier[:size].T, precision="highest")
        factor = jnp.linalg.cholesky(panel[:size], symmetrize_input=False)
        inverses.append(solve_triangular(factor, jnp.eye(size, dtype=matrix.dtype), lower=True))
        belows.append(jnp.matmul(panel[size:], inverses[-1].T, precision="highest"))
    return Panels(inverses, belows)


def solve_positive(matrix: Float[Array, "n k k"], right: Float[Array, "n k"]) -> Float[Array, "n k"]:
    """Solves many small positive definite systems by Gauss-Jordan elimination without pivoting.

    Written out instead of calling LAPACK: a batch of such calls inside nested loops never returned on a CPU (jax
    0.10.2, two threads, 64 scenes of 10 cameras).
    """
    table = jnp.concatenate([matrix, right[:, :, None]], axis=2)
    for k in range(matrix.shape[-1]):
        row = table[:, k] / table[:, k, k, None]
        table = (table - table[:, :, k, None] * row[:, None]).at[:, k].set(row)
    return table[:, :, -1]
