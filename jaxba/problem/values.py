"""Numbers that a user gives: checked in one place, with one line where they cannot be used."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float

SHOWN = 60
"""Characters of a wrong value that a message shows."""


def shown(value: Any) -> str:
    """A value as a message shows it: on one line, and not too long."""
    text = " ".join(repr(value).split())
    return text if len(text) <= SHOWN else f"{text[: SHOWN - 3]}..."


def finite(what: str, value: Any, *shapes: tuple[int, ...]) -> Float[np.ndarray, "..."]:
    """Finite numbers as a float64 array of one of the given shapes.

    Args:
        what: whose they are, the beginning of the message.
        value: what the user gave.
        shapes: those that are allowed.

    Raises:
        ValueError: something else; one line.
    """
    wanted = "be one number" if shapes == ((),) else f"have shape {' or '.join(map(str, dict.fromkeys(shapes)))}"
    try:
        array = np.asarray(value)
    except (TypeError, ValueError):  # lists of unequal lengths
        array = np.asarray(None)
    if array.dtype.kind not in "iuf":
        raise ValueError(f"{what} must {wanted}, not {shown(value)}")
    if array.shape not in shapes:
        raise ValueError(f"{what} must {wanted}, not {array.shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"{what} must be finite")
    return np.ascontiguousarray(array, np.float64).reshape(array.shape)
