"""Lines of numbers, as KITTI's text files have them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from jaxba.io.encoding import decode
from jaxba.io.files import display_name, reason
from jaxba.io.text import number
from jaxba.problem.bundle_problem import ProblemError


def lines_of(path: Path) -> list[tuple[int, str]]:
    """Lines of a text file that are not blank, each with its number from 1.

    Raises:
        ProblemError: the file cannot be read, or is no text.
    """
    try:
        text = decode(path.read_bytes())
    except (OSError, ValueError) as error:
        if isinstance(error, UnicodeDecodeError):
            raise ProblemError(f"{display_name(path)}: is no text") from None
        raise ProblemError(f"{display_name(path)}: cannot be read: {reason(error)}") from None
    return [(at, line.strip()) for at, line in enumerate(text.split("\n"), 1) if line.strip()]


def numbers_of(text: str, count: int, where: str) -> np.ndarray:
    """The finite numbers of a line, shape (count,).

    Raises:
        ProblemError: there are not so many, or one is none; the message begins with `where`.
    """
    words = text.split()
    try:
        numbers = np.array([number(word) for word in words])
    except ValueError:
        raise ProblemError(f"{where}: holds something that is no number") from None
    if len(numbers) != count:
        raise ProblemError(f"{where}: has {len(numbers)} numbers instead of {count}")
    if not np.isfinite(numbers).all():
        raise ProblemError(f"{where}: holds a number that is not finite")
    return numbers
