"""Shared lenses as a border of the reduced camera system.

Let S be the reduced camera system of camera blocks, and T the matrix that copies the parameters y_L
of shared lenses to their cameras. In `T^T S T` the shared lenses are the last rows and columns:

    [ A    B ] [ x   ]   [ b_A ]        B = S T_L,   C = T_L^T S T_L,   b_L = T_L^T b
    [ B^T  C ] [ y_L ] = [ b_L ]

A is S without the lenses of cameras that share theirs. It keeps the band or blocks of S, so that it
is factored like S; then `(C - B^T A^-1 B) y_L = b_L - B^T A^-1 b_A`. The columns `S T_L` are
products with S that do not form it.

Source: bordered systems as in Golub and Van Loan, "Matrix Computations", section 3.2.11 (block
elimination)."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Float

from jaxba.linear.cholesky import factor_and_solve
from jaxba.problem.intrinsics import POSE_SIZE
from jaxba.structure.covisibility import PairLayout
from jaxba.structure.unknowns import Unknowns

# a linear function of arrays [cameras, width] or [cameras, width, columns]
Solve = Callable[[Array], Array]


def bordered(
    unknowns: Unknowns,
    product: Solve,
    inner: Solve,
    like: Float[Array, "cameras width"],
    *,
    store: bool,
) -> Solve:
    """`T (T^T S T)^-1 T^T` for shared lenses; non-finite if the system is not positive definite.
    `product` is that with S, `inner` is `A^-1`, for `without_lenses` of S, and `like` has the shape
    and type of a right-hand side. `store`: whether `A^-1 B` is stored for several right-hand sides,
    and not computed along with the only one."""
    lenses = unknowns.lenses
    numbers = len(unknowns.columns)
    if not lenses.several:
        return inner
    members = jnp.asarray(lenses.members).astype(like.dtype)
    # one column of T_L for one camera
    unit = jnp.eye(numbers, like.shape[1], POSE_SIZE, dtype=like.dtype)

    def columns_of(member):
        return jax.vmap(lambda row: product(member[:, None] * row))(unit)

    whole = lax.map(columns_of, members.T)  # [lenses, numbers, cameras, width]
    whole = whole.reshape(-1, *like.shape).transpose(1, 2, 0)
    corner = jnp.einsum("cl,ckm->lkm", members, whole[:, POSE_SIZE:], precision="highest").reshape(
        -1, whole.shape[2]
    )
    # room for more shared lenses
    absent = jnp.repeat(jnp.asarray(lenses.owners) >= lenses.distinct, numbers)
    corner += jnp.diag(absent.astype(corner.dtype))

    def kept(x: Array) -> Array:
        if unknowns.all_shared:
            return x[:, :POSE_SIZE]
        keep = _keeps(unknowns, x.shape[1], x.dtype)
        return x * keep.reshape(*keep.shape, *[1] * (x.ndim - 2))

    columns = kept(whole)
    stored = (inner(columns),) if store else ()

    def solve(right: Float[Array, "cameras width"]) -> Float[Array, "cameras width"]:
        found = inner(
            jnp.concatenate([kept(right)[:, :, None], *([] if store else [columns])], axis=2)
        )
        own = found[:, :, 0]
        solved = jnp.concatenate([found[:, :, 1:], *stored], axis=2)

        def times(x):
            return jnp.einsum("cam,ca...->m...", columns, x, precision="highest")

        sums = lenses.total(right[:, POSE_SIZE:])
        rest = sums.at[lenses.owners].get(mode="fill", fill_value=0).reshape(-1) - times(own)
        lens = factor_and_solve(corner - times(solved), rest)
        x = own - jnp.einsum("cam,m->ca", solved, lens, precision="highest")
        others = jnp.zeros((len(x), numbers), x.dtype) if unknowns.all_shared else x[:, POSE_SIZE:]
        values = lenses.total(others).at[lenses.owners].set(lens.reshape(-1, numbers), mode="drop")
        return jnp.concatenate([x[:, :POSE_SIZE], lenses.copied(values)], axis=1)

    return solve


def without_lenses(
    unknowns: Unknowns, pairs: PairLayout, blocks: Float[Array, "blocks width width"]
) -> Float[Array, "blocks kept kept"]:
    """The blocks of A from those of S: with unit rows for shared lenses, or without lenses if all
    are shared."""
    if not unknowns.lenses.several:
        return blocks
    if unknowns.all_shared:
        return blocks[:, :POSE_SIZE, :POSE_SIZE]
    keep = _keeps(unknowns, blocks.shape[-1], blocks.dtype)
    rows = keep[pairs.block_row]
    unit = jnp.where((pairs.block_camera < len(keep))[:, None], 1 - rows, 0)
    kept = blocks * rows[:, :, None] * keep[pairs.block_column][:, None, :]
    return kept + unit[:, :, None] * jnp.eye(blocks.shape[-1], dtype=blocks.dtype)


def _keeps(unknowns: Unknowns, width: int, dtype: jnp.dtype) -> Float[Array, "cameras width"]:
    shares = unknowns.lenses.is_shared[:, None]
    return 1 - (shares & (jnp.arange(width) >= POSE_SIZE)).astype(dtype)
