"""Files of one JSON object per line, as dataclasses of numbers, texts, tuples and further
dataclasses.

Numbers that are not finite are written as null, which is read as NaN. A killed run leaves half a
line at most."""

from __future__ import annotations

import json
import logging
import math
import os
import typing
from collections.abc import Mapping
from dataclasses import MISSING, fields, is_dataclass
from pathlib import Path
from typing import Any, TypeVar

from jaxba.io.encoding import parse_json
from jaxba.problem.bundle_problem import ProblemError

_log = logging.getLogger(__name__)

T = TypeVar("T")

LONGEST_LINE = 1 << 24  # bytes at the end of a file that are looked at before it is appended to

_NAMES = {int: "a whole number", str: "a text", bool: "true or false"}


def key_of(field: Any) -> str:
    """The JSON key of a dataclass field: its name, or the `key` of its metadata."""
    return field.metadata.get("key", field.name)


def plain(value: Any) -> Any:
    """JSON of dataclasses, named tuples, mappings and tuples; numbers that are not finite become
    None."""
    if is_dataclass(value):
        return {key_of(field): plain(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, tuple) and hasattr(value, "_asdict"):
        value = value._asdict()  # pyright: ignore[reportAttributeAccessIssue]
    if isinstance(value, Mapping):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def from_plain(kind: type[T], data: Any, path: str = "") -> T:
    """The inverse of `plain`; ignores unknown keys. Raises ProblemError: a key without a default is
    missing, or one is of a wrong type."""
    if not isinstance(data, Mapping):
        raise ProblemError(f"{path or 'the record'} is no object")
    hints = typing.get_type_hints(kind)
    values = {}
    above = f"{path}." if path else ""
    for field in fields(kind):  # type: ignore[arg-type]
        key = key_of(field)
        if key not in data and field.default is not MISSING:
            continue
        if key not in data:
            raise ProblemError(f"{above}{key} is missing")
        values[field.name] = _value(hints[field.name], data[key], f"{above}{key}")
    return kind(**values)


def _value(kind: Any, value: Any, path: str) -> Any:
    if typing.get_origin(kind) is tuple:
        if not isinstance(value, list):
            raise ProblemError(f"{path} must be a list")
        return tuple(
            _value(typing.get_args(kind)[0], item, f"{path}[{i}]") for i, item in enumerate(value)
        )
    if is_dataclass(kind):
        return from_plain(typing.cast(type, kind), value, path)
    if kind is float:
        if value is None or type(value) in (int, float):
            return math.nan if value is None else float(value)
        raise ProblemError(f"{path} must be a number")
    if type(value) is not kind:
        raise ProblemError(f"{path} must be {_NAMES[kind]}")
    return value


def read(path: str | os.PathLike[str], kind: type[T]) -> list[T]:
    """All lines of a file, in order. Skips empty lines and, with a warning in the log, an
    incomplete last one. Raises ProblemError: unreadable, or another malformed line; names file and
    line."""
    try:
        lines = Path(path).read_bytes().split(b"\n")
        found = []
    except OSError as error:
        raise ProblemError(f"{path}: {error.strerror or error}") from None
    for number, line in enumerate(lines, start=1):
        if not line.strip():
            continue
        try:
            found.append(from_plain(kind, parse_json(line)))
        except (ProblemError, OverflowError) as error:
            raise ProblemError(f"{path}, line {number}: {error}") from None
        except (ValueError, RecursionError):  # no JSON or no UTF-8
            if number < len(lines):
                raise ProblemError(f"{path}, line {number}: this is no JSON") from None
            _log.warning(
                "%s, line %d: half-written last line of an interrupted run dropped", path, number
            )
    return found


def append(path: str | os.PathLike[str], value: Any) -> None:
    """Appends a line in a single write, followed by fsync.

    If the file ends in an incomplete line, that line is removed first. If only the newline after a
    complete line is missing, it is added. Only one process may write at a time. Raises OSError: the
    file cannot be written."""
    line = json.dumps(plain(value), allow_nan=False, separators=(",", ":")).encode() + b"\n"
    with open(path, "a+b") as file:
        size = file.seek(0, os.SEEK_END)
        file.seek(max(0, size - LONGEST_LINE))
        tail = file.read().rpartition(b"\n")[2]
        if tail:
            try:
                json.loads(tail)
                line = b"\n" + line
            except ValueError:
                file.truncate(size - len(tail))
                _log.warning("%s: half-written last line of an interrupted run removed", path)
        file.write(line)
        file.flush()
        os.fsync(file.fileno())
