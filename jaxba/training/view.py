"""The lines of text that a training prints after each chunk."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from jaxba.training.log import Row

YARDSTICKS = ("ceres", "ceres+embedded", "constant action")
"""Baselines beside which held-out scores are printed."""


def lines(rows: Sequence[Row], chunks: int, rules: Mapping[str, Any], best: bool = False) -> list[str]:
    """A line on a finished chunk, and one on its held-out scores if it has any.

    Args:
        rows: of the chunk in the log, one of every agent.
        chunks: of the whole training.
        rules: a `Score` by name of the baseline.
        best: whether a policy of this chunk is the best so far.
    """
    row = rows[0]
    start, end = f"chunk {row['chunk']}/{chunks}: ", row["wall_s"] / row["chunk"] * chunks
    text = f"{row['steps_per_s']:.0f} steps/s, {row['updates_per_s']:.0f} updates/s"
    if ended := [one for one in rows if one["episodes"]]:
        length, rule = _mean(ended, "episode/length"), _mean(ended, "episode/ceres")
        text += f", {length:.1f} iterations (Ceres' rule {rule:.1f})"
    found = [f"{start}{text}, {row['wall_s']:.0f} s of {end:.0f}"]
    values = [one["held_out/score"] for one in rows if one.get("held_out/score") is not None]
    if values:
        text = f"held out {_mean(rows, 'held_out/score'):.2f} iterations"
        text += f" ({min(values):.2f} to {max(values):.2f})" if len(rows) > 1 else ""
        text += f", p90 {_mean(rows, 'held_out/p90'):.0f}, failures {100 * _mean(rows, 'held_out/failures'):.1f} %"
        shown = [f"{name} {rules[name].mean:.2f}" for name in YARDSTICKS if name in rules]
        text += f" ({', '.join(shown)})" if shown else ""
        found.append(f"{start}{text}{', best so far' if best else ''}")
    return found


def _mean(rows: Sequence[Row], name: str) -> float:
    values = [row[name] for row in rows if row.get(name) is not None]
    return sum(values) / len(values)
