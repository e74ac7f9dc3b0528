"""Writes the results of a benchmark: a page that needs no other file."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from jaxba.bench import page, profile
from jaxba.bench.charts import AXES, problem_charts, profile_chart, solver_styles
from jaxba.bench.summary import Summary, summarize
from jaxba.bench.tables import compact, details, reach_tables
from jaxba.problem.bundle_problem import ProblemError
from jaxba.runtime.atomic import write_text
from jaxba.solver.record import Record

FILE = "report.html"  # what `write_report` writes


def write_report(
    records: Sequence[Record],
    out_dir: str | os.PathLike[str],
    tolerance: float = 1e-3,
    *,
    metadata: Mapping[str, Any] | None = None,
) -> Path:
    """Writes `report.html` into a folder, which it creates, over what is there; returns its path.

    `tolerance` is tau of the performance profile; `metadata`, by default from the records, is shown
    on top: device, threads, versions and the like, and as code what has the name `command`. Raises
    ProblemError: there are no records, or the tolerance is outside (0, 1). Raises OSError: a file
    cannot be written."""
    if not records:
        raise ProblemError("there are no results to report")
    if not 0 < tolerance < 1:
        raise ProblemError(f"the tolerance must lie between 0 and 1, not {tolerance:g}")
    folder = Path(out_dir)
    folder.mkdir(parents=True, exist_ok=True)
    write_text(folder / FILE, to_html(records, summarize(records, tolerance), tolerance, metadata))
    return folder / FILE


def run_metadata(records: Iterable[Record]) -> dict[str, str]:
    """Devices, libraries, floating point types, threads and repeats that occur in the records."""
    records = list(records)
    named = {
        "device": (r.device for r in records),
        "backend": (r.backend for r in records),
        "dtype": (r.dtype for r in records),
        "threads": (str(r.threads) for r in records),
    }
    metadata = {name: ", ".join(dict.fromkeys(values)) for name, values in named.items()}
    return metadata | {"repeats": str(max((r.repeat for r in records), default=-1) + 1)}


PROFILES = (
    "Fraction of all problems, including those that no solver solved, that a solver solves within "
    "a factor (x axis) of "
    "the iterations or time of the best solver on that problem, hidden or not. τ: cost at most f* "
    "+ τ(f0 - f*)."
)

RUNS = "The repeat of median time of each solver. Dashed: the tolerances."


def to_html(
    records: Sequence[Record],
    summary: Summary,
    tolerance: float = 1e-3,
    metadata: Mapping[str, Any] | None = None,
) -> str:
    """The report as one HTML document that loads nothing (`page`). The arguments are those of
    `write_report`."""
    styles = solver_styles(profile.solver_names(records))
    facts = {str(name): str(value) for name, value in (metadata or run_metadata(records)).items()}
    whole = page.Page("jaxba benchmark", facts, styles, AXES)
    names = profile.problem_names(records)
    if len(names) > 1:  # of one problem they say nothing
        profiles = [
            profile_chart(records, target, styles) for target in profile.cost_targets(tolerance)
        ]
        whole.add("Performance profiles", page.note(PROFILES), whole.charts(profiles))
    label = "{0.problem}: {0.cameras} cameras, {0.points} points, {0.observations} observations"
    labels = [label.format(one) for one in summary.problems]
    drawn = [whole.charts(problem_charts(records, name, tolerance, styles)) for name in names]
    whole.add(
        "Convergence and damping",
        page.note(RUNS),
        page.groups("problem", dict(zip(labels, drawn, strict=True))),
    )
    for table in (compact(summary), *reach_tables(summary), details(summary)):
        whole.add_table(table)
    return whole.to_html(summary.warnings)
