"""Lenses: which cameras share intrinsics, of which camera model they are, and which of their
numbers are optimised.

A *lens* is one set of intrinsics, which several cameras (images) can share. In BAL every camera has
a lens of its own. In a COLMAP model all images of one physical camera share their intrinsics."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Int

from jaxba.problem.camera_models import BAL, CameraModel
from jaxba.problem.checks import indices, plain_array
from jaxba.typing import AnyArray, ArrayRecord, register_pytree

POSE_SIZE = 6
"""Parameters of a pose: angle-axis (radians) and translation (scene units). Those of the lens
follow in a camera."""

LENS_SIZE = len(BAL)  # parameters of a BAL lens: f (pixels), k1, k2


@register_pytree
@dataclass(frozen=True, eq=False, repr=False)
class Lenses(ArrayRecord):
    """The lenses of a problem's cameras."""

    index: Int[AnyArray, " cameras"]
    """Lens of each camera, int32. Cameras with the same lens have equal intrinsics, before and
    after a solve."""

    free: Bool[AnyArray, "lenses numbers"]
    """Which numbers of each lens are optimised: as many as the largest of the models has."""

    model: Int[AnyArray, " lenses"] | None = None
    """Model of each lens, a position in `models`; None: all are of the first."""

    models: tuple[CameraModel, ...] = field(default=(BAL,), metadata={"static": True})
    """The camera models of the problem."""

    @property
    def shared(self) -> bool:
        """Whether two cameras have the same lens."""
        return len(np.unique(self.index)) < len(self.index)

    @property
    def all_bal(self) -> bool:
        """Whether all lenses are of BAL's model."""
        return self.models == (BAL,)

    def model_of(self, lens: int) -> CameraModel:
        """The camera model of a lens."""
        return self.models[0 if self.model is None else int(self.model[lens])]

    def of(self, cameras: Int[np.ndarray, " kept"]) -> Lenses:
        """The same for a subset of the cameras; the numbering of the lenses is unchanged."""
        return replace(self, index=np.asarray(self.index)[cameras])


def lens_size(lenses: Lenses | None) -> int:
    """Number of intrinsics of each camera of a problem with these lenses."""
    return LENS_SIZE if lenses is None else max(map(len, lenses.models))


def checked_lenses(lenses: Lenses, cameras: np.ndarray) -> Lenses:
    """Checks the lenses of cameras and returns them as int32 and bool NumPy arrays. Raises
    ValueError: shapes differ, an index is out of range, or cameras with the same lens differ in
    their intrinsics. The message is one line."""
    free = plain_array("free of lenses", lenses.free)
    size = lens_size(lenses)
    names = "f, k1 and k2" if lenses.all_bal else f"{size} numbers"
    if free.ndim != 2 or free.shape[1] != size or free.dtype != bool:
        raise ValueError(
            f"lenses must say of {names} what is free, shape (n, {size}), not "
            f"{free.dtype}{free.shape}"
        )
    index = indices("the lens of cameras", lenses.index, len(free), len(cameras))
    given = np.zeros(len(free), int) if lenses.model is None else lenses.model
    model = indices("the model of lenses", given, len(lenses.models), len(free))
    beyond = np.arange(size) >= np.array([len(one) for one in lenses.models])[model][:, None]
    _, first, group = np.unique(index, return_index=True, return_inverse=True)
    other = np.flatnonzero(
        (cameras[first[group], POSE_SIZE:] != cameras[:, POSE_SIZE:]).any(axis=1)
    )
    if other.size:
        pair = f"{first[group[other[0]]]} and {other[0]}"
        differ = names.replace("and", "or") if lenses.all_bal else "their intrinsics"
        raise ValueError(f"cameras {pair} share lens {index[other[0]]}, but differ in {differ}")
    return replace(
        lenses, index=index, free=free & ~beyond, model=None if lenses.model is None else model
    )
