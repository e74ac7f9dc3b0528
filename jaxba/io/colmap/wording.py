"""The words of notes on a model."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np


def note(file: str, positions: np.ndarray, noun: str, what: str, name: Callable[[int], str]) -> list[str]:
    """A line that counts records and names the first one; no line if there are none.

    Args:
        file: the file that they stand in.
        positions: of the records, shape (n,).
        noun: what one record is called.
        what: what is to be said about them, after their number.
        name: name of the record at a position.
    """
    if not len(positions):
        return []
    plural = "" if len(positions) == 1 else "s"
    return [f"{file}: {len(positions)} {noun}{plural} {what} ({name(int(positions[0]))})"]
