"""Shared intrinsics: index arrays for cameras that have a lens, and so f, k1 and k2, in common.

Let T be the matrix that copies the parameters y of the lenses (and the poses) to the cameras, `d = T y`. The damped
system `(H + D) d = -g` becomes

    T^T (H + D) T y = -T^T g.

T leaves points alone, so they are eliminated as usual; then the rows and columns of the reduced camera system that
belong to one lens are summed (linear/shared_intrinsics_solve.py).
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
"""Pose parameters of a camera: rotation and translation. The intrinsics f, k1 and k2 follow."""


@register_pytree
@dataclass(frozen=True)
class SharedLenses:
    """The matrix T of shared intrinsics, and the intrinsics that are optimised."""

    lens: Int[AnyArray, " cameras"]
    """Lens of each camera."""

    members: Bool[AnyArray, "cameras lenses"]
    """Whether a camera is observed and has this lens; no columns if no lens is shared."""

    free: Bool[AnyArray, "3 cameras"]
    """Which of f, k1 and k2 of a camera are optimised."""

    shared: bool = field(metadata={"static": True})
    """Whether two cameras have the same lens. If not, T is the identity, but some intrinsics may still be fixed."""

    def total(self, values: Float[Array, "cameras 3"]) -> Float[Array, "lenses 3"]:
        """Sums over the observed cameras of each lens: the product with `T^T`."""
        return jnp.matmul(self.members.T.astype(values.dtype), values, precision="highest")

    def counts(self) -> Int[Array, " lenses"]:
        """Number of observed cameras of each lens."""
        return jnp.sum(self.members, axis=0, dtype=jnp.int32)

    def spread(self, values: Float[Array, "lenses 3"]) -> Float[Array, "cameras 3"]:
        """The values of its lens for each camera: the product with T."""
        return values[self.lens]


def shared_lenses_of(lenses: Lenses, seen: Bool[np.ndarray, " cameras"]) -> SharedLenses:
    """The shared intrinsics of a problem, for its layout.

    Args:
        lenses: checked lenses of the problem.
        seen: whether each camera has an observation.
    """
    index = np.asarray(lenses.index)
    members = np.zeros((len(index), 0), bool)
    if lenses.shared:
        members = (index[:, None] == np.arange(len(lenses.free))) & seen[:, None]
    return SharedLenses(index, members, np.asarray(lenses.free)[index].T, lenses.shared)
