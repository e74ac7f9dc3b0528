"""What the figures have in common: their problems, and files."""

from __future__ import annotations

import re
from pathlib import Path

from matplotlib.figure import Figure

from jaxba.bench.sources import Source, sources
from jaxba.paper import places
from jaxba.paper.workshop import Workshop
from jaxba.runtime.atomic import atomic_write

FIGURES = "figures"
"""Folder of the pictures inside the run's."""

RESOLUTIONS = (100, 80, 60)
"""Dots per inch; the first that keeps a picture below `LARGEST`."""

LARGEST = 200_000
"""Bytes of a picture."""


def main_problem(shop: Workshop) -> Source:
    """The largest Ladybug at hand; where there is none, a random scene of that kind."""
    found = [s for family in places.families(shop.config.real) if family.family == "Ladybug" for s in family.whole]
    return max(found, key=_cameras) if found else sources([shop.config.figures.scene])[0]


def _cameras(source: Source) -> int:
    digits = re.findall(r"\d+", source.name)
    return int(digits[0]) if digits else 0


def picture(shop: Workshop, figure: Figure, name: str, caption: str) -> str:
    """Draws a figure into the run's folder and returns the Markdown that shows it."""
    folder = shop.folder / FIGURES
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
