"""Several vectors made in one loop: what they share is computed once and not stored.

XLA on a CPU makes every vector of a program in a loop of its own, which computes anew, or reads anew from memory, what
vectors share: the 28 vectors of a linearisation each projected their points. A reduction of many operands is the one
loop that it gives several results. So what is to be one loop is written as the sum over an axis of two, of which the
second half is zero: LLVM unrolls it, drops that half, and makes the rest vector instructions, as it does with no
reduction over three and more (docs/optimisations.md, "Several vectors in one loop").
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array, lax

in_haste = jax.make_user_context(False)
"""Whether what is traced is to be compiled quickly (compilation.py). Without LLVM's optimisation a loop does all of its
work, the half that is zero too, and what is written out takes longer to compile: there every vector has its own."""


def together(function: Callable[..., list[Array]], *operands: Any) -> list[Array]:
    """`function(*operands)`, in one loop on a CPU unless `in_haste`; elsewhere as XLA makes it.

    Args:
        function: of arrays whose last axis is the loop's, elementwise in it: it indexes the axes before alone, and
            returns vectors, at least one. To be vectorised it must not look anything up.
        operands: arrays, or pytrees of them, whose last axis is the loop's. What is looked up or makes several of them
            is better stored before.
    """

    def one_loop(*operands: Any) -> list[Array]:
        twice = lambda x: jnp.broadcast_to(jnp.expand_dims(x, -2), (*x.shape[:-1], 2, x.shape[-1]))
        rows = function(*jax.tree.map(twice, operands))
        if len(rows) == 1:  # a loop of its own anyway, where a sum of one operand would go to a library, and slowly
            return function(*operands)
        first = lax.broadcasted_iota(jnp.int32, rows[0].shape, 0) == 0
        return sum_each([jnp.where(first, row, jnp.zeros_like(row)) for row in rows], 0)

    if in_haste.value:
        return function(*operands)
    return lax.platform_dependent(*operands, cpu=one_loop, default=function)


def sum_each(rows: list[Array], axis: int) -> list[Array]:
    """Sums vectors of one shape over an axis, all in one loop."""
    add = lambda left, right: [a + b for a, b in zip(left, right, strict=True)]
    return lax.reduce(rows, [jnp.zeros((), row.dtype) for row in rows], add, (axis,))
