"""Files that are replaced whole or not at all."""

from __future__ import annotations

import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import BinaryIO

# a file being written: hidden, and short, since the name of the file may be the longest
TEMPORARY = ".jaxba-{}.tmp"


@contextmanager
def atomic_write(path: str | os.PathLike[str]) -> Iterator[BinaryIO]:
    """A stream whose bytes become the file at the end of the block, or not at all.

    They go to a temporary file in the same folder, which then replaces the file (of a symbolic
    link, the file that it points to) in one step: readers, and whoever comes after a killed
    process, see the old file or the whole new one. The permissions of an existing file stay. If the
    block raises anything, the temporary file is removed. Raises OSError: the file cannot be
    written. Raises ValueError: no file can have such a name."""
    target = os.path.realpath(path)
    temporary = os.path.join(os.path.dirname(target), TEMPORARY.format(secrets.token_hex(8)))
    try:
        with open(temporary, "xb") as file:
            yield file
        if os.path.exists(target):
            shutil.copymode(target, temporary)
        os.replace(temporary, target)
    except BaseException:
        with suppress(OSError):
            os.unlink(temporary)
        raise


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """Replaces a file, whole or not at all, by a UTF-8 text. Raises OSError."""
    with atomic_write(path) as file:
        file.write(text.encode())
