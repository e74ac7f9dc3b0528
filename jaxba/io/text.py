"""Reader of lines, of whitespace-separated numbers, and of points among them; every error names its
line."""

from __future__ import annotations

import re
from bisect import bisect_right
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import NoReturn

import numpy as np
from jaxtyping import Int

from jaxba.io.decimals import SMALL, number, parse
from jaxba.problem.bundle_problem import ProblemError
from jaxba.typing import LARGEST_COUNT

# bytes that are parsed at once. With 4 MiB the arrays of a block stay near the cache
BLOCK_BYTES = 1 << 22
SHOWN = 40  # characters of a wrong word that a message shows

_SPACE = re.compile(rb"[ \t\n\r\v\f]")
_WORD = re.compile(rb"[^ \t\n\r\v\f]+")


def shown_word(word: bytes) -> str:
    """A word for a message, shortened."""
    text = word.decode("latin-1")
    return ascii(text if len(text) <= SHOWN else f"{text[: SHOWN - 3]}...")


def finite_numbers(words: Sequence[str | bytes], fields: Sequence[str], where: str) -> list[float]:
    """Words as finite numbers; `fields` are their names. Raises ProblemError, beginning with
    `where`: one is not."""
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

    Numbers are float64, correctly rounded. A number's *ordinal* is its position among them, from
    0."""

    def __init__(self, pieces: Iterable[bytes], name: str):
        """`pieces` of the text of the file called `name`, with lines that end in LF."""
        self.name = name
        self.line = 0  # number of the line that was read last, from 1
        self.values = np.empty(0)  # the numbers that are kept, up to the first word that is none
        # what the number at an ordinal is; may be replaced while reading
        self.field: Callable[[int], str]
        # what follows, and where in it the next line begins
        self._pieces = iter(pieces)
        self._text = b""
        self._at = 0
        # those kept: ordinal of the first number, lines before, text
        self._blocks: list[tuple[int, int, bytes]] = []
        # ordinals of the first number that is kept, and of the next one to read
        self._start = self._count = 0
        self._last = 0, b""  # lines before the last block that is not blank, and its text
        self._complaint: str | None = None  # about the word after the last number

    @property
    def where(self) -> str:
        """The line that was read last, for messages."""
        return f"{self.name} line {max(self.line, 1)}"

    def next_line(self) -> bytes:
        """The next line that is not blank, without blanks at its ends; empty at the end of the
        text."""
        line = b""
        while not line:
            while (end := self._text.find(b"\n", self._at)) < 0 and self._more():
                pass
            if self._at >= len(self._text):
                break
            end = end if end >= 0 else len(self._text)
            line = self._text[self._at : end].strip()
            self._at = end + 1
            self.line += 1
        return line

    def read_numbers(self, field: Callable[[int], str]) -> np.ndarray:
        """Parses all that follows the lines that were read; returns `values`."""
        parts = [np.empty(0)]
        blocks = []
        for _ in self.number_blocks(field):
            parts.append(self.values)
            blocks += self._blocks
        self.values = np.concatenate(parts)
        self._blocks = blocks
        self._start = 0
        return self.values

    def number_blocks(self, field: Callable[[int], str]) -> Iterator[range]:
        """Parses the same a block at a time. Yields ordinals of its numbers, which until the next
        one are `values`."""
        self.field, lines, last = field, self.line, False
        self._last = max(lines - 1, 0), b""
        while not last and self._complaint is None:
            while not (space := _SPACE.search(self._text, self._at + BLOCK_BYTES)) and self._more():
                pass
            last = space is None
            end = space.end() if space else len(self._text)
            text = self._text[self._at : end]
            self._at = end
            self._blocks, self._start = [(self._count, lines, text)], self._count
            self.values, self._complaint = parse(text, large=self._count > 16 * SMALL)
            if self.values.size:
                self._last = lines, text
            lines += int(np.count_nonzero(np.frombuffer(text, np.uint8) == ord("\n")))
            self._count += len(self.values)
            yield range(self._start, self._count)

    def need(self, count: int) -> None:
        """Refuses a text of fewer numbers. Raises ProblemError: it says why there are no more of
        them."""
        if count > self._count and self._complaint is not None:
            self.fail(self._count, self._complaint)
        if count > self._count:
            line = self._last[0] + self._last[1].rstrip().count(b"\n") + 1
            raise ProblemError(
                f"{self.name} line {line}: the file ends before the {self.field(self._count)}"
            )

    def finish(self, count: int) -> None:
        """Refuses a text in which a word follows so many numbers. Raises ProblemError."""
        if count < self._count or self._complaint is not None:
            self.fail(count, "is left over after the last number", field="")

    def integers(
        self, ordinals: range | Sequence[int] | np.ndarray, low: int, high: int
    ) -> np.ndarray:
        """The numbers at some ordinals as int32. Raises ProblemError: one is no integer in `[low,
        high]`."""
        values = self.at(ordinals)
        whole = values == np.floor(values)
        bad = np.flatnonzero(~(whole & (values >= low) & (values <= high)))
        if bad.size:
            complaint = f"is outside {low}..{high}" if whole[bad[0]] else "is not an integer"
            self.fail(int(ordinals[bad[0]]), complaint)
        return values.astype(np.int32)

    def at(self, ordinals: range | Sequence[int] | np.ndarray) -> np.ndarray:
        """The numbers at some ordinals that are kept."""
        if isinstance(ordinals, range):
            return self.values[
                ordinals.start - self._start : max(ordinals.stop - self._start, 0) : ordinals.step
            ]
        return self.values[np.asarray(ordinals) - self._start]

    def fail(self, ordinal: int, complaint: str, *, field: str | None = None) -> NoReturn:
        """Raises a `ProblemError` about the number (or bad word) at an ordinal."""
        first, lines, text = self._blocks[
            bisect_right(self._blocks, ordinal, key=lambda block: block[0]) - 1
        ]
        for word in _WORD.finditer(text):
            if first == ordinal:
                field = self.field(ordinal) if field is None else field
                line = lines + text.count(b"\n", 0, word.start()) + 1
                of = f" ({field})" if field else ""
                raise ProblemError(
                    f"{self.name} line {line}: {shown_word(word[0])} {complaint}{of}"
                )
            first += 1
        raise AssertionError("the text has such a word")

    def _more(self) -> bool:
        """Takes a block more of the text; False at its end."""
        parts = [self._text[self._at :]]
        size = 0
        for piece in self._pieces:
            parts.append(piece)
            size += len(piece)
            if size >= BLOCK_BYTES:
                break
        self._text = b"".join(parts)
        self._at = 0
        return size > 0


POINT_FIELDS = ("x", "y", "z", "red", "green", "blue", "number of views")
VIEW_FIELDS = ("camera index", "key", "x", "y")


def read_tracks(
    text: Text, start: int, count: int, num_cameras: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, int]:
    """Reads points and their views, as Bundler writes them, from the position of the first one's x
    among the numbers of a text, whose `field` describes those before the points. Returns positions
    (count, 3); of each view camera, point and pixel (views, 2); the position after the last number.
    Raises ProblemError: the file ends early, or something is no number or out of range; or there
    are no views."""
    values = text.values
    before = text.field
    starts = []
    end = start

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
    return (
        points,
        camera_index,
        np.repeat(np.arange(count), views),
        values[at[:, None] + [2, 3]],
        end,
    )


def _point_field(point: int, at: int) -> str:
    if at < len(POINT_FIELDS):
        return f"{POINT_FIELDS[at]} of point {point}"
    view, part = divmod(at - len(POINT_FIELDS), len(VIEW_FIELDS))
    return f"{VIEW_FIELDS[part]} of view {view} of point {point}"


def numbered(index: Int[np.ndarray, " n"]) -> Int[np.ndarray, " n"]:
    """For each entry how many of the same value stand before it: numbers of key-points, from an
    index of cameras."""
    counts = np.bincount(index)
    numbers = np.arange(len(index), dtype=np.int32)
    numbers -= np.repeat((np.cumsum(counts) - counts).astype(np.int32), counts)
    numbers[grouped(index, len(counts))] = numbers.copy()
    return numbers


def grouped(index: Int[np.ndarray, " n"], bound: int) -> Int[np.ndarray, " n"]:
    """`argsort(index, kind="stable")` of an index below a bound, in linear time."""
    from scipy.sparse import csr_array

    rows = np.arange(len(index) + 1, dtype=np.int32)
    return (
        csr_array((np.ones(len(index), np.int8), index, rows), shape=(len(index), bound))
        .tocsc()
        .indices
    )
