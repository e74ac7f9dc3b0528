"""The file of costs of several problems: a row for each, from which a later run knows what is done.

Digests in a row say by which options and from which files a solution was made: what was made
otherwise is not done. Files count by their contents, those in a folder of photos or depth maps by
names, sizes and times."""

from __future__ import annotations

import csv
import hashlib
import io
import os
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from jaxba.cli.overwriting import policy_file, problem_files
from jaxba.constraints.surveys import SOURCES
from jaxba.damping import DampingPolicy
from jaxba.io import formats
from jaxba.io.files import StrPath
from jaxba.runtime.atomic import atomic_write
from jaxba.settings.configurations import SettingsError, read_file
from jaxba.solver.checkpoint import settings_text
from jaxba.solver.many import Result
from jaxba.solver.options import SolveOptions
from jaxba.solver.solve import Solution

COSTS = "costs.csv"  # name of the file of costs in the folder of solutions
DIGEST_BYTES = 8  # of a digest: two of a million files are the same with a chance of 3e-8
OF_PROBLEM = ("constant", "gauge", "refine_principal_point", "strict")
"""Options of the command that are part of a problem."""


NAMED = (*SOURCES, "folder")
"""Keys in a file of constraints that name a file or a folder beside it."""


class Row(NamedTuple):
    """A row of the file of costs."""

    problem: str
    cameras: int | str = ""
    points: int | str = ""
    observations: int | str = ""
    initial_cost: float | str = ""  # pixels^2
    final_cost: float | str = ""
    iterations: int | str = ""
    end: str = ""  # why it ended
    notes: str = ""  # what was measured and does not fit
    options: str = ""  # digest of options and constraints
    files: str = ""  # digest of the files that it was read from
    error: str = ""  # why there is no solution

    @classmethod
    def of(cls, name: str, result: Result, **digests: str) -> Row:
        """That of a result; `digests` are `options` and `files`."""
        if not isinstance(result, Solution):
            return cls(name, error=" ".join(str(result).split()), **digests)
        problem = result.problem
        sizes = problem.num_cameras, problem.num_points, problem.num_observations
        costs = result.initial_cost, result.final_cost, result.iterations
        return cls(
            name, *sizes, *costs, result.termination.reason, "; ".join(result.notes), **digests
        )


def solved_rows(costs: Path) -> dict[str, Row]:
    """The rows of solutions in a file, by their problems; none if there is no file. A last line
    that was cut is dropped. In a file of an older version digests are empty."""
    if not costs.exists():
        return {}
    content = costs.read_bytes()
    whole = io.StringIO(os.fsdecode(content[: content.rfind(b"\n") + 1]), newline="")
    names, *lines = [line for line in csv.reader(whole) if line] or [[]]
    rows = [dict(zip(names, line, strict=True)) for line in lines if len(line) == len(names)]
    known = [{name: row[name] for name in Row._fields if name in row} for row in rows]
    return {
        row["problem"]: Row(**row) for row in known if row.get("problem") and not row.get("error")
    }


def write_rows(costs: Path, rows: Iterable[Row]) -> None:
    """Writes the file anew."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([Row._fields, *rows])
    with atomic_write(costs) as file:
        file.write(os.fsencode(text.getvalue()))  # names of files may be no text


def append_row(costs: Path, row: Row) -> None:
    """Adds a row to the file."""
    with costs.open("a", newline="", encoding="utf-8", errors="surrogateescape") as file:
        csv.writer(file, lineterminator="\n").writerow(row)


def is_there(solution: Path) -> bool:
    """Whether a solution is in its place: a file, or a folder with a model."""
    return solution.is_file() or formats.holds_problem(solution)


def files_digest(path: str) -> str:
    """A digest of the files that a problem is read from."""
    return _digest("", problem_files(path))


def options_digest(args: Any, policy: DampingPolicy, options: SolveOptions) -> str:
    """A digest of what determines solutions besides the files of the problems, to rounding.

    Args:
        args: those of the command.
        policy: as for `solve`.
        options: as for `solve`."""
    options = replace(options, compilation="auto", pad=None, devices=None)
    named = _named(args.constraints)
    inside = [file for path in named if path.is_dir() for file in sorted(path.iterdir())]
    listed = [(file.name, file.stat().st_size, file.stat().st_mtime_ns) for file in inside]
    text = settings_text(policy, options, listed, *(getattr(args, name) for name in OF_PROBLEM))
    return _digest(text, [policy_file(args.policy), args.constraints, *named])


def _named(constraints: str | None) -> list[Path]:
    """The files and folders that a file of constraints names."""
    if constraints is None:
        return []
    try:
        content = read_file(Path(constraints), constraints)
    except SettingsError:  # which whoever reads a problem will say
        return []
    parts = [part for part in content.values() if isinstance(part, dict)]
    names = [part[key] for part in parts for key in NAMED if isinstance(part.get(key), str)]
    return [Path(constraints).parent / name for name in names]


def _digest(text: str, files: Iterable[StrPath | None]) -> str:
    """A digest of a text and of the contents of those files that are there."""
    digest = hashlib.blake2b(text.encode(errors="surrogateescape"), digest_size=DIGEST_BYTES)
    for path in files:
        if path and os.path.isfile(path):
            content = hashlib.blake2b(Path(path).read_bytes()).digest()
            digest.update(os.fsencode(os.path.basename(path)) + b"\0" + content)
    return digest.hexdigest()
