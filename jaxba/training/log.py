"""The log of a run: one JSON object per line, and the same numbers for TensorBoard."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

FILE = "metrics.jsonl"
BOARD = "tensorboard"

Row = dict[str, Any]
"""Metrics of one chunk by name; None if not finite."""


class Log:
    """Appends rows, after removing those that a killed run wrote after its last checkpoint."""

    def __init__(self, folder: Path, size: int, seed: int, chunk: int) -> None:
        """Opens the log of a run.

        Args:
            folder: of the run.
            size: length to which the file is cut, bytes.
            seed: number of the agent that is trained next, for TensorBoard.
            chunk: chunks that this agent has done.
        """
        self.path = folder / FILE
        self._boards = folder / BOARD
        self._board: tuple[int, Any] | None = None
        self._purge = {seed: chunk + 1} if size else {}
        self.path.touch()
        with self.path.open("r+b") as file:
            file.truncate(min(size, os.fstat(file.fileno()).st_size))
        self._file = self.path.open("a", encoding="utf-8")

    @property
    def size(self) -> int:
        """Bytes written and flushed."""
        return self._file.tell()

    def write(self, row: Mapping[str, Any]) -> Row:
        """Appends a row and returns it as `read` does."""
        clean: Row = {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in row.items()}
        self._file.write(json.dumps(clean, allow_nan=False) + "\n")
        self._file.flush()
        board = self._writer(clean["seed"])
        for name, value in clean.items():
            if isinstance(value, (int, float)) and name not in ("seed", "chunk"):
                board.add_scalar(name if "/" in name else f"train/{name}", value, clean["chunk"])
        board.flush()
        return clean

    def _writer(self, seed: int) -> Any:
        if self._board is None or self._board[0] != seed:
            from tensorboardX import SummaryWriter

            if self._board:
                self._board[1].close()
            folder = self._boards / f"seed{seed}"
            # with `purge_step` TensorBoard ignores what a killed run wrote after its last checkpoint
            self._board = seed, SummaryWriter(str(folder), purge_step=self._purge.pop(seed, 0))
        return self._board[1]

    def close(self) -> None:
        """Closes all files."""
        self._file.close()
        if self._board:
            self._board[1].close()


def read(folder: Path) -> list[Row]:
    """All rows of a run, without an incomplete last line."""
    path = folder / FILE
    if not path.is_file():
        return []
    lines = path.read_text(encoding="utf-8").split("\n")[:-1]
    return [json.loads(line) for line in lines]
