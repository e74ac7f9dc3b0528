"""Checks of what people hand over, with messages of one line."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np
from jaxtyping import Float, Int

from jaxba.runtime.numerics import TRACED

SHOWN = 60  # characters of a wrong value that a message shows


def shown(value: Any, longest: int = SHOWN) -> str:
    """A value as a message shows it: on one line, and not too long."""
    text = " ".join(repr(value).split())
    return text if len(text) <= longest else f"{text[: longest - 3]}..."


def plain_array(name: str, values: Any) -> np.ndarray:
    """A NumPy array. Raises ValueError: rows differ in length, or masked entries. Raises TypeError:
    JAX traces them."""
    if np.ma.is_masked(values):
        raise ValueError(f"{name} must have no masked entries")
    try:
        return np.asarray(values)
    except jax.errors.TracerArrayConversionError:
        raise TypeError(TRACED) from None
    except ValueError:
        raise ValueError(f"{name} must be an array: rows differ in length") from None


def real_numbers(name: str, values: Any) -> np.ndarray:
    """A contiguous float64 array. Raises ValueError: no real numbers, or no array. Raises
    TypeError: traced."""
    array = plain_array(name, values)
    try:
        if array.dtype.kind in "biufO":
            return np.ascontiguousarray(array, np.float64).reshape(array.shape)
    except (TypeError, ValueError, OverflowError):  # objects
        pass
    raise ValueError(f"{name} must be real numbers, not {shown(values)}")


def real_number(name: str, value: Any) -> float:
    """A number, perhaps infinite. Raises ValueError: something else; one line."""
    number = real_numbers(name, value)
    if number.shape or value is None:
        raise ValueError(f"{name} must be one number, not {shown(value)}")
    return float(number)


def random_numbers(seed: Any) -> np.random.Generator:
    """The generator of a seed, or a generator itself. Raises ValueError: the seed is neither; one
    line."""
    try:
        return np.random.default_rng(seed)
    except (TypeError, ValueError):
        raise ValueError(
            f"seed must be a whole number that is not negative, not {shown(seed)}"
        ) from None


def indices(name: str, values: Any, bound: int, count: int) -> Int[np.ndarray, " n"]:
    """The values as an int32 vector of that many entries in [0, bound). Raises ValueError: they are
    none; one line."""
    array = plain_array(name, values)
    if array.shape != (count,) or (count and array.dtype.kind not in "iu"):
        raise ValueError(
            f"{name} must be a vector of {count} integers, not {array.dtype} of shape {array.shape}"
        )
    if count and (array.min() < 0 or array.max() >= bound):
        bad = np.flatnonzero((array < 0) | (array >= bound))[0]
        raise ValueError(f"{name}[{bad}] is {array[bad]}, outside 0..{bound - 1}")
    return np.ascontiguousarray(array, dtype=np.int32)


def finite(what: str, value: Any, *shapes: tuple[int, ...]) -> Float[np.ndarray, "..."]:
    """Finite numbers as a float64 array of one of the given shapes; `what` begins the message.
    Raises ValueError: something else; one line. Raises TypeError: JAX traces them."""
    wanted = (
        "be one number"
        if shapes == ((),)
        else f"have shape {' or '.join(map(str, dict.fromkeys(shapes)))}"
    )
    try:
        array = plain_array(what, value)
    except ValueError:
        array = np.asarray(None)
    if array.dtype.kind not in "iuf":
        raise ValueError(f"{what} must {wanted}, not {shown(value)}")
    if array.shape not in shapes:
        raise ValueError(f"{what} must {wanted}, not {array.shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"{what} must be finite")
    return np.ascontiguousarray(array, np.float64).reshape(array.shape)


def inverse_roots(
    covariances: Float[np.ndarray, "n k k"], least: float = 0.0
) -> tuple[Float[np.ndarray, "n k k"], Int[np.ndarray, " bad"]]:
    """`Sigma^(-1/2)` of covariances, and which of them are not symmetric with eigenvalues above the
    least one."""
    values, vectors = np.linalg.eigh(covariances)
    asymmetry = np.abs(covariances - covariances.transpose(0, 2, 1)).max(axis=(1, 2), initial=0.0)
    good = (values[:, 0] > least) & (asymmetry <= 1e-9 * np.abs(values).max(axis=1, initial=0.0))
    scaled = vectors / np.sqrt(np.where(good[:, None], values, 1.0))[:, None, :]
    return scaled @ vectors.transpose(0, 2, 1), np.flatnonzero(~good)
