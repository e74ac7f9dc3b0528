"""Typed metrics, a baseline of ratios, and the gate that compares the two."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal


@dataclass(frozen=True)
class Metric:
    """A measured number."""

    key: str
    """Name, which should not change."""

    value: float
    """Median over repeats."""

    unit: str
    """`s`, `ratio`, `1/s`, `bytes` ..."""

    direction: Literal["lower", "higher"]
    """Whether lower or higher values are better."""

    tolerance: float = 0.0
    """Relative change for the worse that the gate accepts."""

    target: float | None = None
    """Value that the project aims at."""

    @property
    def gated(self) -> bool:
        """Whether it is compared with the baseline. Only ratios are, since seconds depend on the
        machine."""
        return self.unit == "ratio"

    @property
    def met(self) -> bool | None:
        """Whether the target is met; None without one."""
        if self.target is None:
            return None
        return self.value <= self.target if self.direction == "lower" else self.value >= self.target


def regressions(metrics: Iterable[Metric], baseline: dict[str, float]) -> list[str]:
    """A line of text for each ratio that is worse than the baseline by more than its tolerance."""
    found = []
    for metric in metrics:
        before = baseline.get(metric.key)
        if before is None or not metric.gated:
            continue
        worse = metric.value / before if metric.direction == "lower" else before / metric.value
        if worse > 1 + metric.tolerance:
            found.append(
                f"{metric.key}: {metric.value:.3g}, baseline {before:.3g} ({worse - 1:+.0%})"
            )
    return found


def read_baseline(path: Path) -> dict[str, float]:
    """The ratios of the baseline by key; empty if there is no file."""
    return json.loads(path.read_text()) if path.exists() else {}


def write_baseline(path: Path, metrics: Iterable[Metric]) -> None:
    """Replaces the ratios in the baseline by those of this run, and keeps those that were not
    measured."""
    ratios = {m.key: round(m.value, 4) for m in metrics if m.gated}
    path.write_text(
        json.dumps(dict(sorted({**read_baseline(path), **ratios}.items())), indent=1) + "\n"
    )


def to_json(metrics: Iterable[Metric], machine: dict[str, str]) -> str:
    """The metrics and a description of the machine as a JSON document."""
    return (
        json.dumps({"machine": machine, "metrics": [asdict(m) for m in metrics]}, indent=1) + "\n"
    )


def to_text(metrics: Iterable[Metric]) -> str:
    """The metrics as a table of text."""
    lines = [f"{'metric':58s} {'value':>10s} {'unit':8s} {'target':>8s}"]
    for m in metrics:
        target = "" if m.target is None else f"{m.target:.3g}"
        mark = {None: "", True: " met", False: " MISSED"}[m.met]
        lines.append(f"{m.key:58s} {m.value:10.4g} {m.unit:8s} {target:>8s}{mark}")
    return "\n".join(lines)
