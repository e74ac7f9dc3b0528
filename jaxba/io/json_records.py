"""JSON files of other programs: every value is checked as it is taken, and every error names record
and field."""

from __future__ import annotations

import json
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from typing import Any, NoReturn

import numpy as np

from jaxba.io.encoding import parse_json, read_characters
from jaxba.io.files import StrPath, display_name
from jaxba.problem.bundle_problem import ProblemError

_SHOWN = 40  # characters of a bad value in a message


@dataclass(slots=True)
class Record:
    """A value of a JSON file, and how messages call it."""

    value: Any
    name: str  # of the file
    where: str = ""  # in it

    def fail(self, complaint: str) -> NoReturn:
        """Raises a `ProblemError` about this value."""
        raise ProblemError(f"{self.name}: {self.where}{' ' if self.where else ''}{complaint}")

    def has(self, key: str) -> bool:
        """Whether this is an object with a key whose value is not null."""
        return isinstance(self.value, dict) and self.value.get(key) is not None

    def get(self, key: str, default: Any = None) -> Record:
        """The value of a key; where it is not there or null, the default if there is one. Raises
        ProblemError."""
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
            display_name(key): len(value) if isinstance(value, (list, dict)) else 1
            for key, value in others.items()
        }

    def rows(self) -> Iterator[Record]:
        """The values of a list. Raises ProblemError."""
        if not isinstance(self.value, list):
            self.fail(f"must be a list, is {_shown(self.value)}")
        for at, value in enumerate(self.value):
            yield Record(value, self.name, f"{self.where}[{at}]")

    def entries(self, what: str) -> Iterator[tuple[str, Record]]:
        """Keys and values of an object, the values called `what KEY`. Raises ProblemError."""
        if not isinstance(self.value, dict):
            self.fail(f"must be an object, is {_shown(self.value)}")
        for key, value in self.value.items():
            yield key, Record(value, self.name, f"{what} {display_name(key)}")

    def number(self) -> float:
        """A finite number. Raises ProblemError."""
        value = self.value
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            self.fail(f"must be a number, is {_shown(self.value)}")
        try:
            found = float(value)
        except OverflowError:
            found = np.inf
        if not np.isfinite(found):
            self.fail(f"is not a finite number: {_shown(self.value)}")
        return found

    def text(self) -> str:
        """A text. Raises ProblemError."""
        if not isinstance(self.value, str):
            self.fail(f"must be a text, is {_shown(self.value)}")
        return self.value

    def vector(self, size: int) -> list[float]:
        """A list of finite numbers. Raises ProblemError."""
        value = self.value
        if not isinstance(value, list) or len(value) != size:
            self.fail(f"must be a list of {size} numbers, is {_shown(value)}")
        if all(type(one) is float and abs(one) < np.inf for one in value):
            return value
        return [row.number() for row in self.rows()]


def read_json(path: StrPath) -> Record:
    """The contents of a JSON file, decompressed; NaN and Infinity, which JSON lacks, are found when
    they are taken. Raises ProblemError: the file cannot be read, is no JSON, is nested too deeply,
    or an object has a key twice."""
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
    text = ascii(value)
    return text if len(text) <= _SHOWN else text[: _SHOWN - 3] + "..."
