"""The reduced camera system of a scene with few points, by Woodbury's identity.

`S = B - W W^T` has a row per camera unknown, and W has a column per coordinate of each point. With
fewer columns than rows it is cheaper not to form S. With `B = L L^T` (block-diagonal) and `Z = L^-1
W`,

    S^-1 b = L^-T (h + Z (I - Z^T Z)^-1 Z^T h),    h = L^-1 b,

so that only the capacitance matrix `I - Z^T Z` is factored. It is positive definite exactly if S
is: its eigenvalues are those of `L^-1 S L^-T` other than one. In effect cameras are eliminated
instead of points: the operations are those of a Cholesky factorisation of `[[B, W], [W^T, I]]`, and
as stable.

Source: Golub and Van Loan, "Matrix Computations", section 2.1.4 (Sherman-Morrison-Woodbury
formula)."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array
from jax.scipy.linalg import solve_triangular
from jaxtyping import Float

from jaxba.linear.cholesky import factor_and_solve, lower_cholesky


def capacitance_solve(
    wide: Float[Array, "unknowns columns"],
    blocks: Float[Array, "cameras width width"],
    right: Float[Array, "cameras width"],
) -> Float[Array, "cameras width"]:
    """Solves `(B - W W^T) x = b`. Returns the camera step; non-finite if S is not positive
    definite."""
    factor = lower_cholesky(blocks)
    width = factor.shape[-1]
    unit = jnp.broadcast_to(jnp.eye(width, dtype=factor.dtype), factor.shape)
    inverse = solve_triangular(factor, unit, lower=True)  # [cameras, width, width]
    # matmul instead of a fused sum: XLA would recompute W for every row of the result
    scaled = jnp.matmul(
        inverse, wide.reshape(len(inverse), width, -1), precision="highest"
    ).reshape(wide.shape)
    half = jnp.matmul(inverse, right[:, :, None], precision="highest").reshape(-1)
    capacitance = jnp.eye(wide.shape[1], dtype=wide.dtype) - jnp.matmul(
        scaled.T, scaled, precision="highest"
    )
    inner = factor_and_solve(capacitance, jnp.matmul(half, scaled, precision="highest"))
    whole = half + jnp.matmul(scaled, inner, precision="highest")
    return jnp.matmul(whole.reshape(-1, 1, width), inverse, precision="highest")[:, 0]
