"""Random damage to the bytes of files: cut, flipped, repeated, removed and swapped fields and
lines, absurd numbers."""

from __future__ import annotations

import re
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np

WORDS = (
    b"",
    b"-1",
    b"0",
    b"1.5",
    b"nan",
    b"-inf",
    b"1e999",
    b"1e308",
    b"1e-999",
    b"abc",
    b"\xff\xfe",
    b"1_0",
    b"1,5",
)
COUNTS = (
    b"2147483647",
    b"4294967296",
    b"1000000000000000000",
    b"99999999999999999999",
    b"9" * 400,
    b"0x10",
    b"-0",
)
"""Words in place of those of a text."""

NEW_NUMBERS = (b"0", b"1", b"2", b"-1", b"5", b"39", b"40", b"1e-12", b"1e12", b"0.0", b"1e200")
"""Words in place of its numbers."""

NUMBERS = (
    *(struct.pack("<q", x) for x in (-1, 0, 1, 2**31, 2**40, 2**62, -(2**63))),
    *(struct.pack("<d", x) for x in (float("nan"), float("inf"), 0.0, -1.0, 1e308, 1e-308)),
    *(struct.pack("<i", x) for x in (-1, 0, 1, 7, 2**31 - 1)),
)
"""Bytes in place of those of a binary file."""

SEPARATORS = re.compile(rb"([\s,:\[\]{}]+)")


def _flip(content: bytearray, rng: np.random.Generator) -> None:
    content[rng.integers(len(content))] ^= int(rng.integers(1, 256))


def _cut(content: bytearray, rng: np.random.Generator) -> None:
    del content[rng.integers(len(content)) :]


def _remove(content: bytearray, rng: np.random.Generator) -> None:
    start = rng.integers(len(content))
    del content[start : start + rng.integers(1, 40)]


def _insert(content: bytearray, rng: np.random.Generator) -> None:
    start = int(rng.integers(len(content)))
    content[start:start] = rng.bytes(int(rng.integers(1, 9)))


def _repeat(content: bytearray, rng: np.random.Generator) -> None:
    start = int(rng.integers(len(content)))
    content[start:start] = content[start : start + int(rng.integers(1, 200))]


def _number(content: bytearray, rng: np.random.Generator) -> None:
    start = int(rng.integers(len(content)))
    new = NUMBERS[rng.integers(len(NUMBERS))]
    # counts stand at the beginning, and after it at multiples
    start -= start % len(new) if rng.random() < 0.5 else 0
    content[start : start + len(new)] = new


def _head(content: bytearray, rng: np.random.Generator) -> None:
    content[:8] = NUMBERS[rng.integers(7)]


def _words(change: Callable[[list[bytes], np.ndarray, np.random.Generator], None]) -> Callable:
    """A damage of words or, half of the time, lines, of which it gets all and two random places."""

    def damage(content: bytearray, rng: np.random.Generator) -> None:
        parts = (
            SEPARATORS.split(bytes(content))
            if rng.random() < 0.5
            else re.split(rb"(\n)", bytes(content))
        )
        change(parts, 2 * rng.integers((len(parts) + 1) // 2, size=2), rng)
        content[:] = b"".join(parts)

    return damage


@_words
def _replace_word(parts: list[bytes], at: np.ndarray, rng: np.random.Generator) -> None:
    words = (*WORDS, *COUNTS)
    parts[at[0]] = words[rng.integers(len(words))]


@_words
def _swap_words(parts: list[bytes], at: np.ndarray, rng: np.random.Generator) -> None:
    parts[at[0]], parts[at[1]] = parts[at[1]], parts[at[0]]


@_words
def _copy_word(parts: list[bytes], at: np.ndarray, rng: np.random.Generator) -> None:
    parts[at[0]] = parts[at[1]]


@_words
def _remove_word(parts: list[bytes], at: np.ndarray, rng: np.random.Generator) -> None:
    del parts[at[0] : at[0] + 2]


@_words
def _repeat_word(parts: list[bytes], at: np.ndarray, rng: np.random.Generator) -> None:
    parts[at[0] : at[0]] = parts[at[0] : at[0] + 2]


@_words
def _change_number(parts: list[bytes], at: np.ndarray, rng: np.random.Generator) -> None:
    """Another number that is still one: a digit, the sign or the exponent changes, or all of it."""
    numbers = [k for k, part in enumerate(parts) if part.lstrip(b"-")[:1].isdigit()]
    if not numbers:
        return
    k = numbers[rng.integers(len(numbers))]
    digits = [i for i, c in enumerate(parts[k]) if chr(c).isdigit()]
    kind = rng.integers(4)
    i = digits[rng.integers(len(digits))]
    if kind == 0:
        parts[k] = parts[k][:i] + b"%d" % rng.integers(10) + parts[k][i + 1 :]
    elif kind == 1:
        parts[k] = parts[k][1:] if parts[k].startswith(b"-") else b"-" + parts[k]
    elif kind == 2:
        parts[k] += b"e%d" % rng.choice([-300, -9, 3, 9, 150, 300])
    else:
        parts[k] = NEW_NUMBERS[rng.integers(len(NEW_NUMBERS))]


BYTES = (_flip, _cut, _remove, _insert, _repeat, _number)
TEXT = (
    *BYTES,
    *8 * (_change_number,),
    *(_replace_word, _swap_words, _copy_word, _remove_word, _repeat_word),
)
BINARY = (*BYTES, *6 * (_number,), _head)


def damaged(content: bytes, rng: np.random.Generator) -> bytes:
    """The content after one or a few random damages."""
    kinds = BINARY if b"\0" in content[:64] else TEXT
    changed = bytearray(content)
    for _ in range(rng.geometric(0.7)):
        if changed:
            kinds[rng.integers(len(kinds))](changed, rng)
    return bytes(changed)


def damage_folder(folder: Path, rng: np.random.Generator) -> None:
    """Damages one file in the folder, or now and then empties or removes it, or swaps it with
    another one."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    one, other = (files[k] for k in rng.integers(len(files), size=2))
    kind = rng.random()
    if kind < 0.02:
        one.unlink()
    elif kind < 0.04:
        one.write_bytes(b"")
    elif kind < 0.06:
        first = one.read_bytes()
        second = other.read_bytes()
        one.write_bytes(second)
        other.write_bytes(first)
    else:
        one.write_bytes(damaged(one.read_bytes(), rng))
