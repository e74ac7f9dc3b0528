"""The reduced camera system of cameras that share intrinsics.

With the matrix T that copies each lens's parameters y to all of its cameras, `d_c = T y` and the system becomes

    T^T S T y = T^T b:

the rows and columns of S that belong to one lens are summed (structure/shared_intrinsics.py).
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from jaxba.linear.cholesky import factor_and_solve
from jaxba.problem.intrinsics import LENS_SIZE
from jaxba.structure.shared_intrinsics import POSE_SIZE, SharedLenses


def solve_shared_lenses(
    shared: SharedLenses, matrix: Float[Array, "unknowns unknowns"], right: Float[Array, "cameras 9"]
) -> Float[Array, "cameras 9"]:
    """Solves `T^T S T y = T^T b` by a dense Cholesky factorisation.

    Args:
        shared: T, by the lenses of the cameras.
        matrix: S; only its lower triangle is read.
        right: b.

    Returns:
        T y; non-finite if `T^T S T` is not positive definite.
    """
    cameras, lenses = shared.members.shape
    lower = jnp.tril(matrix)
    full = (lower + jnp.tril(matrix, -1).T).reshape(cameras, 9, cameras, 9)
    pose_pose = full[:, :POSE_SIZE, :, :POSE_SIZE].reshape(POSE_SIZE * cameras, -1)
    own = shared.members.astype(matrix.dtype)
    columns = jnp.einsum("cadk,dl->calk", full[..., POSE_SIZE:], own, precision="highest")  # [c, 9, lens, 3]
    pose_lens = columns[:, :POSE_SIZE].reshape(-1, LENS_SIZE * lenses)
    lens_lens = jnp.einsum("cl,cjmk->ljmk", own, columns[:, POSE_SIZE:], precision="highest")
    unused = jnp.repeat(shared.counts() == 0, LENS_SIZE).astype(matrix.dtype)  # its step is zero
    lens_lens = lens_lens.reshape(LENS_SIZE * lenses, -1) + jnp.diag(unused)
    summed = jnp.block([[pose_pose, pose_lens], [pose_lens.T, lens_lens]])
    step = factor_and_solve(summed, jnp.concatenate([right[:, :POSE_SIZE].ravel(), shared.total(right[:, 6:]).ravel()]))
    pose, lens = step[: POSE_SIZE * cameras], step[POSE_SIZE * cameras :]
    return jnp.concatenate([pose.reshape(cameras, POSE_SIZE), shared.spread(lens.reshape(lenses, LENS_SIZE))], axis=1)
