"""The reduced camera system where cameras share lenses: rows and columns of a lens added up, then factored."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from jaxba.linear.cholesky import factor_and_solve
from jaxba.problem.intrinsics import LENS_SIZE
from jaxba.structure.shared_intrinsics import POSE_SIZE, LensTies


def solve_tied(
    ties: LensTies, matrix: Float[Array, "unknowns unknowns"], right: Float[Array, "cameras 9"]
) -> Float[Array, "cameras 9"]:
    """Solves `T^T S T y = T^T b` by a dense Cholesky factorisation.

    Args:
        ties: T.
        matrix: S, of which the lower triangle is read.
        right: b.

    Returns:
        T y; not finite where the tied matrix is not positive definite.
    """
    cameras, lenses = ties.members.shape
    lower = jnp.tril(matrix)
    whole = (lower + jnp.tril(matrix, -1).T).reshape(cameras, 9, cameras, 9)
    poses = whole[:, :POSE_SIZE, :, :POSE_SIZE].reshape(POSE_SIZE * cameras, -1)
    own = ties.members.astype(matrix.dtype)
    columns = jnp.einsum("cadk,dl->calk", whole[..., POSE_SIZE:], own, precision="highest")  # [c, 9, lens, 3]
    both = columns[:, :POSE_SIZE].reshape(-1, LENS_SIZE * lenses)
    alone = jnp.einsum("cl,cjmk->ljmk", own, columns[:, POSE_SIZE:], precision="highest")
    unused = jnp.repeat(ties.counts() == 0, LENS_SIZE).astype(matrix.dtype)  # such a lens gets a zero step
    alone = alone.reshape(LENS_SIZE * lenses, -1) + jnp.diag(unused)
    tied = jnp.block([[poses, both], [both.T, alone]])
    step = factor_and_solve(tied, jnp.concatenate([right[:, :POSE_SIZE].ravel(), ties.total(right[:, 6:]).ravel()]))
    pose, lens = step[: POSE_SIZE * cameras], step[POSE_SIZE * cameras :]
    return jnp.concatenate([pose.reshape(cameras, POSE_SIZE), ties.spread(lens.reshape(lenses, LENS_SIZE))], axis=1)
