"""The log of a run: one JSON object per line (io/json_lines.py), a row of every agent after each
chunk."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from jaxba.io import json_lines
from jaxba.runtime.atomic import atomic_write

FILE = "metrics.jsonl"

# integers by which rows are ordered and drawn: every row has them
ORDER = ("seed", "chunk", "updates")
Row = dict[str, Any]  # metrics of one chunk by name; None if not finite


def begin(folder: Path, chunk: int, report: Callable[[str], None]) -> None:
    """Removes rows that a killed run wrote after its last checkpoint, the one after `chunk`, and
    damaged ones, of which `report` gets a line of text. Raises OSError: the file cannot be read or
    written."""
    path = folder / FILE
    lines, damaged = _lines(path)
    kept = [line for line, row in lines if row["chunk"] <= chunk]
    if damaged and kept:
        report(f"{path}: {damaged} damaged line{'s' * (damaged > 1)} dropped")
    with atomic_write(path) as file:
        file.writelines(kept)


def write(folder: Path, row: Mapping[str, Any]) -> Row:
    """Appends a row and returns it as `read` does. Raises OSError."""
    json_lines.append(folder / FILE, row)
    return json_lines.plain(row)


def read(folder: Path) -> list[Row]:
    """All rows of a run, without damaged lines."""
    return [row for _, row in _lines(folder / FILE)[0]]


def _lines(path: Path) -> tuple[list[tuple[bytes, Row]], int]:
    """The lines that hold a row, with that row, and how many do not: cut short, or zeros after a
    power failure."""
    found: list[tuple[bytes, Row]] = []
    lines = path.read_bytes().splitlines(keepends=True) if path.is_file() else []
    for line in lines:
        try:
            row = json.loads(line)
        except ValueError:
            continue
        if (
            line.endswith(b"\n")
            and isinstance(row, dict)
            and all(isinstance(row.get(key), int) for key in ORDER)
        ):
            found.append((line, row))
    return found, len(lines) - len(found)
