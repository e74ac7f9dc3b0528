"""Cache of the results of single frames and pairs on disk, so that an interrupted run can be resumed.

The name of a file holds a hash of everything that its contents depend on, so no stale result is ever read. The folder
may be deleted at any time.
"""

from __future__ import annotations

import hashlib
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import numpy as np

from jaxba.io.files import display_name, open_output, reason
from jaxba.problem.bundle_problem import ProblemError

Result = TypeVar("Result", bound=tuple)

VERSION = "1"
"""To be changed with the meaning of stored results."""


def digest(*parts: object) -> str:
    """Hash of the `repr` of some values, 16 hexadecimal digits."""
    return hashlib.sha256("\0".join(map(repr, (VERSION, *parts))).encode()).hexdigest()[:16]


def cached(folder: Path, name: str, kind: type[Result], make: Callable[[], Result]) -> Result:
    """The tuple that a folder has by this name; computed and stored if there is none, or it cannot be read.

    Args:
        folder: of `.npz` files; made if it is not there.
        name: of the file, without suffix; contains a `digest` of everything that the result depends on.
        kind: a named tuple of arrays.
        make: computes the tuple.

    Raises:
        ProblemError: the file cannot be written, or what `make` raises.
    """
    path = folder / f"{name}.npz"
    try:
        with open(path, "rb") as stream, np.load(stream, allow_pickle=False) as file:
            return kind(*(file[field] for field in kind._fields))  # type: ignore[attr-defined]
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        pass
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ProblemError(f"cannot make {display_name(folder)}: {reason(error)}") from None
    result = make()
    with open_output(path) as stream:
        np.savez(stream, **result._asdict())  # type: ignore[attr-defined]
    return result
