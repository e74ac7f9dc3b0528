"""Cholesky factorisation of dense systems.

On a CPU, large systems are factored in panels whose updates are matrix products. XLA runs these on
all cores, while LAPACK is limited to one (`process.single_blas_thread` says why). The diagonal
block of a panel is inverted, so that the rows below it are a product too. Source: Golub and Van
Loan, "Matrix Computations", section 4.2.9 (blocked left-looking Cholesky); inverted diagonal blocks
as in MAGMA's trsm."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.scipy.linalg import solve_triangular
from jaxtyping import Float

from jaxba.runtime import loops

# columns of a panel. With 1350 unknowns: 11 ms with 128, 13 with 192, 16 with 256, 20 in one LAPACK
# call
PANEL = 128
# most panels. The loop over them is unrolled, so their number decides the size of the program.
MAX_PANELS = 24
# smaller systems go to LAPACK: 441 unknowns were measured to take 1 ms either way
MIN_UNKNOWNS = 512


class Panels(NamedTuple):
    """Cholesky factor L in panels of columns."""

    inverses: list[Float[Array, "size size"]]  # of the diagonal blocks
    below: list[Float[Array, "rest size"]]  # the rows of L below each diagonal block

    def solve(self, right: Float[Array, "n ..."]) -> Float[Array, "n ..."]:
        """Solves `L L^T x = b`."""
        halves = []
        for inverse, below in zip(self.inverses, self.below, strict=True):
            size = inverse.shape[0]
            half = jnp.matmul(inverse, right[:size], precision="highest")
            right = right[size:] - jnp.matmul(below, half, precision="highest")
            halves.append(half)
        after = right  # empty after the forward substitution
        for inverse, below, half in zip(
            reversed(self.inverses), reversed(self.below), reversed(halves), strict=True
        ):
            known = jnp.matmul(below.T, after, precision="highest")
            after = jnp.concatenate(
                [jnp.matmul(inverse.T, half - known, precision="highest"), after]
            )
        return after


@jax.custom_jvp
def lower_cholesky(matrix: Float[Array, "*batch n n"]) -> Float[Array, "*batch n n"]:
    """The lower Cholesky factor of matrices of which only the lower triangle is read, also by the
    derivative. Returns L with `A = L L^T`; non-finite if a matrix is not positive definite."""
    return jnp.linalg.cholesky(matrix, symmetrize_input=False)


@lower_cholesky.defjvp
def _lower_cholesky_jvp(matrix: tuple[Array], change: tuple[Array]) -> tuple[Array, Array]:
    """JAX's own rule takes the tangent for symmetric, and would be wrong where only its lower
    triangle is filled."""
    full = jnp.tril(change[0]) + jnp.tril(change[0], -1).mT

    def factored(a):
        return jnp.linalg.cholesky(a, symmetrize_input=False)

    return jax.jvp(factored, matrix, (full,))


def factor_and_solve(
    matrix: Float[Array, "n n"], right: Float[Array, "n ..."]
) -> Float[Array, "n ..."]:
    """Solves `A x = b` for a symmetric positive definite matrix, by its lower triangle, after
    Jacobi scaling; `right` is `b`, or several as columns. Non-finite if the matrix is not positive
    definite."""
    scale = lax.rsqrt(jnp.diagonal(matrix))
    scaled = matrix * scale[:, None] * scale
    rows = scale if right.ndim == 1 else scale[:, None]
    if matrix.shape[0] < MIN_UNKNOWNS:
        return _lapack_solve(scaled, right * rows) * rows

    def by_panels(a, b):
        return factor_panels(a).solve(b)

    return lax.platform_dependent(scaled, right * rows, cpu=by_panels, default=_lapack_solve) * rows


def _lapack_solve(matrix: Array, right: Array) -> Array:
    factor = lower_cholesky(matrix)
    half = solve_triangular(factor, right, lower=True)
    return solve_triangular(factor, half, lower=True, trans="T")


def factor_panels(matrix: Float[Array, "n n"], least: int | None = None) -> Panels:
    """Left-looking Cholesky factorisation: each panel first subtracts all earlier products. The
    matrix is symmetric, its diagonal near one; its lower triangle is read. `least` is the fewest
    columns of a panel; `PANEL` if None."""
    n = matrix.shape[0]
    width = max(least or PANEL, -(-n // MAX_PANELS))
    inverses = []
    belows = []
    for number, start in enumerate(range(0, n, width)):
        size = min(width, n - start)
        panel = matrix[start:, start : start + size]
        if number:
            # the rows below panel k begin where panel k + 1 begins
            parts = [below[(number - 1 - k) * width :] for k, below in enumerate(belows)]
            earlier = jnp.concatenate(parts, axis=1)
            panel = panel - jnp.matmul(earlier, earlier[:size].T, precision="highest")
        factor = lower_cholesky(panel[:size])
        inverses.append(solve_triangular(factor, jnp.eye(size, dtype=matrix.dtype), lower=True))
        belows.append(jnp.matmul(panel[size:], inverses[-1].T, precision="highest"))
    return Panels(inverses, belows)


def solve_positive(
    matrix: Float[Array, "n k k"], right: Float[Array, "n k"]
) -> Float[Array, "n k"]:
    """Solves many small positive definite systems by Gauss-Jordan elimination without pivoting.

    Not by LAPACK: batched calls in nested loops deadlocked on a CPU (jax 0.10.2, two threads, 64
    scenes)."""

    def eliminate(k: Array, table: Array) -> Array:
        row = table[:, k] / table[:, k, k, None]
        return (table - table[:, :, k, None] * row[:, None]).at[:, k].set(row)

    table = jnp.concatenate([matrix, right[:, :, None]], axis=2)
    return loops.fori_loop(0, matrix.shape[-1], eliminate, table)[:, :, -1]
