"""The log of a run: one JSON object per line, and the same numbers for TensorBoard."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, cast

from jaxba.runtime.atomic import atomic_write

FILE = "metrics.jsonl"
BOARD = "tensorboard"

ORDER = ("seed", "chunk", "updates")  # integers by which rows are ordered and drawn: every row has them
Row = dict[str, Any]  # metrics of one chunk by name; None if not finite


class Log:
    """Appends rows, after removing those that a killed run wrote after its last checkpoint, and damaged ones.

    The calling thread writes TensorBoard's files: that of tensorboardX ends on a full disk, waited for for ever."""

    def __init__(self, folder: Path, chunk: int, report: Callable[[str], None] = lambda _: None) -> None:
        """Opens the log of a run of which so many chunks are done; `report` is called with a line of text if damaged
        lines are dropped. Raises OSError: the file cannot be read or written."""
        self.path, self._chunk = folder / FILE, chunk
        self._boards: dict[int, Any] = {}  # by the number of the agent
        lines, damaged = _lines(self.path)
        kept = [line for line, row in lines if row["chunk"] <= chunk]
        if damaged and kept:
            report(f"{self.path}: {damaged} damaged line{'s' * (damaged > 1)} dropped")
        with atomic_write(self.path) as file:
            file.writelines(kept)
        self._file = self.path.open("a", encoding="utf-8")

    def write(self, row: Mapping[str, Any]) -> Row:
        """Appends a row and returns it as `read` does. Raises OSError."""
        from tensorboardX.summary import scalar

        clean: Row = {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in row.items()}
        self._file.write(json.dumps(clean, allow_nan=False) + "\n")
        self._file.flush()
        for name, value in clean.items():
            if isinstance(value, (int, float)) and name not in ("seed", "chunk"):
                number = scalar(name if "/" in name else f"train/{name}", value)
                self._event(clean["seed"], clean["chunk"], summary=number)
        self._boards[clean["seed"]].flush()
        return clean

    def _event(self, agent: int, step: int, **content: Any) -> None:
        """Writes an event for TensorBoard, which ignores what earlier files have after the chunks that are done."""
        from tensorboardX.event_file_writer import EventsWriter
        from tensorboardX.proto import event_pb2

        messages = cast(Any, event_pb2)
        if agent not in self._boards:
            board = self.path.parent / BOARD / f"seed{agent}"
            board.mkdir(parents=True, exist_ok=True)
            self._boards[agent] = EventsWriter(str(board / "events"))
            if self._chunk:
                self._event(agent, self._chunk + 1, session_log=messages.SessionLog(status=messages.SessionLog.START))
        self._boards[agent].write_event(messages.Event(wall_time=time.time(), step=step, **content))

    def close(self) -> None:
        """Closes all files. Raises OSError."""
        for file in (self._file, *self._boards.values()):
            file.close()


def read(folder: Path) -> list[Row]:
    """All rows of a run, without damaged lines."""
    return [row for _, row in _lines(folder / FILE)[0]]


def _lines(path: Path) -> tuple[list[tuple[bytes, Row]], int]:
    """The lines that hold a row, with that row, and how many do not: cut short, or zeros after a power failure."""
    found: list[tuple[bytes, Row]] = []
    lines = path.read_bytes().splitlines(keepends=True) if path.is_file() else []
    for line in lines:
        try:
            row = json.loads(line)
        except ValueError:
            continue
        if line.endswith(b"\n") and isinstance(row, dict) and all(isinstance(row.get(key), int) for key in ORDER):
            found.append((line, row))
    return found, len(lines) - len(found)
