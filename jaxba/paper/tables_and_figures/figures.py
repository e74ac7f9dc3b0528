"""Code shared by the figures: their problems and files."""

from __future__ import annotations

import re
from pathlib import Path

from matplotlib.figure import Figure

from jaxba.bench.sources import Source, sources
from jaxba.paper import real_problems
from jaxba.paper.runner import Runner
from jaxba.runtime.atomic import atomic_write

FIGURES = "figures"
"""Folder of the figures inside the folder of the run."""

RESOLUTIONS = (100, 80, 60)
"""Resolutions in dots per inch; the first that keeps the file below `LARGEST` is used, else the last."""

LARGEST = 200_000
"""Limit of the size of a figure, bytes."""


def main_problem(runner: Runner) -> Source:
    """The largest Ladybug problem on this machine; a random scene if there is none."""
    found = [
        s for family in real_problems.families(runner.config.real) if family.family == "Ladybug" for s in family.whole
    ]
    return max(found, key=_cameras) if found else sources([runner.config.figures.scene])[0]


def _cameras(source: Source) -> int:
    digits = re.findall(r"\d+", source.name)
    return int(digits[0]) if digits else 0


def picture(runner: Runner, figure: Figure, name: str, caption: str) -> str:
    """Writes a figure into the folder of the run and returns the Markdown that shows it."""
    folder = runner.folder / FIGURES
    folder.mkdir(parents=True, exist_ok=True)
    path: Path = folder / f"{name}.png"
    with atomic_write(path) as file:
        for dpi in RESOLUTIONS:
            file.seek(0)
            file.truncate()
            figure.savefig(file, dpi=dpi, format="png")
            if file.tell() < LARGEST:
                break
    return f"![{caption}]({FIGURES}/{name}.png)\n\n*{caption}*"
