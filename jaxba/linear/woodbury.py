"""The reduced camera system of a scene with few points, solved by way of a matrix of the size of its points.

`S = B - W W^T` has a row per camera unknown, W a column per coordinate of each point. Where there are fewer columns
than rows, S need not be formed: with `B = L L^T` block by block and `Z = L^-1 W`,

    S^-1 b = L^-T (h + Z (I - Z^T Z)^-1 Z^T h),  h = L^-1 b,

so that only the capacitance matrix `I - Z^T Z` is factored. It has the eigenvalues of `L^-1 S L^-T` other than one, and
is positive definite exactly where S is. In effect cameras are eliminated and not points: these are the steps of a
Cholesky factorisation of `[[B, W], [W^T, I]]` from the top left, and as stable.

Source: Golub and Van Loan, "Matrix Computations", section 2.1.4 (Sherman-Morrison-Woodbury formula).
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array
from jax.scipy.linalg import solve_triangular
from jaxtyping import Float

from jaxba.linear.cholesky import factor_and_solve
from jaxba.linear.schur import CameraSystem


def capacitance_solve(wide: Float[Array, "unknowns columns"], system: CameraSystem) -> Float[Array, "cameras 9"]:
    """Solves `(B - W W^T) x = b`.

    Args:
        wide: W; rows are cameras' unknowns, camera by camera.
        system: B and b.

    Returns:
        The camera step; not finite where the system is not positive definite.
    """
    factor = jnp.linalg.cholesky(system.blocks, symmetrize_input=False)
    unit = jnp.broadcast_to(jnp.eye(9, dtype=factor.dtype), factor.shape)
    inverse = solve_triangular(factor, unit, lower=True)  # [cameras, 9, 9]
    # products and not fused sums: XLA would make W anew for every row
    scaled = jnp.matmul(inverse, wide.reshape(len(inverse), 9, -1), precision="highest").reshape(wide.shape)
    half = jnp.matmul(inverse, system.right[:, :, None], precision="highest").reshape(-1)
    capacitance = jnp.eye(wide.shape[1], dtype=wide.dtype) - jnp.matmul(scaled.T, scaled, precision="highest")
    inner = factor_and_solve(capacitance, jnp.matmul(half, scaled, precision="highest"))
    whole = half + jnp.matmul(scaled, inner, precision="highest")
    return jnp.matmul(whole.reshape(-1, 1, 9), inverse, precision="highest")[:, 0]
