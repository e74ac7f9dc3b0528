"""How accurate positions are, by columns of tables that are not all there."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxba.io.tables import is_value, value_of

ACCURACY = "accuracy acc sigma stddev stdev std sd s precision rms rmse uncertainty"
"""What accuracies are called, before or after what they are of."""

DIRECTIONS = {
    "sx": "x e east easting lon long longitude",
    "sy": "y n north northing lat latitude",
    "sxy": "xy h hor horz horiz horizontal lateral planimetric",
    "sz": "z v ver vert vertical u up height hgt alt altitude elevation elev",
    "s": "xyz d position",  # d: of 3d
}
"""What accuracies are of, by the kinds of columns."""

KINDS = tuple(DIRECTIONS)

OF_AXES = (("sx", "sxy", "s", "sy"), ("sy", "sxy", "s", "sx"), ("sz", "s"))
"""Kinds that say how accurate x, y and z are; the first one that is known counts."""

VERTICAL = 2.0
"""Standard deviation of heights over the horizontal one where it is not known: of RTK 15 mm against
8, of a phone 1.5 to 3 times (data sheets of receivers)."""

_MAYBE = re.compile(r"accura|sigma|std|uncertain|precision")
_ANGLES = re.compile(r"yaw|pitch|roll|omega|phi|kappa|heading|attitude|rotation|angle|deg")


class Accuracies(NamedTuple):
    """A column of accuracies."""

    kind: str  # one of `KINDS`
    title: str  # as the file has it
    unit: float  # metres; NaN: not said
    cells: list[str]


def kind_of_accuracy(name: str) -> str:
    """The kind of accuracies of a column, by the letters of its name; empty: it has none."""
    return _NAMES.get(name, "")


def may_be_accuracy(title: str, kind: str) -> bool:
    """Whether a column seems to have accuracies of places that cannot be used: of no kind, or in
    degrees."""
    text = title.lower()
    return "deg" in text if kind else bool(_MAYBE.search(text)) and not _ANGLES.search(text)


def covariances_of(
    columns: Sequence[Accuracies],
    unused: Sequence[str],
    names: Sequence[str],
    there: Bool[np.ndarray, " n"],
    file: str,
) -> tuple[Float[np.ndarray, "n 3 3"] | None, tuple[str, ...]]:
    """Covariances by what a table has of accuracies.

    Args:
        columns: what it has.
        unused: titles of other columns that seem to have accuracies.
        names: of images, the rows of the table.
        there: which have a place.
        file: what notes begin with.

    Returns:
        Covariances; None: not known. Notes on what they are where the table does not say it."""
    notes = []
    table = np.full((len(names), len(OF_AXES)), np.nan)
    useless = list(unused)
    usable: dict[str, Float[np.ndarray, " n"]] = {}
    for column in columns:
        deviations = np.array([_accuracy(cell) for cell in column.cells])
        usable[column.kind] = deviations * (1.0 if np.isnan(column.unit) else column.unit)
        if not np.isfinite(deviations).any():
            useless.append(column.title)
    for axis, kinds in enumerate(OF_AXES):
        for kind in kinds:
            table[:, axis] = np.where(
                np.isnan(table[:, axis]), usable.get(kind, np.nan), table[:, axis]
            )
    if useless:
        titles = f"column{'s' * (len(useless) > 1)} {', '.join(useless)}"
        notes.append(f"{file}: the accuracies in {titles} are not used")
    if not np.isfinite(table).any():
        return None, tuple(f"{note}: the standard deviation is 1" for note in notes)
    known = np.asarray(np.isfinite(table).any(axis=0))
    if not known[2]:
        table[:, 2] = VERTICAL * table[:, :2].max(axis=1)
        notes.append(
            f"{file}: no accuracy of heights: they get {VERTICAL:g} times the horizontal one"
        )
    elif not known[:2].any():
        table[:, :2] = table[:, 2:]
        notes.append(f"{file}: no horizontal accuracy: positions get that of heights")
    missing = np.isnan(table)
    table = np.where(missing, np.nanmax(table, axis=0), table)
    lost = np.flatnonzero(missing.any(axis=1) & there).tolist()
    if lost:
        notes.append(without_accuracy([names[at] for at in lost], file))
    return table[:, :, None] ** 2 * np.eye(3), tuple(notes)


def _accuracy(cell: str) -> float:
    """A positive number, or NaN."""
    number = value_of(cell, "accuracy", "") if is_value(cell) else np.nan
    return number if number > 0 else np.nan


def without_accuracy(names: Sequence[str], file: str) -> str:
    """The note on images whose accuracy is not known."""
    more = f" and {len(names) - 3} more" if len(names) > 3 else ""
    images = f"{len(names)} image{'s' * (len(names) > 1)}"
    return (
        f"{file}: no accuracy of {images}, which get the largest of the others: "
        f"{', '.join(names[:3])}{more}"
    )


def _names_of_columns() -> dict[str, str]:
    """The kind of accuracies by the letters of the name of their column."""
    known = {accuracy: "s" for accuracy in ACCURACY.split()}
    for kind, directions in DIRECTIONS.items():
        for accuracy in ACCURACY.split():
            for direction in directions.split():
                named = [
                    f"{accuracy}{direction}",
                    *([f"{direction}{accuracy}"] if accuracy != "s" else []),
                ]
                known |= {
                    before + name: kind for name in named for before in ("", "rtk", "gps", "gnss")
                }
    return known


_NAMES = _names_of_columns()
