"""Lenses: which cameras were taken with the same one, and which of its numbers are optimised.

In BAL every camera has a focal length and a distortion of its own. A COLMAP model says better: images of one camera
share them, and its model of a lens may have no distortion at all, or one that is not ours to change.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Int

from jaxba.typing import AnyArray, register_pytree

LENS_SIZE = 3
"""Numbers of a lens: f (pixels), k1, k2."""


@register_pytree
@dataclass(frozen=True)
class Lenses:
    """The lenses of a problem's cameras."""

    index: Int[AnyArray, " cameras"]
    """Lens of each camera, int32. Cameras of one lens have equal f, k1 and k2, before and after a solve."""

    free: Bool[AnyArray, "lenses 3"]
    """Which of f, k1 and k2 of each lens are optimised."""

    @property
    def shared(self) -> bool:
        """Whether two cameras have the same lens."""
        return len(np.unique(self.index)) < len(self.index)

    def of(self, cameras: Int[np.ndarray, " kept"]) -> Lenses:
        """The lenses of some cameras; all lenses keep their numbers."""
        return replace(self, index=np.asarray(self.index)[cameras])


def checked_lenses(lenses: Lenses, cameras: np.ndarray) -> Lenses:
    """The same as int32 and bool on the host.

    Args:
        lenses: of a problem.
        cameras: its cameras, shape (cameras, 9).

    Raises:
        ValueError: shapes differ, an index is out of range, or cameras of one lens differ in f, k1 or k2; in one line.
    """
    index, free = np.asarray(lenses.index), np.asarray(lenses.free)
    if index.shape != (len(cameras),) or index.dtype.kind not in "iu":
        raise ValueError(f"lenses must name a lens for each of {len(cameras)} cameras, not {index.dtype}{index.shape}")
    if free.ndim != 2 or free.shape[1] != LENS_SIZE or free.dtype != bool:
        raise ValueError(f"lenses must say of f, k1 and k2 what is free, shape (n, 3), not {free.dtype}{free.shape}")
    bad = np.flatnonzero((index < 0) | (index >= len(free)))
    if bad.size:
        raise ValueError(f"camera {bad[0]} has lens {index[bad[0]]}, outside 0..{len(free) - 1}")
    _, first, group = np.unique(index, return_index=True, return_inverse=True)
    other = np.flatnonzero((cameras[first[group], 6:] != cameras[:, 6:]).any(axis=1))
    if other.size:
        pair = f"{first[group[other[0]]]} and {other[0]}"
        raise ValueError(f"cameras {pair} share lens {index[other[0]]}, but differ in f, k1 or k2")
    return Lenses(np.ascontiguousarray(index, np.int32), np.ascontiguousarray(free))
