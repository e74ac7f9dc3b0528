"""Text as other programs write it: byte order marks, UTF-16, line ends of Windows and old Macs."""

from __future__ import annotations

import codecs
import json
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import chain
from typing import Any

from jaxba.io.files import READ_ERRORS, StrPath, display_name, open_input, reason
from jaxba.problem.bundle_problem import ProblemError

MARKS = {
    codecs.BOM_UTF32_LE: "utf-32-le",  # begins as the mark of UTF-16 does, so it is looked for first
    codecs.BOM_UTF32_BE: "utf-32-be",
    codecs.BOM_UTF8: "utf-8",
    codecs.BOM_UTF16_LE: "utf-16-le",
    codecs.BOM_UTF16_BE: "utf-16-be",
}
"""Byte order marks, and the encodings that they announce. Source: the Unicode standard, section 23.8."""

_LONGEST_MARK = 4


@contextmanager
def open_text(path: StrPath) -> Iterator[Iterator[bytes]]:
    """Blocks of a text file as `open_input` gives them, but without a byte order mark, and with lines that end in LF.

    What begins with the mark of UTF-16 or UTF-32 becomes UTF-8; everything else is passed on as it is.

    Raises:
        ProblemError: as `open_input`; the iterator also where the text is not in the encoding of its mark.
    """
    with open_input(path) as blocks:
        yield _unix_lines(utf8(blocks, display_name(path)))


def read_text(path: StrPath) -> str:
    """The whole of a text file, decompressed, without a byte order mark, and with lines that end in LF.

    Raises:
        ProblemError: it cannot be read, or is no text.
    """
    name = display_name(path)
    try:
        with open_text(path) as blocks:
            return b"".join(blocks).decode("utf-8")
    except UnicodeDecodeError:
        raise ProblemError(f"{name}: is no text (UTF-8, or UTF-16 with a byte order mark)") from None
    except READ_ERRORS as error:
        raise ProblemError(f"cannot read {name}: {reason(error)}") from None


def decode(data: bytes) -> str:
    """Text from all bytes of a file, without a byte order mark, and with lines that end in LF.

    Raises:
        UnicodeDecodeError: they are neither UTF-8 nor in the encoding of their mark.
    """
    mark = next((mark for mark in MARKS if data.startswith(mark)), b"")
    text = data[len(mark) :].decode(MARKS.get(mark, "utf-8"))
    return text.replace("\r\n", "\n").replace("\r", "\n")


def parse_json(text: str | bytes) -> Any:
    """The value of a JSON text.

    Raises:
        ProblemError: a key is there twice in one object, so that one of its values would count for nothing.
        ValueError, RecursionError: as `json.loads`.
    """
    return json.loads(text, object_pairs_hook=_unique)


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        keys = [key for key, _ in pairs]
        raise ProblemError(f"the key {next(key for key in keys if keys.count(key) > 1)!a} is there twice in one object")
    return found


def utf8(blocks: Iterator[bytes], name: str) -> Iterator[bytes]:
    """The text of the file called `name` without a byte order mark; what begins with the mark of UTF-16 or UTF-32
    becomes UTF-8, everything else stays as it is.

    Raises:
        ProblemError: the text is not in the encoding of its mark.
    """
    head = b""
    while len(head) < _LONGEST_MARK and (block := next(blocks, None)) is not None:
        head += block
    mark = next((mark for mark in MARKS if head.startswith(mark)), b"")
    encoding = MARKS.get(mark, "utf-8")
    decoder = codecs.getincrementaldecoder(encoding)()
    try:
        for block in chain([head[len(mark) :]], blocks):
            yield block if encoding == "utf-8" else decoder.decode(block).encode()
        yield decoder.decode(b"", final=True).encode()
    except UnicodeError:
        raise ProblemError(f"{name}: is not the text that its byte order mark announces ({encoding})") from None


def _unix_lines(blocks: Iterator[bytes]) -> Iterator[bytes]:
    after_return = False
    for block in blocks:
        if after_return and block.startswith(b"\n"):
            block = block[1:]
            after_return = False
        if block:
            after_return = block.endswith(b"\r")
        yield block.replace(b"\r\n", b"\n").replace(b"\r", b"\n") if b"\r" in block else block
