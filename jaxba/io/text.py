"""Reader of whitespace-separated numbers, a block at a time; every error names its line."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import chain
from typing import NamedTuple, NoReturn

import numpy as np

from jaxba.io.files import READ_ERRORS, reason
from jaxba.problem.bundle_problem import ProblemError

MAX_WORD_BYTES = 1 << 16
"""Longest word that may be cut by the end of a block. No number needs more than about 1100 characters; without the
bound a large file without whitespace would be collected in memory as one word."""

SHOWN = 40
"""Characters of a wrong word that a message shows."""

_WORD = re.compile(rb"[^ \t\n\r\v\f]+")
_NUMBER = re.compile(rb"[+-]?(?:\d+\.?\d*|\.\d+)(?:[ed][+-]?\d+)?", re.IGNORECASE)
_NOT_FINITE = re.compile(
    rb"[+-]?(?:nan(?:\(\w*\))?|inf(?:inity)?|\d\.#(?:[qs]nan|ind|inf)\d*)",  # the last is Microsoft's, as 1.#QNAN
    re.IGNORECASE,
)
_FORTRAN = re.compile(rb"[\d.][Dd][+-]?\d")  # the exponent of 1.0D+00
_FORTRAN_TO_C = bytes.maketrans(b"Dd", b"Ee")


def number(word: str) -> float:
    """The number that a word is, also with Fortran's exponents (1.0D+00); NaN if it is one that is not finite in any
    spelling (inf, -nan(ind), 1.#QNAN).

    Raises:
        ValueError: it is no number.
    """
    try:
        text = word.encode("ascii")
    except UnicodeEncodeError:
        text = b""
    if _NUMBER.fullmatch(text):
        return float(text.translate(_FORTRAN_TO_C))
    if _NOT_FINITE.fullmatch(text):
        return float("nan")
    raise ValueError(f"{word!r} is no number")


def shown_word(word: bytes) -> str:
    """A word for a message, shortened."""
    text = word.decode("latin-1")
    return ascii(text if len(text) <= SHOWN else f"{text[: SHOWN - 3]}...")


def finite_numbers(words: Sequence[str | bytes], fields: Sequence[str], where: str) -> list[float]:
    """The words as finite numbers.

    Args:
        words: to read.
        fields: what each of them is, for messages.
        where: where they stand; begins the messages.

    Raises:
        ProblemError: a word is no number, or not finite.
    """
    found = []
    for word, field in zip(words, fields, strict=True):
        text = word if isinstance(word, str) else word.decode("latin-1")
        try:
            found.append(number(text))
        except ValueError:
            raise ProblemError(f"{where}: {text[:40]!a} is not a number ({field})") from None
        if not np.isfinite(found[-1]):
            raise ProblemError(f"{where}: {text[:40]!a} is not a finite number ({field})")
    return found


class LineReader:
    """The first lines of a text; what follows them is handed on in blocks."""

    def __init__(self, blocks: Iterable[bytes], name: str):
        """Reads `blocks` of the file called `name`."""
        self.name = name
        self.line = 0
        """Number of the line that was read last, from 1."""
        self._blocks = iter(blocks)
        self._text = b""
        self._at = 0  # where in it the next line begins

    def next(self) -> bytes:
        """The next line that is not blank, without blanks at its ends; empty at the end of the text.

        Raises:
            ProblemError: the line is longer than any can be, or the data cannot be decompressed.
        """
        line = b""
        while not line:
            while (end := self._text.find(b"\n", self._at)) < 0:
                self._text, self._at = self._text[self._at :], 0
                where = f"{self.name} line {self.line + 1}"
                if len(self._text) > MAX_WORD_BYTES:
                    raise ProblemError(f"{where}: is longer than {MAX_WORD_BYTES} characters")
                try:
                    block = next(self._blocks, None)
                except READ_ERRORS as error:
                    raise ProblemError(f"{where}: cannot read on: {reason(error)}") from error
                if block is None and not self._text:
                    return b""
                self._text += b"\n" if block is None else block
            line, self._at = self._text[self._at : end].strip(), end + 1
            self.line += 1
        return line

    def rest(self) -> Iterator[bytes]:
        """The blocks after the lines that were read."""
        return chain([self._text[self._at :]], self._blocks)


class _Piece(NamedTuple):
    text: bytes
    ordinal: int  # position in the file of its first number, from 0
    line: int  # line on which it starts, from 1


class NumberReader:
    """The numbers of a text in their order, as float64, correctly rounded.

    A number's *ordinal* is its position in the file, from 0. Only the text of numbers that were not taken yet (and of
    the last block) is kept, so memory is that of the result, not of the file.
    """

    def __init__(self, blocks: Iterable[bytes], name: str, field: Callable[[int], str], *, line: int = 1):
        """Reads `blocks` of the file called `name`.

        Args:
            blocks: the bytes, cut anywhere.
            name: file name for messages.
            field: describes the number at an ordinal, such as "number of cameras"; may be replaced while reading.
            line: number of the line on which `blocks` start.
        """
        self.name = name
        self.field = field
        self._blocks = iter(blocks)
        self._line = line
        self._last_line = line
        self._pieces: list[_Piece] = []  # the text of the numbers in self._parts, and a little more
        self._parts: list[np.ndarray] = []  # numbers read and not yet taken
        self._size = 0  # how many these are
        self._taken = 0
        self._carry = b""
        self._complaint: str | None = None  # about the word after the last number read
        self._ended = False

    def rows(self, count: int, width: int) -> Iterator[tuple[int, np.ndarray]]:
        """The next `count * width` numbers in blocks of shape (rows, width), each with its first number's ordinal.

        Raises:
            ProblemError: the file ends early, a word is no finite number, or the data cannot be decompressed.
        """
        while count:
            while self._size < width:
                if self._ended or self._complaint is not None:
                    self.missing()
                self._read()
            ordinal, size = self._taken, min(count, self._size // width) * width
            block = self._joined()[:size].reshape(-1, width)
            self.skip(size)
            count -= len(block)
            yield ordinal, block

    def peek_all(self) -> np.ndarray:
        """All remaining numbers up to the end of the file or to the first bad word; none of them is taken."""
        while not self._ended and self._complaint is None:
            self._read()
        return self._joined()

    def skip(self, count: int) -> None:
        """Takes `count` of the numbers that were read already."""
        self._parts = [self._joined()[count:]]
        self._size -= count
        self._taken += count

    def finish(self) -> None:
        """Checks that nothing but whitespace follows.

        Raises:
            ProblemError: a word is left over, or the rest cannot be decompressed.
        """
        while not self._ended and not self._size and self._complaint is None:
            self._read()
        if self._size or self._complaint is not None:
            self.fail(self._taken, "is left over after the last number", field="")

    def integers(self, ordinals: Sequence[int] | np.ndarray, values: np.ndarray, low: int, high: int) -> np.ndarray:
        """`values` as int32, shape (n,), after a check that they are integers in `[low, high]`.

        Args:
            ordinals: shape (n,), where the numbers stand in the file.
            values: shape (n,), float64.
            low: smallest allowed value.
            high: largest allowed value, at most 2**31 - 1.

        Raises:
            ProblemError: one of them is not.
        """
        whole = values == np.floor(values)
        bad = np.flatnonzero(~(whole & (values >= low) & (values <= high)))
        if bad.size:
            complaint = f"is outside {low}..{high}" if whole[bad[0]] else "is not an integer"
            self.fail(int(ordinals[bad[0]]), complaint)
        return values.astype(np.int32)

    def need(self, count: int) -> None:
        """Raises a `ProblemError` if there are fewer numbers than `count` that were read and not yet taken."""
        if count > self._size:
            self.missing()

    def missing(self) -> NoReturn:
        """Raises a `ProblemError` that says why there are no more numbers than those that were read."""
        ordinal = self._taken + self._size
        if self._complaint is not None:
            self.fail(ordinal, self._complaint)
        raise ProblemError(f"{self.name} line {self._last_line}: the file ends before the {self.field(ordinal)}")

    def fail(self, ordinal: int, complaint: str, *, field: str | None = None) -> NoReturn:
        """Raises a `ProblemError` about the number (or bad word) at an ordinal whose text is still kept."""
        piece = next(piece for piece in reversed(self._pieces) if piece.ordinal <= ordinal)
        offset = int(np.flatnonzero(_word_starts(_spaces(piece.text)))[ordinal - piece.ordinal])
        line = piece.line + piece.text.count(b"\n", 0, offset)
        shown = shown_word(piece.text[offset : offset + SHOWN + 1].split(None, 1)[0])
        field = self.field(ordinal) if field is None else field
        raise ProblemError(f"{self.name} line {line}: {shown} {complaint}" + (f" ({field})" if field else ""))

    def _joined(self) -> np.ndarray:
        if len(self._parts) != 1:
            self._parts = [np.concatenate(self._parts) if self._parts else np.empty(0)]
        return self._parts[0]

    def _read(self) -> None:
        """Parses one more block and appends its numbers to `self._parts`."""
        try:
            block = next(self._blocks, None)
        except READ_ERRORS as error:
            raise ProblemError(f"{self.name} line {self._line}: cannot read on: {reason(error)}") from error
        data = self._carry if block is None else self._carry + block
        self._ended = block is None
        spaces = _spaces(data)
        cut = len(data)
        if not self._ended:  # the last word may go on in the next block
            cut -= int(spaces[::-1].argmax()) if spaces.any() else cut
        text, self._carry = data[:cut], data[cut:]
        values, complaint = _parse(text, int(np.count_nonzero(_word_starts(spaces[:cut]))))
        if complaint is None and len(self._carry) > MAX_WORD_BYTES:
            complaint, text, self._carry = f"is longer than {MAX_WORD_BYTES} characters", data, b""
        self._complaint = complaint
        ends = [piece.ordinal for piece in self._pieces[1:]] + [self._taken + self._size]
        self._pieces = [piece for piece, end in zip(self._pieces, ends, strict=False) if end > self._taken]
        if text.strip():
            self._pieces.append(_Piece(text, self._taken + self._size, self._line))
            self._last_line = self._line + text.rstrip().count(b"\n")
        self._line += text.count(b"\n")
        if values.size:
            self._parts.append(values)
            self._size += values.size


def _spaces(text: bytes) -> np.ndarray:
    """Mask (bytes,) of the whitespace, as defined by isspace() of C."""
    codes = np.frombuffer(text, np.uint8)
    return (codes == 32) | (codes - np.uint8(9) < 5)


def _word_starts(spaces: np.ndarray) -> np.ndarray:
    starts = ~spaces
    starts[1:] &= spaces[:-1]
    return starts


def _parse(text: bytes, count: int) -> tuple[np.ndarray, str | None]:
    """The numbers of a text of `count` words up to the first bad one, and what is wrong with that one, if any."""
    if count == 0:
        return np.empty(0), None
    values = _parse_quickly(text)
    if values.size != count and _FORTRAN.search(text):
        values = _parse_quickly(text.translate(_FORTRAN_TO_C))
    if values.size != count:  # one of the words is no number: search it word by word
        good = []
        for word in _WORD.findall(text):
            try:
                good.append(number(word.decode("latin-1")))
            except ValueError:
                break
        values = np.array(good, dtype=np.float64)
    finite = np.isfinite(values)
    if not finite.all():
        return values[: finite.argmin()], "is not a finite number"
    return values, None if values.size == count else "is not a number"


def _parse_quickly(text: bytes) -> np.ndarray:
    """The numbers of a text; of another count than its words if one of them is no number."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", DeprecationWarning)  # NumPy before 2.3 warns instead of raising ValueError
            return np.fromstring(text, dtype=np.float64, sep=" ")
    except (ValueError, DeprecationWarning):
        return np.empty(0)
