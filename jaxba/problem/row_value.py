"""What functions of residuals get, and their value at one row."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float, Int

from jaxba.problem.camera_models import CameraModel
from jaxba.problem.residuals import LENS, POINT, POSE, SECOND, Rows
from jaxba.rotations import angle_axis
from jaxba.typing import AnyArray

# from BAL's camera, which looks down -z with y up, to the axes of `Pose`
AXES = np.array([1.0, -1.0, -1.0])


class Pose(NamedTuple):
    """The pose of an image as functions of residuals see it: `P = R X + t` in the axes of COLMAP
    and OpenCV, x to the right, y down, z forward."""

    rotation: Float[Array, "3 3"]
    """R, from the world to the camera."""

    translation: Float[Array, "3"]
    """t, scene units."""

    @property
    def center(self) -> Float[Array, "3"]:
        """The position of the camera."""
        return -times(self.rotation.T, self.translation)

    def to_camera(self, point: Float[Array, "3"]) -> Float[Array, "3"]:
        """A point of the world in the camera's frame; its last number is the depth."""
        return times(self.rotation, point) + self.translation

    def between(self, other: Pose) -> Pose:
        """From the frame of this camera to that of another: `P_2 = R P_1 + t`."""
        rotation = other.rotation @ self.rotation.T
        return Pose(rotation, other.translation - times(rotation, self.translation))

    def turn_from(self, rotation: Float[Array, "3 3"]) -> Float[Array, "3"]:
        """The angle-axis vector w with `R = exp(w) rotation`, in the camera's axes, radians."""
        return angle_axis((self.rotation @ rotation.T)[None])[0]


def times(matrix: Float[AnyArray, "m n"], vector: Float[AnyArray, " n"]) -> Array:
    """The product with a vector, term by term, which XLA fuses with what surrounds it. Raises
    IndexError: no matrix."""
    return sum(matrix[:, k] * vector[k] for k in range(len(vector)))  # pyright: ignore[reportReturnType]


class Lens(NamedTuple):
    """The lens of an image as functions of residuals see it."""

    numbers: Float[Array, " numbers"]
    """Its numbers in the order of its camera model: f, k1 and k2 of BAL."""

    model: Int[Array, ""]
    models: tuple[CameraModel, ...]

    def project(self, ray: Float[Array, "3"]) -> Float[Array, "2"]:
        """The pixel of a point in the frame of the camera (`Pose.to_camera`), as
        `BundleProblem.observations`."""
        every = [
            jnp.stack(one.project(list(self.numbers[: len(one)]), *ray)) for one in self.models
        ]
        return every[0] if len(every) == 1 else jnp.stack(every)[self.model]


class Cameras(NamedTuple):
    """One or two cameras of a row, in BAL's axes."""

    rotation: Float[AnyArray, "cameras 3 3"]
    translation: Float[AnyArray, "cameras 3"]
    lenses: Float[AnyArray, "cameras numbers"]
    model: Int[AnyArray, " cameras"]
    models: tuple[CameraModel, ...]


def value(
    rows: Rows,
    cameras: Cameras,
    points: Float[Array, "points 3"],
    blocks: Sequence[Float[Array, "cameras _"]],
    data: Sequence[Array],
) -> Float[Array, " size"]:
    """The function of a residual at one row; `rows` has the function, and the frame that it sees.
    Cameras and points are those of the row, points anything if it has none. `blocks` has for each
    unknown of the function its block, of each camera, and `data` for each keyword of the function
    its value."""
    dtype = cameras.translation.dtype
    scale, turn, shift, axes = (
        jnp.asarray(x, dtype) for x in (rows.scale, rows.rotation, rows.translation, AXES)
    )
    arguments: list[Any] = []
    for name, block in zip(rows.residual.unknowns, blocks, strict=True):
        base = name.removesuffix(SECOND)
        which = int(
            name.endswith(SECOND) and len(points if base == POINT else cameras.rotation) > 1
        )
        if base == POINT:
            arguments.append(scale * times(turn, points[which]) + shift)
        elif base == POSE:
            rotation = jnp.stack([times(turn, row) for row in cameras.rotation[which]])
            moved = scale * cameras.translation[which] - times(rotation, shift)
            arguments.append(Pose(axes[:, None] * rotation, axes * moved))
        elif base == LENS:
            arguments.append(Lens(cameras.lenses[which], cameras.model[which], cameras.models))
        else:
            arguments.append(block[which])
    found = rows.residual.function(*arguments, **dict(zip(rows.residual.data, data, strict=True)))
    if jnp.iscomplexobj(found):
        raise TypeError("it returns complex numbers")
    return jnp.atleast_1d(jnp.asarray(found, dtype))
