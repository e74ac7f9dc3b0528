"""Files in and out: compression, output that replaces a file whole or not at all, and readable
errors."""

from __future__ import annotations

import bz2
import gzip
import lzma
import os
import stat
import sys
import zlib
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import partial
from itertools import chain
from pathlib import Path
from typing import IO, Any, BinaryIO, TypeAlias

from jaxba.problem.bundle_problem import ProblemError
from jaxba.runtime.atomic import atomic_write

StrPath: TypeAlias = str | os.PathLike[str]

READ_ERRORS = (OSError, EOFError, zlib.error, lzma.LZMAError, MemoryError)
"""Errors of reading and decompressing a file that are the fault of the file, not of this
program."""

# open streams; links to files where a shell redirects them
STREAMS = ("/dev/stdout", "/dev/stderr", "/dev/fd/")

_DESCRIPTORS = {"/dev/stdout": 1, "/dev/stderr": 2}

_MAGIC = {".bz2": b"BZh", ".gz": b"\x1f\x8b", ".xz": b"\xfd7zXZ\0"}
_DECODERS: dict[str, Callable[[], Any]] = {
    ".bz2": bz2.BZ2Decompressor,
    ".gz": lambda: zlib.decompressobj(wbits=31),  # 31: with a header of gzip
    ".xz": lzma.LZMADecompressor,
}
_PIECE = 1 << 20  # bytes that are read from a file at once
# bytes; bzip2 gives nothing before the end of its first block of at most 900 kB
_BZIP2_BLOCK = 1 << 20


def strip_compression(path: StrPath) -> str:
    """The path without `.bz2`, `.gz` or `.xz` at its end."""
    root, suffix = os.path.splitext(os.fspath(path))
    return root if suffix.lower() in _MAGIC else os.fspath(path)


def sidecar_path(path: StrPath) -> Path:
    """The file that `jaxba-kitti` writes beside a problem: `kitti00.txt.bz2` has
    `kitti00.frames.json`."""
    return Path(strip_compression(path)).with_suffix(".frames.json")


def display_name(path: StrPath) -> str:
    """The path for a message of one line: control characters and undecodable bytes are escaped."""
    return _one_line(os.fspath(path))


def reason(error: BaseException) -> str:
    """Why reading or writing failed, in one line."""
    if isinstance(error, MemoryError):
        return "not enough memory"
    if isinstance(error, OSError) and error.strerror:
        return _one_line(error.strerror)
    return _one_line(str(error)) or type(error).__name__


def visible(folder: StrPath) -> list[Path]:
    """What lies in a folder, sorted, without names that begin with a dot: systems leave such files
    beside any other. Raises OSError: it is no folder, or cannot be listed."""
    return sorted(path for path in Path(folder).iterdir() if not path.name.startswith("."))


def read_bytes(path: StrPath, decompress: bool = True) -> bytes:
    """The contents of a file, decompressed if its first bytes are those of bzip2, gzip or xz,
    whatever its name. Binary files may begin with any number, and are not to be decompressed.
    Raises ProblemError: it cannot be read, is not compressed as its name says, or is damaged; one
    line."""
    return b"".join(read_pieces(path, decompress))


def read_pieces(path: StrPath, decompress: bool = True) -> Iterator[bytes]:
    """The same in pieces."""
    name = display_name(path)
    try:
        with open(path, "rb") as file:
            begin = file.read(_PIECE if decompress else -1)
            kind = _compression(begin) if decompress else None
            suffix = os.path.splitext(path)[1].lower()
            if begin and decompress and suffix in _MAGIC and kind is None:
                raise ProblemError(f"{name}: the file is no {suffix[1:]} file, as its name says")
            pieces = chain([begin], iter(partial(file.read, _PIECE), b""))
            yield from pieces if kind is None else _decompressed(pieces, _DECODERS[kind])
    except ProblemError:
        raise
    except (*READ_ERRORS, ValueError) as error:  # ValueError: a name with NUL or a lone surrogate
        raise ProblemError(f"cannot read {name}: {reason(error)}") from error


def beginning(path: StrPath, size: int) -> bytes:
    """The first bytes of a regular file, decompressed; empty if they cannot be read."""
    try:
        if not os.path.isfile(path):
            return b""
        with open(path, "rb") as file:
            data = file.read(_BZIP2_BLOCK)
        kind = _compression(data)
        return data[:size] if kind is None else _DECODERS[kind]().decompress(data, size)
    except (*READ_ERRORS, ValueError):
        return b""


@contextmanager
def open_output(path: StrPath) -> Iterator[BinaryIO]:
    """A stream whose bytes become the file at the end of the block, or not at all (`atomic_write`).

    They are compressed if the name ends in `.bz2`, `.gz` or `.xz`. A device or pipe, such as
    standard output, is written directly, an open stream from its current position. Raises
    ProblemError: the file cannot be written."""
    name = display_name(path)
    try:
        target = os.path.realpath(path)
        special = os.path.exists(target) and not stat.S_ISREG(os.stat(target).st_mode)
        if special or os.fspath(path).startswith(STREAMS):
            with _open_stream(os.fspath(path)) as file, _compressor(file, path) as stream:
                yield stream
            return
        with atomic_write(path) as file, _compressor(file, path) as stream:
            yield stream
    except ProblemError:
        raise
    except (OSError, ValueError) as error:
        raise ProblemError(f"cannot write {name}: {reason(error)}") from error


def stream_number(path: StrPath) -> int | None:
    """The file descriptor of a name such as `/dev/stdout`; None for every other name."""
    name = os.fspath(path)
    number = name.removeprefix("/dev/fd/")
    return _DESCRIPTORS.get(name, int(number) if number != name and number.isdecimal() else None)


def _open_stream(path: str) -> BinaryIO:
    number = stream_number(path)
    if number is None:
        return open(path, "wb")
    for stream in (sys.stdout, sys.stderr):  # earlier output must come first
        stream.flush()
    # opening a redirected file by name would start at its beginning
    return os.fdopen(os.dup(number), "wb")


def _compression(data: bytes) -> str | None:
    """Ending of the compression that data begin with."""
    return next((kind for kind, magic in _MAGIC.items() if data.startswith(magic)), None)


def _decompressed(pieces: Iterable[bytes], new_decoder: Callable[[], Any]) -> Iterator[bytes]:
    """The contents of all streams. The standard library's functions would ignore garbage after the
    first one."""
    decoder = None
    for data in pieces:
        while data := data if decoder else data.lstrip(b"\0"):  # xz allows zeros between streams
            decoder = decoder or new_decoder()
            yield decoder.decompress(data)
            data, decoder = (decoder.unused_data, None) if decoder.eof else (b"", decoder)
    if decoder is not None:
        raise EOFError("the compressed data is cut short")


def _compressor(file: IO[bytes], path: StrPath) -> Any:
    suffix = os.path.splitext(os.fspath(path))[1].lower()
    if suffix == ".bz2":
        return bz2.BZ2File(file, "wb")
    if suffix == ".xz":
        # The default preset, 6, takes 8 times as long on digits to save 7 % more.
        return lzma.LZMAFile(file, "wb", preset=1)
    if suffix == ".gz":
        # No name and no time inside: the same problem gives the same bytes.
        return gzip.GzipFile(filename="", fileobj=file, mode="wb", compresslevel=6, mtime=0)
    return file


def _one_line(text: str) -> str:
    return "".join(
        c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in text
    )
