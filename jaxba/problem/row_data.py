"""What data of residuals may be: their shape in one row, and which values make sense.

The residuals of `jaxba.residuals` know it of each of their keywords (`with_data`), files of
constraints check with the same functions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

ANY = -1  # in a shape: any length

ROTATION_ERROR = 1e-3  # of an entry of R^T R: numbers that were written with four digits

UNIT_ERROR = 1e-2  # of a length that should be one: numbers that were written with three digits

ONE_FOR_ALL = "one value for all is a number, or has a first axis of one"

Holds = Callable[[Float[np.ndarray, "rows ..."]], Bool[np.ndarray, " rows"]]


def is_positive(values: Float[np.ndarray, "rows ..."]) -> Bool[np.ndarray, " rows"]:
    """Which rows have positive numbers alone."""
    return np.all((values > 0).reshape(len(values), -1), axis=1)


def is_not_zero(values: Float[np.ndarray, "rows ..."]) -> Bool[np.ndarray, " rows"]:
    """Which rows have a number that is not zero."""
    return np.any(values.reshape(len(values), -1) != 0, axis=1)


def is_unit(values: Float[np.ndarray, "rows n"]) -> Bool[np.ndarray, " rows"]:
    """Which vectors have the length one, as written in a file."""
    return np.abs(np.linalg.norm(values, axis=1) - 1) <= UNIT_ERROR


def is_rotation(values: Float[np.ndarray, "rows 3 more"]) -> Bool[np.ndarray, " rows"]:
    """Which matrices, or `[R | t]`, have a rotation in their first three columns."""
    matrices = values[:, :, :3]
    square = matrices.transpose(0, 2, 1) @ matrices
    straight = np.abs(square - np.eye(3)).max(axis=(1, 2), initial=0.0) <= ROTATION_ERROR
    return straight & (np.linalg.det(matrices) > 0)


@dataclass(frozen=True)
class Datum:
    """What a keyword of a residual is in one row."""

    shapes: tuple[tuple[int, ...], ...] = ((),)
    """Shapes that it may have."""

    what: str = ""
    """What it must be, after "must be"; nothing if any numbers will do."""

    holds: Holds | None = None
    """Whether it is that in each row."""

    def wrong(self, values: Float[np.ndarray, "rows ..."]) -> list[int]:
        """Rows whose values it may not be."""
        return [] if self.holds is None else np.flatnonzero(~self.holds(values)).tolist()

    def rows_of(
        self, name: str, values: Float[np.ndarray, "..."], count: int
    ) -> Float[np.ndarray, "count ..."]:
        """The values in each row. Raises ValueError: they are neither one value nor one a row; one
        line.

        Args:
            name: of the keyword and its residual, for messages.
            values: what was given.
            count: number of rows."""
        for shape in self.shapes:
            if values.shape[:1] in ((1,), (count,)) and _fits(values.shape[1:], shape):
                return np.broadcast_to(values, (count, *values.shape[1:]))
        # a vector cannot be told from numbers of rows where both would do
        whole = [shape for shape in self.shapes if not shape or () not in self.shapes]
        if any(_fits(values.shape, shape) for shape in whole):
            return np.broadcast_to(values, (count, *values.shape))
        if not count and not values.size:
            return np.zeros((0, *(max(length, 0) for length in self.shapes[0])))
        if any(values.ndim and _fits(values.shape[1:], shape) for shape in self.shapes):
            raise ValueError(other_length(name, len(values), count))
        shapes = " or ".join(map(_written, self.shapes))
        raise ValueError(f"{name} must be {shapes} in a row, not an array of shape {values.shape}")


def other_length(name: str, length: int, count: int) -> str:
    """The message that data have neither one row nor as many as the residual."""
    rows = f"{length} row{'s' * (length != 1)}"
    return f"{name} has {rows}, there are {count} residuals ({ONE_FOR_ALL})"


def _fits(shape: tuple[int, ...], wanted: tuple[int, ...]) -> bool:
    return len(shape) == len(wanted) and all(
        n in (m, ANY) for n, m in zip(wanted, shape, strict=True)
    )


def _written(shape: tuple[int, ...]) -> str:
    if not shape:
        return "a number"
    if shape == (ANY,):
        return "a vector"
    names = " x ".join("n" if length == ANY else str(length) for length in shape)
    return f"{names} numbers"


NUMBER = Datum()
POSITIVE = Datum(what="positive", holds=is_positive)
VECTOR = Datum(((3,),))
DIRECTION = Datum(((3,),), "other than zero", is_not_zero)
UNIT_VECTOR = Datum(((3,),), "a unit vector", is_unit)
ROTATION = Datum(((3, 3),), "a rotation matrix", is_rotation)
MOUNT = Datum(((3, 4),), "a rotation matrix and a translation", is_rotation)


def vectors(length: int) -> Datum:
    """Any vectors of a length; `ANY` for that of what they are compared with."""
    return Datum(((length,),))


def matrices(rows: int, columns: int) -> Datum:
    """Any matrices of a size."""
    return Datum(((rows, columns),))


def deviations(length: int) -> Datum:
    """Standard deviations of a vector: one, or one for each of its numbers."""
    return Datum(((), (length,)), "positive", is_positive)


def whitenings(length: int) -> Datum:
    """Matrices that whiten a vector of a length."""
    return Datum(((ANY, length),), "other than zero", is_not_zero)
