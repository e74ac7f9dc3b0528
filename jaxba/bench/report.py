"""Writes the results of a benchmark: `summary.json`, figures and a self-contained `report.html`."""

from __future__ import annotations

import base64
import html
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jaxba.bench import plots, profile
from jaxba.bench.profile import RELATIVE_TOLERANCES, Target
from jaxba.bench.records import Record
from jaxba.bench.summary import Summary, summarize, write_summary
from jaxba.bench.tables import Table, tables
from jaxba.problem.bundle_problem import ProblemError
from jaxba.runtime.atomic import write_text

_CSS = """
body { font: 15px/1.45 system-ui, sans-serif; color: #1a1a1a; margin: 2rem auto; max-width: 76rem; padding: 0 1rem; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-size: 13px; font-variant-numeric: tabular-nums; }
th, td { padding: .2rem .6rem; text-align: right; border-bottom: 1px solid #ddd; white-space: nowrap; }
th.name, td.name { text-align: left; }
thead th { border-bottom: 2px solid #888; }
tbody tr:nth-child(even) { background: #f6f6f6; }
.note { color: #555; font-size: 13px; max-width: 60rem; }
.warning { background: #fff4d6; border-left: 4px solid #d08700; padding: .4rem .8rem; margin: .4rem 0; }
figure { margin: 1rem 0; } img { max-width: 100%; height: auto; }
"""


@dataclass(frozen=True)
class ReportFigure:
    """A figure of the report."""

    title: str
    caption: str
    svg: bytes


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
        metadata: device, threads, versions and the like, shown as a table; from the records by default.
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
    figures = []
    for stem, title, caption, figure in _figures(records, tolerance, known_best):
        paths = plots.save_figure(figure, folder / stem)
        files += paths
        figures.append(ReportFigure(title, caption, paths[1].read_bytes()))
    report = folder / "report.html"
    write_text(report, to_html(summary, figures))
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
    """Yields (file stem, title, caption, figure). A generator, so that only one figure is in memory."""
    caption = (
        "Fraction of all problems, including those that no solver solved, that a solver solves within a factor (x "
        "axis) of the time or iterations of the best solver on that problem."
    )
    single, relative = [Target("tau", tolerance)], [Target("relative", epsilon) for epsilon in RELATIVE_TOLERANCES]
    figure = plots.plot_profiles(records, single, known_best)
    yield f"profile_tau_{tolerance:g}", f"Performance profile, τ = {tolerance:g}", caption, figure
    figure = plots.plot_profiles(records, relative, known_best)
    yield "profile_relative", "Performance profiles, relative tolerances", caption, figure
    for problem, name in file_names(profile.problem_names(records)).items():
        text = "Accepted cost over solve time and iterations; dashed: tolerances. Below: distance to the best cost."
        figure = plots.plot_convergence(records, problem, tolerance, known_best)
        yield f"convergence_{name}", f"Convergence: {problem}", text, figure
        text = "Lambda of every iteration, hollow where the step was rejected. Right: the last iterations, enlarged."
        yield f"lambda_{name}", f"Damping: {problem}", text, plots.plot_lambda(records, problem)


def to_html(summary: Summary, figures: Sequence[ReportFigure] = ()) -> str:
    """The report as one HTML document without external resources. All names are escaped."""
    profiles, others = figures[:2], figures[2:]
    parts = [f'<p class="warning">{html.escape(warning)}</p>' for warning in summary.warnings]
    parts.append(_table(_metadata_table(summary)))
    parts.append(_table(_problem_table(summary)))
    *main, details = tables(summary)
    parts += [_table(table) for table in main]
    parts += [_figure(figure) for figure in profiles]
    parts.append(_table(details))
    parts += [_figure(figure) for figure in others]
    body = "\n".join(parts)
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>jaxba benchmark</title><style>{_CSS}</style></head>\n<body>"
        f"<h1>jaxba benchmark</h1>\n{body}\n</body></html>\n"
    )


def _metadata_table(summary: Summary) -> Table:
    rows = [(str(name), str(value)) for name, value in summary.metadata.items()]
    return Table("Run", ("property", "value"), rows, "", text_columns=2)


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


def _table(table: Table) -> str:
    def row(cells: Iterable[str], tag: str) -> str:
        kinds = [' class="name"' if i < table.text_columns else "" for i in range(len(table.header))]
        return (
            "<tr>" + "".join(f"<{tag}{k}>{html.escape(c)}</{tag}>" for k, c in zip(kinds, cells, strict=True)) + "</tr>"
        )

    head, body = row(table.header, "th"), "\n".join(row(cells, "td") for cells in table.rows)
    note = f'<p class="note">{html.escape(table.note)}</p>' if table.note else ""
    grid = f'<div class="scroll"><table><thead>{head}</thead><tbody>\n{body}\n</tbody></table></div>'
    return f"<h2>{html.escape(table.title)}</h2>\n{grid}\n{note}"


def _figure(figure: ReportFigure) -> str:
    data = base64.b64encode(figure.svg).decode()
    title = html.escape(figure.title)
    image = f'<img alt="{title}" src="data:image/svg+xml;base64,{data}">'
    return (
        f'<figure><h2>{title}</h2>{image}<figcaption class="note">{html.escape(figure.caption)}</figcaption></figure>'
    )
