"""Writes the results of a benchmark: `summary.json`, figures, and `report.html`, one page that needs no other file."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from jaxba.bench import page, plots, profile
from jaxba.bench.panels import AXES, problem_panels, profile_panel, solver_styles
from jaxba.bench.profile import RELATIVE_TOLERANCES, Target
from jaxba.bench.summary import Summary, summarize, write_summary
from jaxba.bench.tables import Table, tables
from jaxba.problem.bundle_problem import ProblemError
from jaxba.runtime.atomic import write_text
from jaxba.solver.record import Record


def write_all(
    records: Sequence[Record],
    out_dir: str | os.PathLike[str],
    tolerance: float = 1e-3,
    *,
    metadata: Mapping[str, Any] | None = None,
    known_best: Mapping[str, float] | None = None,
) -> list[Path]:
    """Writes all result files of a benchmark into a folder and returns their paths.

    These are `summary.json`, `profile_tau_<tau>`, `profile_relative`, `convergence_<problem>`, `lambda_<problem>` (each
    as .png and .svg) and `report.html`. Existing files of these names are replaced.

    Args:
        records: at least one.
        out_dir: folder; created if it does not exist.
        tolerance: tau of the performance profile, in (0, 1).
        metadata: device, threads, versions and the like, shown on top; from the records by default. That of the name
            `command` is shown as code.
        known_best: best known costs of some problems, see `profile.best_cost`.

    Raises:
        ProblemError: there are no records, or the tolerance is outside (0, 1).
        OSError: a file cannot be written.
    """
    if not records:
        raise ProblemError("there are no results to report")
    if not 0 < tolerance < 1:
        raise ProblemError(f"the tolerance must lie between 0 and 1, not {tolerance:g}")
    folder = Path(out_dir)
    folder.mkdir(parents=True, exist_ok=True)
    summary = summarize(records, tolerance, known_best, metadata or run_metadata(records))
    files = [folder / "summary.json"]
    write_summary(files[0], summary)
    for stem, figure in _figures(records, tolerance, known_best):
        files += plots.save_figure(figure, folder / stem)
    report = folder / "report.html"
    write_text(report, to_html(records, summary, tolerance, known_best))
    return [*files, report]


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


def file_names(problems: Iterable[str]) -> dict[str, str]:
    """A unique part of a file name for each problem, of letters, digits, `.`, `_` and `-` only."""
    names: dict[str, str] = {}
    for problem in problems:
        plain = re.sub(r"[^A-Za-z0-9._-]+", "_", problem).strip("._")[:100] or "problem"
        taken, name, count = {n.lower() for n in names.values()}, plain, 1
        while name.lower() in taken:  # some file systems ignore case
            count += 1
            name = f"{plain}-{count}"
        names[problem] = name
    return names


def _figures(records: Sequence[Record], tolerance: float, known_best: Mapping[str, float] | None):
    """Yields (file stem, figure). A generator, so that only one figure is in memory."""
    single, relative = [Target("tau", tolerance)], [Target("relative", epsilon) for epsilon in RELATIVE_TOLERANCES]
    yield f"profile_tau_{tolerance:g}", plots.plot_profiles(records, single, known_best)
    yield "profile_relative", plots.plot_profiles(records, relative, known_best)
    for problem, name in file_names(profile.problem_names(records)).items():
        yield f"convergence_{name}", plots.plot_convergence(records, problem, tolerance, known_best)
        yield f"lambda_{name}", plots.plot_lambda(records, problem)


PROFILES = (
    "Fraction of all problems, including those that no solver solved, that a solver solves within a factor (x axis) of "
    "the iterations or time of the best solver on that problem, hidden or not. τ: cost at most f* + τ(f0 - f*)."
)

RUNS = "The repeat of median time of each solver. Dashed: the tolerances."


def to_html(
    records: Sequence[Record],
    summary: Summary,
    tolerance: float = 1e-3,
    known_best: Mapping[str, float] | None = None,
) -> str:
    """The report as one HTML document that loads nothing (`page`). The arguments are those of `write_all`."""
    styles = solver_styles(profile.solver_names(records))
    every = [profile_panel(records, target, known_best) for target in profile.cost_targets(tolerance)]
    profiles, by_problem = page.charts(enumerate(every)), {}
    for problem in profile.problem_names(records):
        found = problem_panels(records, problem, tolerance, known_best)
        by_problem[problem] = page.charts(enumerate(found, start=len(every)))
        every += found
    *main, details = tables(summary)
    sections = [
        page.section("Performance profiles", page.note(PROFILES), profiles),
        page.section("Convergence and damping", page.note(RUNS), page.groups("problem", by_problem)),
        *(page.table(table, styles) for table in main),
        page.table(details, styles),
        page.table(_problem_table(summary)),
    ]
    facts = {str(name): str(value) for name, value in summary.metadata.items()}
    content = page.Page("jaxba benchmark", facts, sections, every, styles, AXES, summary.warnings)
    return page.to_html(content)


def _problem_table(summary: Summary) -> Table:
    header = ("problem", "family", "cameras", "points", "observations", "initial cost", "best cost f*", "reached by")
    rows = []
    for p in summary.problems:
        sizes = (str(p.cameras), str(p.points), str(p.observations))
        rows.append((p.problem, p.family, *sizes, f"{p.initial_cost:.7g}", f"{p.best_cost:.7g}", p.best_solver))
    return Table(
        "Problems and their sizes",
        header,
        rows,
        "Costs are half the sum of squared residuals, pixels².",
        text_columns=2,
    )
