"""Text as other programs write it: byte order marks, UTF-16, line ends of Windows and old Macs."""

from __future__ import annotations

import codecs
import json
from collections.abc import Iterator
from itertools import chain
from typing import Any

from jaxba.io.files import StrPath, display_name, read_pieces
from jaxba.problem.bundle_problem import ProblemError

MARKS = {
    # begins as the mark of UTF-16 does, so it is looked for first
    codecs.BOM_UTF32_LE: "utf-32-le",
    codecs.BOM_UTF32_BE: "utf-32-be",
    codecs.BOM_UTF8: "utf-8",
    codecs.BOM_UTF16_LE: "utf-16-le",
    codecs.BOM_UTF16_BE: "utf-16-be",
}
"""Byte order marks, and the encodings that they announce. Source: the Unicode standard, section
23.8."""

_LONGEST_MARK = max(map(len, MARKS))


def read_text(path: StrPath) -> bytes:
    """`plain_text` of a decompressed file. Raises ProblemError: unreadable, or not in its mark's
    encoding."""
    return b"".join(text_pieces(path))


def text_pieces(path: StrPath) -> Iterator[bytes]:
    """The same in pieces."""
    try:
        yield from _plain(read_pieces(path))
    except UnicodeError as error:
        raise ProblemError(
            f"{display_name(path)}: is not the text that its byte order mark announces "
            f"({error.args[0]})"
        ) from None


def read_characters(path: StrPath, *, otherwise: str = "utf-8") -> str:
    """The same as characters, UTF-8 or else another encoding. Raises ProblemError: as `read_text`,
    or it is neither."""
    text = read_text(path)
    for encoding in ("utf-8", otherwise):
        try:
            return text.decode(encoding)
        except UnicodeDecodeError:
            continue
    raise ProblemError(
        f"{display_name(path)}: is no text (UTF-8, or UTF-16 with a byte order mark)"
    )


def plain_text(data: bytes) -> bytes:
    """The text in all bytes of a file, without a byte order mark, and with lines that end in LF.
    UTF-16 and UTF-32 with their marks become UTF-8, all else stays. Raises UnicodeDecodeError: the
    text is not in the encoding of its mark."""
    return b"".join(_plain(iter([data])))


def _plain(pieces: Iterator[bytes]) -> Iterator[bytes]:
    begin = b""
    held = b""
    while len(begin) < _LONGEST_MARK and (piece := next(pieces, None)) is not None:
        begin += piece
    mark = next((mark for mark in MARKS if begin.startswith(mark)), b"")
    pieces = chain([begin[len(mark) :]], pieces)
    if mark and MARKS[mark] != "utf-8":
        pieces = (text.encode() for text in codecs.iterdecode(pieces, MARKS[mark]))
    for piece in pieces:
        text = held + piece
        held = b"\r" if text.endswith(b"\r") else b""  # LF may follow
        text = text[: len(text) - len(held)]
        yield text.replace(b"\r\n", b"\n").replace(b"\r", b"\n") if b"\r" in text else text
    yield b"\n" if held else b""


def parse_json(text: str | bytes) -> Any:
    """The value of a JSON text. Raises ProblemError: a key is there twice in one object, so that
    one of its values would count for nothing. Raises ValueError, RecursionError: as
    `json.loads`."""
    return json.loads(text, object_pairs_hook=_unique)


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        keys = [key for key, _ in pairs]
        raise ProblemError(
            f"the key {next(key for key in keys if keys.count(key) > 1)!a} is there twice in one "
            "object"
        )
    return found
