"""Reader of lines, of whitespace-separated numbers, and of points among them; every error names its line."""

from __future__ import annotations

import re
import warnings
from bisect import bisect_right
from collections.abc import Callable, Sequence
from typing import NoReturn

import numpy as np
from jaxtyping import Int

from jaxba.problem.bundle_problem import ProblemError
from jaxba.typing import LARGEST_COUNT

BLOCK_BYTES = 1 << 22  # bytes that are parsed at once. With 4 MiB the arrays of a block stay near the cache
SHOWN = 40  # characters of a wrong word that a message shows

_SPACE = re.compile(rb"[ \t\n\r\v\f]")
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
    spelling (inf, -nan(ind), 1.#QNAN). Raises ValueError: it is no number."""
    text = word.encode("utf-8", "replace")
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
    """Words as finite numbers; `fields` are their names. Raises ProblemError, beginning with `where`: one is not."""
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


class Text:
    """The text of a file: lines one after the other, then the numbers in all that follows.

    Numbers are float64, correctly rounded. A number's *ordinal* is its position among them, from 0."""

    def __init__(self, text: bytes, name: str):
        """`text` of the file called `name`, with lines that end in LF."""
        self.name = name
        self.line = 0  # number of the line that was read last, from 1
        self.values = np.empty(0)  # the numbers, up to the first word that is none
        self.field: Callable[[int], str]  # what the number at an ordinal is; may be replaced while reading
        self._text, self._at = text, 0  # where the next line begins
        self._blocks: list[tuple[int, int]] = []  # of each block the ordinal of its first number, and where it begins
        self._complaint: str | None = None  # about the word after the last number

    @property
    def where(self) -> str:
        """The line that was read last, for messages."""
        return f"{self.name} line {max(self.line, 1)}"

    def next_line(self) -> bytes:
        """The next line that is not blank, without blanks at its ends; empty at the end of the text."""
        line = b""
        while not line and self._at < len(self._text):
            end = self._text.find(b"\n", self._at)
            end = end if end >= 0 else len(self._text)
            line, self._at = self._text[self._at : end].strip(), end + 1
            self.line += 1
        return line

    def read_numbers(self, field: Callable[[int], str]) -> np.ndarray:
        """Parses all that follows the lines that were read; returns `values`."""
        self.field, parts, size, start = field, [], 0, self._at
        while start < len(self._text) and self._complaint is None:
            space = _SPACE.search(self._text, start + BLOCK_BYTES)
            end = space.end() if space else len(self._text)
            values, self._complaint = _parse(self._text[start:end])
            self._blocks.append((size, start))
            parts, size, start = [*parts, values], size + len(values), end
        self.values = np.concatenate([np.empty(0), *parts])
        return self.values

    def need(self, count: int) -> None:
        """Refuses a text of fewer numbers. Raises ProblemError: it says why there are no more of them."""
        have = len(self.values)
        if count > have and self._complaint is not None:
            self.fail(have, self._complaint)
        if count > have:
            line = self._text.rstrip().count(b"\n") + 1
            raise ProblemError(f"{self.name} line {line}: the file ends before the {self.field(have)}")

    def finish(self, count: int) -> None:
        """Refuses a text in which a word follows so many numbers. Raises ProblemError."""
        if count < len(self.values) or self._complaint is not None:
            self.fail(count, "is left over after the last number", field="")

    def integers(self, ordinals: Sequence[int] | np.ndarray, low: int, high: int) -> np.ndarray:
        """The numbers at some ordinals as int32. Raises ProblemError: one is no integer in `[low, high]`."""
        values = self.values[ordinals]
        whole = values == np.floor(values)
        bad = np.flatnonzero(~(whole & (values >= low) & (values <= high)))
        if bad.size:
            complaint = f"is outside {low}..{high}" if whole[bad[0]] else "is not an integer"
            self.fail(int(ordinals[bad[0]]), complaint)
        return values.astype(np.int32)

    def fail(self, ordinal: int, complaint: str, *, field: str | None = None) -> NoReturn:
        """Raises a `ProblemError` about the number (or bad word) at an ordinal."""
        first, start = self._blocks[bisect_right(self._blocks, ordinal, key=lambda block: block[0]) - 1]
        for word in _WORD.finditer(self._text, start):
            if first == ordinal:
                field = self.field(ordinal) if field is None else field
                line = self._text.count(b"\n", 0, word.start()) + 1
                of = f" ({field})" if field else ""
                raise ProblemError(f"{self.name} line {line}: {shown_word(word[0])} {complaint}{of}")
            first += 1
        raise AssertionError("the text has such a word")


POINT_FIELDS = ("x", "y", "z", "red", "green", "blue", "number of views")
VIEW_FIELDS = ("camera index", "key", "x", "y")


def read_tracks(
    text: Text, start: int, count: int, num_cameras: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, int]:
    """Reads points and their views, as Bundler and VisualSFM write them, from the position of the first one's x among
    the numbers of a text, whose `field` describes those before the points. Returns positions (count, 3); of each view
    camera, point and pixel (views, 2); the position after the last number. Raises ProblemError: the file ends early, or
    something is no number or out of range; or there are no views."""
    values, before, starts, end = text.values, text.field, [], start

    def field(ordinal: int) -> str:
        point = bisect_right(starts, ordinal) - 1
        return before(ordinal) if point < 0 else _point_field(point, ordinal - starts[point])

    text.field = field
    for _ in range(count):
        starts.append(end)
        text.need(end + len(POINT_FIELDS))
        views = float(values[end + 6])
        if not 0 <= views <= LARGEST_COUNT or not views.is_integer():
            text.integers([end + 6], 0, LARGEST_COUNT)
        end += len(POINT_FIELDS) + len(VIEW_FIELDS) * int(views)
        text.need(end)
    first_view = np.array(starts, dtype=np.int64) + len(POINT_FIELDS)
    views = values[first_view - 1].astype(np.int64)
    at = np.repeat(first_view - 4 * (np.cumsum(views) - views), views) + 4 * np.arange(views.sum())
    camera_index = text.integers(at, 0, num_cameras - 1)
    if not camera_index.size:
        raise ProblemError(f"{text.name}: no camera sees a point")
    points = values[first_view[:, None] - len(POINT_FIELDS) + np.arange(3)]
    return points, camera_index, np.repeat(np.arange(count), views), values[at[:, None] + [2, 3]], end


def _point_field(point: int, at: int) -> str:
    if at < len(POINT_FIELDS):
        return f"{POINT_FIELDS[at]} of point {point}"
    view, part = divmod(at - len(POINT_FIELDS), len(VIEW_FIELDS))
    return f"{VIEW_FIELDS[part]} of view {view} of point {point}"


def numbered(index: Int[np.ndarray, " n"]) -> Int[np.ndarray, " n"]:
    """For each entry how many of the same value stand before it: numbers of key-points, from an index of cameras."""
    order, counts = np.argsort(index, kind="stable"), np.bincount(index)
    numbers = np.empty(len(index), np.int64)
    numbers[order] = np.arange(len(order)) - np.repeat(np.cumsum(counts) - counts, counts)
    return numbers


def _parse(text: bytes) -> tuple[np.ndarray, str | None]:
    """The numbers of a text up to the first bad word, and what is wrong with that one, if any."""
    codes = np.frombuffer(text, np.uint8)
    spaces = (codes == 32) | (codes - np.uint8(9) < 5)  # isspace() of C
    count = np.count_nonzero(~spaces[1:] & spaces[:-1]) + (not spaces[0])
    if not count:
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
