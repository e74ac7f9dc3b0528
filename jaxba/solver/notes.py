"""Notes on what was measured and does not fit what was found: `Solution.notes`."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxba.model.registration import residuals_of_rows
from jaxba.problem import geometry
from jaxba.problem.bundle_problem import BundleProblem
from jaxba.problem.labels import Part, part_name
from jaxba.problem.marks import of_marks
from jaxba.problem.residuals import LENS, POINT, POSE, SECOND, Rows
from jaxba.solver.fit import LEVEL, fits

NAMED = 3  # rows that a note names of more

MARKS = "pixels of control points"
"""Name of the kind of pixels that were clicked."""

PARTS: dict[str, Part] = {POSE: "image", LENS: "lens", POINT: "point"}
"""What the unknowns of residuals belong to."""

LENGTHS = ("position_prior", "position", "control_point", "distance", "baseline", "point_to_plane")
"""Residuals whose numbers are lengths once they are multiplied by standard deviations."""


class Kind(NamedTuple):
    """What was measured of one kind, as a solve has it."""

    name: str
    residual: Float[np.ndarray, "rows size"]  # whitened
    row_name: Callable[[int], str]
    off: Callable[[int, np.ndarray], str]  # how far a whitened residual of a row is in its own units; may be empty


def notes_of(problem: BundleProblem, counted: Bool[np.ndarray, " observations"]) -> tuple[str, ...]:
    """A note for each kind of residuals that does not fit its standard deviations; pixels count if these are stated.

    Args:
        problem: a solved one.
        counted: observations that count in the cost."""
    kinds = _kinds(problem, counted)
    return tuple(_note(kind) for kind in kinds if not fits(kind.residual, LEVEL / len(kinds)))


def _kinds(problem: BundleProblem, counted: Bool[np.ndarray, " observations"]) -> list[Kind]:
    """Everything that was measured to standard deviations."""
    found = []
    for rows, residual in zip(problem.residuals.rows, residuals_of_rows(problem), strict=True):
        of_rows = functools.partial(_row_name, problem, rows), functools.partial(_off, rows)
        found.append(Kind(rows.residual.name, residual, *of_rows))
    clicked = np.flatnonzero(of_marks(problem) & counted)
    if len(clicked):
        marks = problem.subset(clicked)
        of_pixels = functools.partial(_pixel_name, marks), functools.partial(_pixels_off, marks)
        found.append(Kind(MARKS, geometry.residuals(marks), *of_pixels))
    return found


def _note(kind: Kind) -> str:
    """That a kind does not fit, with its largest rows."""
    sizes = np.sqrt(np.sum(kind.residual**2, axis=1))
    factor = np.sqrt(np.mean(kind.residual**2))
    named = []
    for row in np.argsort(-sizes, kind="stable")[:NAMED].tolist():
        named.append(f"{kind.row_name(row)} by {sizes[row]:.3g}{kind.off(row, kind.residual[row])}")
    rest = f" and {len(sizes) - NAMED} more" if len(sizes) > NAMED else ""
    return (
        f"{kind.name}: does not fit its standard deviations, which would have to be {factor:.3g} times as large: "
        f"off by as many of them are {', '.join(named)}{rest}"
    )


def _row_name(problem: BundleProblem, rows: Rows, row: int) -> str:
    """What a note calls a row: by its images and points, and by its number where these may have several."""
    pairs = zip(rows.residual.unknowns, rows.index, strict=True)
    parts = [(name.removesuffix(SECOND), index[row]) for name, index in pairs]
    names = dict.fromkeys(part_name(problem.labels, PARTS[name], at) for name, at in parts if name in PARTS)
    owned = " and ".join(names)
    if rows.residual.function.__module__.startswith("jaxba.") and owned:
        return owned
    return f"row {row} ({owned})" if owned else f"row {row}"


def _off(rows: Rows, row: int, whitened: Float[np.ndarray, " size"]) -> str:
    data = dict(zip(rows.residual.data, rows.data, strict=True))
    if rows.residual.name not in LENGTHS:
        return ""
    if "whitening" in data:
        off = np.linalg.solve(np.asarray(data["whitening"])[row], whitened)
    elif "sigma" in data:
        off = whitened * np.asarray(data["sigma"])[row]
    else:
        return ""
    if len(off) == 1:
        return f" ({off[0]:.3g})"
    axes = ", ".join(f"{axis} {number:.3g}" for axis, number in zip("xyz", off, strict=False))
    return f" ({np.linalg.norm(off):.3g}: {axes})"


def _pixel_name(marks: BundleProblem, row: int) -> str:
    point = part_name(marks.labels, "point", marks.point_index[row])
    return f"{point} in {part_name(marks.labels, 'image', marks.camera_index[row])}"


def _pixels_off(marks: BundleProblem, row: int, whitened: Float[np.ndarray, "2"]) -> str:
    return f" ({np.linalg.norm(marks.observations[row] - geometry.project(marks)[row]):.3g} px)"
