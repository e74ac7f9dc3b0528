"""Checks of arrays that people hand over, with messages of one line."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

from jaxba.runtime.numerics import TRACED


def plain_array(name: str, values: Any) -> np.ndarray:
    """The values as a NumPy array.

    Raises:
        ValueError: rows differ in length, or entries are masked.
        TypeError: JAX traces them.
    """
    if np.ma.is_masked(values):
        raise ValueError(f"{name} must have no masked entries")
    try:
        return np.asarray(values)
    except jax.errors.TracerArrayConversionError:
        raise TypeError(TRACED) from None
    except ValueError:
        raise ValueError(f"{name} must be an array: rows differ in length") from None


def real_numbers(name: str, values: Any) -> np.ndarray:
    """The values as a contiguous float64 array.

    Raises:
        ValueError: they are no real numbers, or no array.
        TypeError: JAX traces them.
    """
    array = plain_array(name, values)
    try:
        if array.dtype.kind in "biufO":
            return np.ascontiguousarray(array, np.float64).reshape(array.shape)
    except (TypeError, ValueError, OverflowError):  # objects
        pass
    raise ValueError(f"{name} must be real numbers, not {array.dtype}")
