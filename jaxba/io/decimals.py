"""Decimal numbers as text: correctly rounded when read, and the shortest that read back the same
when written.

Large texts go through SciPy's reader and writer of Matrix Market files, whose bodies are lines of
such numbers. They are in C++, with threads, three times as fast as NumPy's and Python's; but to
import them takes 0.4 seconds."""

from __future__ import annotations

import io
import re
import warnings
from contextlib import suppress

import numpy as np
from jaxtyping import Float, Int

_WORD = re.compile(rb"[^ \t\n\r\v\f]+")
_NUMBER = re.compile(rb"[+-]?(?:\d+\.?\d*|\.\d+)(?:[ed][+-]?\d+)?", re.IGNORECASE)
_NOT_FINITE = re.compile(
    # the last is Microsoft's, as 1.#QNAN
    rb"[+-]?(?:nan(?:\(\w*\))?|inf(?:inity)?|\d\.#(?:[qs]nan|ind|inf)\d*)",
    re.IGNORECASE,
)
SMALL = 1 << 17  # numbers that are written without SciPy, and a sixteenth of those that are read so
_PLUS = re.compile(rb"(?<![^ \t\n\r\v\f])\+(?=[\d.])")  # before a number
_FORTRAN_TO_C = bytes.maketrans(b"Dd", b"Ee")

_DIGIT, _POINT, _SIGN, _EXPONENT, _SPACE, _OTHER = (1 << k for k in range(6))  # kinds of characters
_KINDS = {
    _DIGIT: b"0123456789",
    _POINT: b".",
    _SIGN: b"+-",
    _EXPONENT: b"eE",
    _SPACE: b" \t\n\r\v\f",
}
_KIND_OF = bytes(
    next((kind for kind, these in _KINDS.items() if byte in these), _OTHER) for byte in range(256)
)
_TO_LINES = bytes.maketrans(_KINDS[_SPACE], 6 * b"\n")
_HEADER = b"%%%%MatrixMarket matrix array real general\n%d 1\n"
_HEADER_LINES = 3  # of what SciPy writes


def number(word: str) -> float:
    """The number that a word is, also with Fortran's exponents (1.0D+00); NaN if it is one that is
    not finite in any spelling (inf, -nan(ind), 1.#QNAN). Raises ValueError: it is no number."""
    text = word.encode("utf-8", "replace")
    if _NUMBER.fullmatch(text):
        return float(text.translate(_FORTRAN_TO_C))
    if _NOT_FINITE.fullmatch(text):
        return float("nan")
    raise ValueError(f"{word!r} is no number")


def parse(text: bytes, *, large: bool = True) -> tuple[Float[np.ndarray, " n"], str | None]:
    """The numbers of a text, which may be part of a large one, up to the first bad word, and what
    is wrong with that one, if any."""
    text = b"\n%b\n" % text
    values = _parse_lines(text, large)
    complaint = None
    if values is None:
        values = _parse_lines(_PLUS.sub(b" ", text.translate(_FORTRAN_TO_C)), large)
    if values is None:  # one of the words is no number, or not finite: search it word by word
        good = []
        for word in _WORD.findall(text):
            try:
                good.append(number(word.decode("latin-1")))
            except ValueError:
                complaint = "is not a number"
                break
        values = np.array(good, np.float64)
    finite = np.isfinite(values)
    return (
        (values, complaint)
        if finite.all()
        else (values[: finite.argmin()], "is not a finite number")
    )


def observation_lines(
    camera_index: Int[np.ndarray, " n"],
    point_index: Int[np.ndarray, " n"],
    pixels: Float[np.ndarray, "n 2"],
) -> bytes:
    """Lines of an index of a camera, one of a point, and x and y; n > 0."""
    if len(pixels) < SMALL:
        rows = zip(camera_index.tolist(), point_index.tolist(), pixels.tolist(), strict=True)
        return "".join(f"{camera} {point} {x} {y}\n" for camera, point, (x, y) in rows).encode()
    from scipy.sparse import coo_array

    complex_pixels = np.ascontiguousarray(pixels, np.float64).view(np.complex128)[:, 0]
    entries = coo_array((complex_pixels, (camera_index, point_index)))
    # the format counts from 1
    entries.row, entries.col = camera_index - np.int32(1), point_index - np.int32(1)
    return _written(entries)


def number_lines(values: Float[np.ndarray, " n"]) -> bytes:
    """Lines of one number each; n > 0."""
    if len(values) < SMALL:
        return "".join(f"{number}\n" for number in values.tolist()).encode()
    return _written(np.asarray(values, np.float64)[:, None])


def _written(matrix: object) -> bytes:
    from scipy.io import mmwrite

    file = io.BytesIO()
    mmwrite(file, matrix, symmetry="general")
    return file.getvalue().split(b"\n", _HEADER_LINES)[_HEADER_LINES].lower()


def _parse_lines(text: bytes, large: bool) -> Float[np.ndarray, " n"] | None:
    """The numbers of a text between spaces; None if one of its words is no number, or begins with a
    plus.

    SciPy's reader takes the longest number that a line begins with, and drops the rest, and the
    sign of zero."""
    kinds = np.frombuffer(text.translate(_KIND_OF), np.uint8)
    before = kinds[:-1]
    after = kinds[1:]
    count = np.count_nonzero((before != _SPACE) & (after == _SPACE))
    if count and not large:
        with warnings.catch_warnings(), suppress(ValueError, DeprecationWarning):
            # NumPy before 2.3 warns instead of raising ValueError
            warnings.simplefilter("error", DeprecationWarning)
            values = np.fromstring(text, dtype=np.float64, sep=" ")
            return values if values.size == count else None
        return None
    torn = ((after == _SIGN) & (before < _EXPONENT)) | (
        (after == _SPACE) & (before & (_SIGN | _EXPONENT) != 0)
    )
    parts = kinds.tobytes().translate(None, bytes([_DIGIT, _SIGN]))
    wrong = ((_OTHER,), (_POINT, _POINT), (_EXPONENT, _POINT), (_EXPONENT, _EXPONENT))
    if not count or torn.any() or any(bytes(one) in parts for one in wrong):
        return None if count else np.empty(0)
    from scipy.io import mmread

    try:
        values = np.asarray(mmread(io.BytesIO(_HEADER % count + text.translate(_TO_LINES)))).ravel()
    except ValueError:
        return None
    zeros = np.flatnonzero(values == 0)
    if zeros.size:
        starts = np.flatnonzero((before == _SPACE) & (after != _SPACE)) + 1
        values[zeros[np.frombuffer(text, np.uint8)[starts[zeros]] == ord("-")]] = -0.0
    return values
