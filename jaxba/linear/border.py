"""Shared lenses as a border of the reduced camera system.

Let S be the reduced camera system of camera blocks, and T the matrix that copies the parameters y_L of shared lenses to
their cameras. In `T^T S T` the shared lenses are the last rows and columns:

    [ A    B ] [ x   ]   [ b_A ]        B = S T_L,   C = T_L^T S T_L,   b_L = T_L^T b
    [ B^T  C ] [ y_L ] = [ b_L ]

A is S without the lenses of cameras that share theirs. It keeps the band or blocks of S, so that it is factored like
S; then `(C - B^T A^-1 B) y_L = b_L - B^T A^-1 b_A`. The columns `S T_L` are products with S that do not form it.

Source: bordered systems as in Golub and Van Loan, "Matrix Computations", section 3.2.11 (block elimination).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Float

from jaxba.linear.cholesky import factor_and_solve
from jaxba.problem.intrinsics import POSE_SIZE
from jaxba.structure.unknowns import Unknowns
from jaxba.typing import AnyArray


class Border(NamedTuple):
    """The border of the system, and which unknowns of the camera blocks are not part of it."""

    unknowns: Unknowns
    columns: Float[Array, "cameras kept border"]  # B
    corner: Float[Array, "border border"]  # C

    def kept(self, x: Float[Array, "cameras width ..."]) -> Float[Array, "cameras kept ..."]:
        """The unknowns of camera blocks that are not part of the border; zero in the place of the others, or without
        them if all lenses are shared."""
        return _kept(self.unknowns, x)

    def lens_sums(self, x: Float[Array, "cameras width"]) -> Float[Array, " border"]:
        """`T_L^T x`."""
        return self.unknowns.total(x[:, POSE_SIZE:]).reshape(-1)

    def finish(
        self, inner: Float[Array, "cameras kept"], solved: Float[Array, "cameras kept border"], right: Array
    ) -> Float[Array, "cameras width"]:
        """`T y` for `A^-1 b_A`, `A^-1 B` and b; non-finite if the system is not positive definite."""
        product = lambda x: jnp.einsum("cam,ca...->m...", self.columns, x, precision="highest")
        rest = self.lens_sums(right) - product(inner)
        lens = factor_and_solve(self.corner - product(solved), rest)
        x = inner - jnp.einsum("cam,m->ca", solved, lens, precision="highest")
        own = x[:, POSE_SIZE:]
        values = lens.reshape(-1, len(self.unknowns.columns))
        own = jnp.zeros((len(x), values.shape[1]), x.dtype) if self.unknowns.all_shared else own
        return jnp.concatenate([x[:, :POSE_SIZE], self.unknowns.spread(values, own)], axis=1)


def border_of(unknowns: Unknowns, product: Callable[[Array], Array], like: Float[Array, "cameras width"]) -> Border:
    """The border for shared lenses.

    Args:
        unknowns: T.
        product: product with S.
        like: array of the shape and type of its argument.
    """
    members = jnp.asarray(unknowns.members).astype(like.dtype)
    numbers = len(unknowns.columns)
    unit = jnp.eye(numbers, like.shape[1], POSE_SIZE, dtype=like.dtype)  # one column of T_L for one camera
    columns_of = lambda member: jax.vmap(lambda row: product(member[:, None] * row))(unit)
    columns = lax.map(columns_of, members.T)  # [lenses, numbers, cameras, width]
    columns = columns.reshape(-1, *like.shape).transpose(1, 2, 0)
    corner = jnp.einsum("cl,ckm->lkm", members, columns[:, POSE_SIZE:], precision="highest")
    return Border(unknowns, _kept(unknowns, columns), corner.reshape(-1, columns.shape[-1]))


def without_shared(
    unknowns: Unknowns, blocks: Float[Array, "blocks width width"], row: AnyArray, column: AnyArray, own: AnyArray
) -> Float[Array, "blocks kept kept"]:
    """The blocks of A from those of S.

    Args:
        unknowns: which cameras share their lens.
        blocks: of S.
        row: camera of the rows of each block.
        column: camera of its columns.
        own: whether the block is on the diagonal.
    """
    if unknowns.all_shared:
        return blocks[:, :POSE_SIZE, :POSE_SIZE]
    keep = _keeps(unknowns, blocks.shape[-1], blocks.dtype)
    kept = blocks * keep[row][:, :, None] * keep[column][:, None, :]
    unit = jnp.eye(blocks.shape[-1], dtype=blocks.dtype)
    return kept + jnp.where(own, 1 - keep[row].T, 0).T[:, :, None] * unit


def _kept(unknowns: Unknowns, x: Array) -> Array:
    if unknowns.all_shared:
        return x[:, :POSE_SIZE]
    keep = _keeps(unknowns, x.shape[1], x.dtype)
    return x * keep.reshape(*keep.shape, *[1] * (x.ndim - 2))


def _keeps(unknowns: Unknowns, width: int, dtype: jnp.dtype) -> Float[Array, "cameras width"]:
    shares = jnp.any(jnp.asarray(unknowns.members), axis=1)
    return 1 - (shares[:, None] & (jnp.arange(width) >= POSE_SIZE)).astype(dtype)
