"""JSON files of other programs: every value is checked as it is taken, and every error names record and field."""

from __future__ import annotations

import json
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from typing import Any, NoReturn

import numpy as np

from jaxba.io.decimals import number
from jaxba.io.encoding import parse_json, read_characters
from jaxba.io.files import StrPath, display_name
from jaxba.problem.bundle_problem import ProblemError

LARGEST_INTEGER = 2**53  # whole numbers below it are exact as float64
_SHOWN = 40  # characters of a bad value in a message


@dataclass(slots=True)
class Record:
    """A value of a JSON file, and how messages call it. Numbers may be texts, as AliceVision writes them."""

    value: Any
    name: str  # of the file
    where: str = ""  # in it

    def fail(self, complaint: str) -> NoReturn:
        """Raises a `ProblemError` about this value."""
        raise ProblemError(f"{self.name}: {self.where}{' ' if self.where else ''}{complaint}")

    def called(self, where: str) -> Record:
        """The same value under another name in messages."""
        return Record(self.value, self.name, where)

    def has(self, key: str) -> bool:
        """Whether this is an object with a key whose value is not null."""
        return isinstance(self.value, dict) and self.value.get(key) is not None

    def get(self, key: str, default: Any = None) -> Record:
        """The value of a key; where it is not there or null, the default if there is one. Raises ProblemError."""
        if default is not None and not self.has(key):
            return Record(default, self.name, self.where)
        if not isinstance(self.value, dict):
            self.fail(f"must be an object with {key}, is {_shown(self.value)}")
        if key not in self.value:
            self.fail(f"has no {key}")
        return Record(self.value[key], self.name, f"{self.where}: {key}" if self.where else key)

    def unknown(self, known: Collection[str]) -> dict[str, int]:
        """Sizes of the values of other keys than the known ones, without those that are empty."""
        others = {key: value for key, value in self.value.items() if key not in known and value}
        return {
            display_name(key): len(value) if isinstance(value, (list, dict)) else 1 for key, value in others.items()
        }

    def rows(self) -> Iterator[Record]:
        """The values of a list; an empty text is an empty list, as AliceVision writes one. Raises ProblemError."""
        if self.value != "" and not isinstance(self.value, list):
            self.fail(f"must be a list, is {_shown(self.value)}")
        for at, value in enumerate(self.value):
            yield Record(value, self.name, f"{self.where}[{at}]")

    def entries(self, what: str) -> Iterator[tuple[str, Record]]:
        """Keys and values of an object, the values called `what KEY`. Raises ProblemError."""
        if not isinstance(self.value, dict):
            self.fail(f"must be an object, is {_shown(self.value)}")
        for key, value in self.value.items():
            yield key, Record(value, self.name, f"{what} {display_name(key)}")

    def numbered(self, key: str, what: str, inside: str = "") -> Iterator[tuple[int, Record]]:
        """Rows of a list, or their `inside`, by their numbers at a key, called `what NUMBER`. Raises ProblemError."""
        for row in self.rows():
            number = row.get(key).integer()
            yield number, (row.get(inside) if inside else row).called(f"{what} {number}")

    def number(self) -> float:
        """A finite number. Raises ProblemError."""
        value = self.value
        if isinstance(value, str):
            try:
                value = number(value.strip())
            except ValueError:
                value = None
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            self.fail(f"must be a number, is {_shown(self.value)}")
        try:
            found = float(value)
        except OverflowError:
            found = np.inf
        if not np.isfinite(found):
            self.fail(f"is not a finite number: {_shown(self.value)}")
        return found

    def integer(self) -> int:
        """A whole number. Raises ProblemError."""
        found = self.number()
        if abs(found) >= LARGEST_INTEGER:
            self.fail(f"is too large: {_shown(self.value)}")
        if not found.is_integer():
            self.fail(f"must be a whole number, is {_shown(self.value)}")
        return int(found)

    def text(self) -> str:
        """A text. Raises ProblemError."""
        if not isinstance(self.value, str):
            self.fail(f"must be a text, is {_shown(self.value)}")
        return self.value

    def flag(self) -> bool:
        """Truth, also as 0, 1, "true" or "false". Raises ProblemError."""
        if isinstance(self.value, bool):
            return self.value
        if self.value in ("true", "false"):
            return self.value == "true"
        return self.number() != 0

    def vector(self, size: int) -> list[float]:
        """A list of finite numbers. Raises ProblemError."""
        value = self.value
        if not isinstance(value, list) or len(value) != size:
            self.fail(f"must be a list of {size} numbers, is {_shown(value)}")
        if all(type(one) is float and abs(one) < np.inf for one in value):
            return value
        return [row.number() for row in self.rows()]


def read_json(path: StrPath) -> Record:
    """The contents of a JSON file, decompressed; NaN and Infinity, which JSON lacks, are found when they are taken.
    Raises ProblemError: the file cannot be read, is no JSON, is nested too deeply, or an object has a key twice."""
    name = display_name(path)
    text = read_characters(path)
    try:
        return Record(parse_json(text), name)
    except ProblemError as error:
        raise ProblemError(f"{name}: {error}") from None
    except json.JSONDecodeError as error:
        raise ProblemError(f"{name} line {error.lineno}: not JSON: {error.msg}") from None
    except RecursionError:
        raise ProblemError(f"{name}: is nested too deeply") from None
    except ValueError:  # Python reads no integers of thousands of digits
        raise ProblemError(f"{name}: holds a number of too many digits") from None
    except MemoryError:
        raise ProblemError(f"cannot read {name}: not enough memory") from None


def _shown(value: Any) -> str:
    if isinstance(value, (dict, list)):
        return f"{'an object' if isinstance(value, dict) else 'a list'} of {len(value)}"
    try:
        text = ascii(value)
    except ValueError:  # an integer of thousands of digits, as a text
        return "a number of too many digits"
    return text if len(text) <= _SHOWN else text[: _SHOWN - 3] + "..."
