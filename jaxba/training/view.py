"""What a terminal shows while a policy is trained; elsewhere lines of text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from jaxba.training.log import Row

BLOCKS = "▁▂▃▄▅▆▇█"
"""Heights of a bar in the line of past scores."""

PAST = 24
"""Evaluations in that line."""


class TrainingView:
    """A progress bar and a table of the last numbers beside the yardsticks, redrawn in place."""

    def __init__(self, console: Any, config: Any) -> None:
        from rich.live import Live
        from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

        self.console, self.config = console, config
        self.rules: Mapping[str, Any] = {}
        self.best: Sequence[Any] = ()  # the best policies that this process has trained
        self._rows: Sequence[Row] = ()
        self._scored: Sequence[Row] = ()
        self._past: list[float] = []
        self._bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(bar_width=20),
            TimeElapsedColumn(),
            TextColumn("ETA"),
            TimeRemainingColumn(),
            TextColumn("{task.fields[now]}"),
            speed_estimate_period=600,
        )
        self._live = Live(self._bar, console=console, transient=True) if console.is_terminal else None
        self._task = self._bar.add_task("starting", total=None, now="")

    def __enter__(self) -> TrainingView:
        if self._live:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._live:
            self._live.stop()

    def stage(self, description: str) -> None:
        """Reports the start of a stage."""
        self._bar.update(self._task, description=description, now="")
        if not self._live:
            self.console.print(description)

    def rows(self, rows: Sequence[Row]) -> None:
        """Reports a finished chunk, by its rows of the training log."""
        row, total = rows[0], self.config.chunks
        speed = f"{row['steps_per_s']:.0f} steps/s, {row['updates_per_s']:.0f} updates/s"
        description = f"chunk {row['chunk']}/{total}"
        if self._bar.tasks[0].total is None:
            self._bar.reset(self._task, total=total, completed=row["chunk"] - 1)
        self._bar.update(self._task, description=description, total=total, completed=row["chunk"], now=speed)
        self._rows = rows
        if "held_out/score" in row:
            self._scored = rows
            self._past.append(_mean(rows, "held_out/score"))
        if self._live:
            self._live.update(self._drawn())
            return
        ended = [one for one in rows if one["episodes"]]
        if ended:
            length, rule = _mean(ended, "episode/length"), _mean(ended, "episode/ceres")
            speed += f", {length:.1f} iterations (Ceres' rule {rule:.1f})"
        self.console.print(f"{description}: {speed}, {row['wall_s']:.0f} s")
        if "held_out/score" in row:
            self.console.print(f"{description}: {self._held_out(rows)}")

    def _drawn(self) -> Any:
        from rich.console import Group

        return Group(self._bar, self.table())

    def _yardsticks(self) -> dict[str, Any]:
        from jaxba.training.task import CONSTANT

        return {name: self.rules[name] for name in ("ceres", "ceres+embedded", CONSTANT) if name in self.rules}

    def table(self) -> Any:
        """The last numbers: mean and range over agents, and the yardsticks."""
        from rich.table import Table

        shown = self._yardsticks()
        table = Table(box=None, pad_edge=False, title_justify="left")
        table.add_column("")
        for name in ("trained", *(["agents"] if self.config.seeds > 1 else []), *shown):
            table.add_column(name, justify="right")

        def add(label: str, rows: Sequence[Row], name: str, others: Sequence[float], scale: float = 1.0) -> None:
            values = [scale * row[name] for row in rows if row.get(name) is not None]
            if values:
                spread = [f"{min(values):.2f} to {max(values):.2f}"] if self.config.seeds > 1 else []
                table.add_row(label, f"{sum(values) / len(values):.2f}", *spread, *(f"{x:.2f}" for x in others))

        played = [row for row in self._rows if row["episodes"]]
        usual = [_mean(played, "episode/ceres")] if played and shown else []
        add("episodes of this chunk: iterations", played, "episode/length", usual)
        add("held out: iterations", self._scored, "held_out/score", [one.mean for one in shown.values()])
        failures = [100 * one.failures for one in shown.values()]
        add("held out: failures (%)", self._scored, "held_out/failures", failures, 100.0)
        if len(self._past) > 1:
            table.add_row("held out, evaluation by evaluation", _bars(self._past[-PAST:]))
        return table

    def _held_out(self, rows: Sequence[Row]) -> str:
        values = [row["held_out/score"] for row in rows if row.get("held_out/score") is not None]
        text = f"held out {_mean(rows, 'held_out/score'):.2f} iterations"
        if len(rows) > 1:
            text += f" ({min(values):.2f} to {max(values):.2f})"
        text += f", p90 {_mean(rows, 'held_out/p90'):.0f}, failures {100 * _mean(rows, 'held_out/failures'):.1f} %"
        rules = [f"{n} {one.mean:.2f}" for n, one in self._yardsticks().items()]
        if rules:
            text += f" ({', '.join(rules)})"
        if any(one.chunk == rows[0]["chunk"] for one in self.best):
            text += ", best so far"
        return text


def _mean(rows: Sequence[Row], name: str) -> float:
    return sum(row[name] for row in rows if row.get(name) is not None) / len(rows)


def _bars(values: Sequence[float]) -> str:
    low, high = min(values), max(values)
    last = len(BLOCKS) - 1
    return "".join(BLOCKS[round(last * (value - low) / (high - low)) if high > low else 0] for value in values)
