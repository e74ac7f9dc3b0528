"""Lenses that several cameras share: the step in which they move alike.

With T the matrix that gives every camera the numbers of its lens, tied unknowns y stand for the step T y, and the
damped system `(H + D) d = -g` becomes `T^T (H + D) T y = -T^T g`. Points are eliminated as ever, since T leaves them
alone: the reduced camera system of all cameras is formed, then rows and columns of a lens are added up.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxba.problem.intrinsics import Lenses
from jaxba.typing import AnyArray, register_pytree

POSE_SIZE = 6
"""Unknowns of a camera that are its own: rotation and translation. Those of the lens follow."""


@register_pytree
@dataclass(frozen=True)
class LensTies:
    """What a layout knows of lenses."""

    lens: Int[AnyArray, " cameras"]
    """Lens of each camera."""

    members: Bool[AnyArray, "cameras lenses"]
    """Whether an observed camera has a lens; no columns where no lens is shared."""

    free: Bool[AnyArray, "3 cameras"]
    """Which of f, k1 and k2 of a camera are optimised."""

    shared: bool = field(metadata={"static": True})
    """Whether two cameras have the same lens; without it nothing is tied, and some numbers may stay all the same."""

    def total(self, values: Float[Array, "cameras 3"]) -> Float[Array, "lenses 3"]:
        """Sums over the observed cameras of each lens: `T^T` of the lenses' unknowns."""
        return jnp.matmul(self.members.T.astype(values.dtype), values, precision="highest")

    def counts(self) -> Int[Array, " lenses"]:
        """Observed cameras of each lens."""
        return jnp.sum(self.members, axis=0, dtype=jnp.int32)

    def spread(self, values: Float[Array, "lenses 3"]) -> Float[Array, "cameras 3"]:
        """A lens's numbers for each of its cameras: T."""
        return values[self.lens]


def lens_ties(lenses: Lenses, seen: Bool[np.ndarray, " cameras"]) -> LensTies:
    """The lenses of a problem, for its layout.

    Args:
        lenses: checked.
        seen: cameras with at least one observation.
    """
    index = np.asarray(lenses.index)
    members = np.zeros((len(index), 0), bool)
    if lenses.shared:
        members = (index[:, None] == np.arange(len(lenses.free))) & seen[:, None]
    return LensTies(index, members, np.asarray(lenses.free)[index].T, lenses.shared)
