"""What a solve made of a survey: control and check points, and distances, as text and as CSV."""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from jaxba import residuals
from jaxba.io.files import StrPath, open_output
from jaxba.problem.bundle_problem import BundleProblem
from jaxba.problem.labels import part_name
from jaxba.problem.marks import Marks, found_at

NAME_WIDTH = 20  # characters of a name in the text

COLUMNS = (
    *("kind", "name", "x", "y", "z", "length", "dx", "dy", "dz", "dlength"),
    "images",
    "pixels",
    "sigmas",
)


class Row(NamedTuple):
    """A line of the report: scene units, and pixels."""

    kind: str  # control, check or distance
    name: str
    measured: tuple[float, ...]  # x, y and z, or the length
    difference: tuple[float, ...]  # found less measured
    sigmas: float  # RMS of the difference in standard deviations
    images: int | str = ""
    pixels: float | str = ""  # RMS


@dataclass(frozen=True)
class Report:
    """A survey's report, which prints as a table."""

    rows: tuple[Row, ...]
    """Control points, check points and distances."""

    notes: tuple[str, ...] = ()
    """What was measured and does not fit (`Solution.notes`)."""

    def __str__(self) -> str:
        """The table, and the notes below it."""
        return "\n".join([self.table(), *(f"note: {note}" for note in self.notes)])

    def table(self) -> str:
        """The rows in lines: differences in scene units, RMS pixels, and the RMS of standard
        deviations."""
        lines = []
        known = [row.difference for row in self.rows if row.kind == "check" and row.images]
        checks = [difference for difference in known if np.isfinite(difference).all()]
        for names, lengths in ((("x", "y", "z"), False), (("measured", "found", "less"), True)):
            if mine := [row for row in self.rows if (row.kind == "distance") == lengths]:
                heads = "".join(f"{one:>11}" for one in names) + "  images  pixels  sigmas"
                lines.append(f"{'found less measured':{NAME_WIDTH}}{'':9}{heads}")
            for row in mine:
                by = row.difference
                of = (*row.measured, row.measured[0] + by[0], *by) if lengths else by
                pixels = "" if lengths else format(row.pixels, ".2f")
                seen = f"{row.images:>8}{pixels:>8}{row.sigmas:8.2f}"
                numbers = "".join(f"{one:11.4f}" for one in of)
                lines.append(f"{row.name[:NAME_WIDTH]:{NAME_WIDTH}} {row.kind:8}{numbers}{seen}")
        if checks:
            east, north, up = np.sqrt(np.mean(np.square(checks), axis=0))
            lines.append(
                f"check points: RMS {np.hypot(east, north):.4f} horizontally, {up:.4f} vertically"
            )
        return "\n".join(lines)

    def write(self, path: StrPath) -> None:
        """Writes the report as CSV, each note as the name in a row of the kind `note`. Raises
        ProblemError: it cannot be written."""
        out = io.StringIO()
        table = csv.writer(out, lineterminator="\n")
        table.writerow(COLUMNS)
        for row in self.rows:
            columns = [
                (*x, "") if len(x) == 3 else ("", "", "", *x)
                for x in (row.measured, row.difference)
            ]
            table.writerow(
                (row.kind, row.name, *columns[0], *columns[1], row.images, row.pixels, row.sigmas)
            )
        for note in self.notes:
            table.writerow(("note", note, *[""] * (len(COLUMNS) - 2)))
        with open_output(path) as file:
            file.write(out.getvalue().encode())


def report(problem: BundleProblem, marks: Marks | None, notes: tuple[str, ...] = ()) -> Report:
    """The report of a solved problem and its marks, with the points and distances of the residuals
    that it has, and notes on what does not fit."""
    first = problem.num_points - (0 if marks is None else len(marks.names))

    def name(one):
        return part_name(problem.labels, "point", one).removeprefix("point ")

    groups = []
    lengths = list[Row]()
    if marks is not None:
        kinds = np.where(marks.check, "check", "control").tolist()
        groups.append(
            (kinds, marks.names, first + np.arange(len(kinds)), marks.places, marks.stddev)
        )
    for rows in problem.residuals.rows:
        data = dict(zip(rows.residual.data, map(np.asarray, rows.data), strict=True))
        at = [np.asarray(index) for index in rows.index]
        if (
            rows.residual.function is residuals.control_point.function
            and (own := at[0] < first).any()
        ):
            of = at[0][own]
            stddev = 1 / np.einsum("nii->ni", data["whitening"][own])
            groups.append(
                (
                    ["control"] * len(of),
                    [name(one) for one in of],
                    of,
                    data["position"][own],
                    stddev,
                )
            )
        if rows.residual.function is residuals.distance.function:
            ends = [np.asarray(problem.points)[one] for one in at]
            less = np.linalg.norm(ends[1] - ends[0], axis=1) - data["length"]
            for one, two, length, by, sigma in zip(
                *at, data["length"], less, data["sigma"], strict=True
            ):
                pair = f"{name(one)}-{name(two)}"
                lengths.append(
                    Row("distance", pair, (float(length),), (float(by),), float(abs(by) / sigma))
                )
    points = []
    for kinds, names, of, places, stddev in groups:
        found = found_at(problem, of, places, stddev)
        known = np.where(found.images > 0, 1, np.nan)  # else the measurement alone says where it is
        by = found.difference * known[:, None]
        sigmas = found.whitened * known
        columns = (places, by, sigmas, found.images, found.pixels)
        for kind, own, place, by, *more in zip(
            kinds, names, *(x.tolist() for x in columns), strict=True
        ):
            points.append(Row(kind, own, tuple(place), tuple(by), *more))
    return Report((*points, *lengths), notes)
