"""Lines of a text file as words, which are taken as numbers; every error names the line and the field."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from typing import NoReturn

from jaxba.io.encoding import utf8
from jaxba.problem.bundle_problem import ProblemError

_NUMBER = re.compile(rb"[+-]?(?:(?:\d+\.?\d*|\.\d+)(?:e[+-]?\d+)?|(nan)(?:\([^)]*\))?|inf|infinity)", re.IGNORECASE)
_WINDOWS_NAN = re.compile(rb"[+-]?1\.#(?:q?nan|snan|ind)0*", re.IGNORECASE)
"""What older C libraries of Windows print."""


def lines(data: bytes, name: str, *, empty: bool = False) -> Iterator[Words]:
    """Lines of a file that are no comments, without blanks at their ends.

    Args:
        data: content of the file.
        name: its name for messages.
        empty: whether lines without words come too.

    Raises:
        ProblemError: the file is not the text that its byte order mark announces.
    """
    data = b"".join(utf8(iter([data]), name))
    start, number = 0, 0
    while start < len(data):
        end = data.find(b"\n", start)
        end = len(data) if end < 0 else end
        text = data[start:end].strip()
        start, number = end + 1, number + 1
        if (text or empty) and not text.startswith(b"#"):
            yield Words(name, number, text)


class Words:
    """The words of a line, taken one after the other."""

    def __init__(self, name: str, number: int, text: bytes):
        self._name, self._number, self._text = name, number, text
        self._words = text.split()
        self._at = 0
        self.about = ""
        """The record, for messages."""

    @property
    def rest(self) -> list[bytes]:
        """Words that were not taken yet."""
        return self._words[self._at :]

    def after(self, count: int) -> bytes:
        """The line behind its first `count` words."""
        parts = self._text.split(None, count)
        return parts[count] if len(parts) > count else b""

    def word(self, field: str) -> bytes:
        """The next word."""
        return self._take(1, field)[0]

    def integer(self, field: str, high: int) -> int:
        """The next word as an id, an index or a count, at most `high`."""
        return self.to_integers(self._take(1, field), field, high)[0]

    def floats(self, *fields: str) -> list[float]:
        """The next words as numbers, which may be infinite or no number."""
        words = self._words[self._at : self._at + len(fields)]
        if len(words) < len(fields):
            self._ends(fields[len(words)])
        self._at += len(fields)
        return self.to_floats(words, *fields)

    def to_floats(self, words: Sequence[bytes], *fields: str) -> list[float]:
        """Words of this line as numbers; the last field is that of all words after it."""
        if b"_" not in self._text:  # Python takes 1_000 for a number
            try:
                return list(map(float, words))
            except ValueError:
                pass
        return [self._float(word, fields[min(number, len(fields) - 1)]) for number, word in enumerate(words)]

    def to_integers(self, words: Sequence[bytes], field: str, high: int) -> list[int]:
        """Words of this line as integers in 0..`high`, where -1, COLMAP's word for nothing, means `high`."""
        try:
            values = list(map(int, words)) if b"_" not in self._text else [self._integer(w, field) for w in words]
        except ValueError:
            values = [self._integer(word, field) for word in words]
        if values and (min(values) < 0 or max(values) > high):
            if min(values) < -1 or max(values) > high:
                bad = next(word for word, value in zip(words, values, strict=True) if not -1 <= value <= high)
                self.fail(f"{_shown(bad)} is outside 0..{high}{_in(field)}")
            values = [high if value < 0 else value for value in values]
        return values

    def finish(self) -> None:
        """Raises a `ProblemError` if a word is left."""
        if self.rest:
            self.fail(f"{_shown(self.rest[0])} is left over")

    def fail(self, complaint: str) -> NoReturn:
        """Raises a `ProblemError` about this line."""
        raise ProblemError(f"{self._name} line {self._number}: {self.about}{': ' if self.about else ''}{complaint}")

    def _take(self, count: int, field: str) -> list[bytes]:
        words = self._words[self._at : self._at + count]
        if len(words) < count:
            self._ends(field)
        self._at += count
        return words

    def _ends(self, field: str) -> NoReturn:
        self.fail(f"the line ends before its {field}")

    def _float(self, word: bytes, field: str) -> float:
        match = _NUMBER.fullmatch(word)
        if match:
            return float("nan" if match[1] else word)
        if _WINDOWS_NAN.fullmatch(word):
            return float("nan")
        self.fail(f"{_shown(word)} is not a number{_in(field)}")

    def _integer(self, word: bytes, field: str) -> int:
        try:
            return int(word) if b"_" not in word else int("")
        except ValueError:
            value = self._float(word, field)
        if not value.is_integer():
            self.fail(f"{_shown(word)} is not an integer{_in(field)}")
        return int(value)


def _in(field: str) -> str:
    return f" ({field})"


def _shown(word: bytes) -> str:
    text = word.decode("latin-1")
    return ascii(text if len(text) <= 40 else text[:37] + "...")
