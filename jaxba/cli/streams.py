"""Standard output and error that outlive their readers: `jaxba-bench --help | head`, a terminal
that is gone."""

from __future__ import annotations

import os
import shutil
import stat
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from io import TextIOWrapper
from typing import Any


class UnwritableStreamError(Exception):
    """Standard output cannot be written, though its reader is there. No `OSError`, which would be
    one of a file."""


class TolerantStream:
    """A text stream that, once its reader has closed it, discards what is written."""

    def __init__(self, stream: Any, *, discard_all: bool) -> None:
        """`discard_all`: after any other error, too, instead of raising an
        `UnwritableStreamError`."""
        self._stream = stream
        self._discard_all = discard_all

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """As that of the stream."""
        with self._tolerance():
            self._stream.write(text)
        return len(text)

    def writelines(self, lines: Any) -> None:
        """As that of the stream."""
        for line in lines:
            self.write(line)

    def flush(self) -> None:
        """As that of the stream."""
        with self._tolerance():
            self._stream.flush()

    @contextmanager
    def _tolerance(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            # a stream without a file; what it has buffered is discarded, too
            with suppress(OSError, ValueError):
                os.dup2(os.open(os.devnull, os.O_WRONLY), self._stream.fileno())
            if not (self._discard_all or isinstance(error, BrokenPipeError)):
                raise UnwritableStreamError(f"standard output: {error.strerror or error}") from None


def whole_input() -> str:
    """A path from which standard input can be read, more than once: all that comes through a pipe
    is kept first. Raises OSError: there is none, or it cannot be kept."""
    if not stat.S_ISREG(os.fstat(0).st_mode):
        with tempfile.TemporaryFile() as copy, open(0, "rb", closefd=False) as given:
            shutil.copyfileobj(given, copy)
            copy.flush()
            os.dup2(copy.fileno(), 0)
        os.lseek(0, 0, os.SEEK_SET)
    return "/dev/stdin"


@contextmanager
def tolerant_streams() -> Iterator[None]:
    """A context in which standard output and error are tolerant, and escape characters that their
    encoding lacks, which file names may have, instead of raising an error."""
    before = sys.stdout, sys.stderr
    for stream in before:
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    with open(os.devnull, "w") as nothing:  # for streams that were closed from the start

        def wrap(stream, discard_all):
            return TolerantStream(stream or nothing, discard_all=discard_all)

        sys.stdout = wrap(before[0], False)
        sys.stderr = wrap(before[1], True)
        try:
            yield
        finally:
            sys.stdout, sys.stderr = before
