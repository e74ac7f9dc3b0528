"""Preconditioners of conjugate gradients on the reduced camera system S.

- `jacobi`: the camera blocks `B + D_c`.
- `schur-jacobi`: the block diagonal of S.
- `two-level`: the block diagonal of S plus a coarse correction (two_level.py).

Source: Agarwal et al. 2010, "Bundle Adjustment in the Large" (the first two)."""

from __future__ import annotations

from collections.abc import Callable

import jax.numpy as jnp
from jax import Array
from jax.scipy.linalg import solve_triangular
from jaxtyping import Float

from jaxba.linear.cholesky import lower_cholesky
from jaxba.linear.schur import DampedSystem
from jaxba.linear.two_level import coarse_preconditioner
from jaxba.problem.intrinsics import POSE_SIZE
from jaxba.problem.options import Preconditioner
from jaxba.problem.safe_math import safe_sqrt
from jaxba.runtime.fusion import fusion_barrier
from jaxba.structure.devices import sum_over_devices
from jaxba.structure.segment_sums import as_rows, outer_sum, take_rows, tree_sum
from jaxba.structure.unknowns import Unknowns


def preconditioner(
    system: DampedSystem, blocks: Float[Array, "blocks width width"] | None, name: Preconditioner
) -> Callable[[Array], Array]:
    """`M^-1` as a function of the residual; `blocks` are those of S, if they have been formed."""
    layout = system.layout
    if name == "jacobi":
        return block_inverse(_with_shared(layout.unknowns, system.cameras.blocks))
    if blocks is None or layout.pairs is None:
        diagonal = diagonal_blocks(system)
    else:
        diagonal = take_rows(blocks, layout.pairs.diagonal)
    fine = block_inverse(_with_shared(layout.unknowns, diagonal))
    if name == "schur-jacobi":
        return fine
    coarse = coarse_preconditioner(system)
    return lambda r: fine(r) + coarse(r)


def _with_shared(
    unknowns: Unknowns, blocks: Float[Array, "cameras width width"]
) -> Float[Array, "cameras width width"]:
    """The blocks, with means over cameras in the place of a shared lens or the pose of a frame,
    which do not couple."""
    if not unknowns.shared:
        return blocks
    pose = unknowns.poses.mean(blocks[:, :POSE_SIZE, :POSE_SIZE])
    lens = unknowns.lenses.mean(blocks[:, POSE_SIZE:, POSE_SIZE:])
    coupling = blocks[:, :POSE_SIZE, POSE_SIZE:]
    apart = unknowns.lenses.is_shared[:, None, None] | unknowns.poses.several
    coupling = jnp.where(apart, jnp.zeros_like(coupling), coupling)
    upper = jnp.concatenate([pose, coupling], axis=2)
    return jnp.concatenate([upper, jnp.concatenate([coupling.mT, lens], axis=2)], axis=1)


def diagonal_blocks(system: DampedSystem) -> Float[Array, "cameras width width"]:
    """The diagonal blocks of S, `D_c + sum J_c^T (I - Q Q^T) J_c`.

    With the Cholesky factor `F F^T = I - Q Q^T` this is a sum of outer products of the rows of `F^T
    J_c`, two an observation, which stays positive semi-definite under rounding. If a camera sees a
    point twice, the product of the two observations is missing, which is harmless in a
    preconditioner."""
    layout = system.layout
    (over, under) = system.points.projected

    def dot(a, b):
        return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]

    f00 = safe_sqrt(jnp.maximum(1 - dot(over, over), 0))
    f10 = -dot(over, under) / jnp.where(f00 > 0, f00, 1)
    f11 = safe_sqrt(jnp.maximum(1 - dot(under, under) - f10 * f10, 0))
    f00, f10, f11 = fusion_barrier(jnp.stack([f00, f10, f11]))
    first, second = system.linear.camera_jacobian
    columns = [f00 * a + f10 * b for a, b in zip(first, second, strict=True)] + [
        f11 * b for b in second
    ]
    level, *levels = layout.camera_levels
    gathered = take_rows(as_rows(columns), level).reshape(level.shape[0], -1, len(first))
    return system.cameras.own + sum_over_devices(
        layout, tree_sum(outer_sum(gathered, gathered), tuple(levels))
    )


def block_inverse(blocks: Float[Array, "cameras width width"]) -> Callable[[Array], Array]:
    """The product with the inverses of positive definite blocks, which are formed once by
    Cholesky."""
    factor = lower_cholesky(blocks)
    eye = jnp.broadcast_to(jnp.eye(blocks.shape[-1], dtype=blocks.dtype), blocks.shape)
    root = solve_triangular(factor, eye, lower=True)
    inverse = jnp.einsum("cji,cjk->cik", root, root)
    return lambda r: jnp.einsum("cab,cb->ca", inverse, r)
