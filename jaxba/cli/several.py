"""`jaxba-solve` with several problems: by `jaxba.solve_many`, with a file of costs from which a run
goes on."""

from __future__ import annotations

import contextlib
import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from jaxba.cli import common
from jaxba.cli.costs import (
    COSTS,
    Row,
    append_row,
    files_digest,
    is_there,
    options_digest,
    solved_rows,
    write_rows,
)
from jaxba.cli.output import store
from jaxba.cli.overwriting import check_apart, problem_files
from jaxba.damping import DampingPolicy
from jaxba.datasets.bal.paths import resolve
from jaxba.io import formats, is_colmap
from jaxba.io.files import display_name
from jaxba.problem.bundle_problem import BundleProblem, ProblemError
from jaxba.runtime.interrupt import INTERRUPTED, Interrupt
from jaxba.solver.many import Result, solve_many
from jaxba.solver.options import SolveOptions
from jaxba.solver.solve import Solution

FOR_ONE = (
    *(
        "log",
        "survey",
        "covariance",
        "record",
        "checkpoint",
        "view",
        "retriangulate",
        "reject",
        "processes",
        "distributed",
    ),
    *("devices", "recipes"),
)
"""Options of a single problem."""

# seconds between lines of progress on a terminal, where each replaces the last, and elsewhere
PROGRESS_S = 0.2, 10.0


def inputs(problems: Sequence[str]) -> list[str]:
    """The paths of several problems; of a folder that is none itself what it holds. Empty for a
    single problem. Raises UsageError: one is standard input. Raises ProblemError: as `resolve`."""
    common.require(len(problems) < 2 or "-" not in problems, "- is for one problem")
    found = list[str]()
    folders = 0
    for path in map(resolve, problems):
        if Path(path).is_dir() and not formats.holds_problem(path):
            inside = sorted(Path(path).iterdir())
            folders = folders + 1
            found += [str(one) for one in inside if one.is_file() or formats.holds_problem(one)]
        else:
            found.append(path)
    return found if folders or len(problems) > 1 else []


def solve_all(
    args: Any,
    paths: Sequence[str],
    read: Callable[[str], BundleProblem],
    policy: DampingPolicy,
    options: SolveOptions,
) -> int:
    """Solves problems, `read` from their paths, and writes solutions under their names. One that
    fails is one line, and the others go on. Exit status: 0, 2 if any has failed, 3 with `--strict`
    if what was measured does not fit some of them, 130 after Ctrl-C. Raises UsageError: the folder
    or the options."""
    given = [f"--{name.replace('_', '-')}" for name in FOR_ONE if getattr(args, name)]
    common.require(not given, f"{', '.join(given)}: for one problem, not for {len(paths)}")
    common.require(
        bool(args.output) or not args.resume, "--resume goes on with the folder of --output"
    )
    names = _names(paths)
    folder = Path(args.output) if args.output else None
    made_by = options_digest(args, policy, options)
    done = _begin(folder, paths, names, made_by, resume=args.resume) if folder else {}
    left = [(path, name) for path, name in zip(paths, names, strict=True) if name not in done]
    common.prepare_process()
    began = time.monotonic()
    shown = -1e9
    rows = list[Row]()
    every, end = (PROGRESS_S[0], "") if sys.stderr.isatty() else (PROGRESS_S[1], "\n")
    problems = _Problems([path for path, _ in left], read)
    found = contextlib.closing(solve_many(problems, policy, options))
    with common.notes_printed(), Interrupt("problem", graceful=True) as interrupt, found as results:
        for (path, name), result in zip(left, results, strict=False):
            if folder and isinstance(result, Solution):
                result = _stored(folder / name, result, path)
            rows.append(Row.of(name, result, options=made_by, files=problems.digests.pop(path)))
            if folder:
                append_row(folder / COSTS, rows[-1])
            now = time.monotonic()
            if not isinstance(result, Solution):
                text = rows[-1].error
                known = display_name(path)
                common.print_error(text if text.startswith(known) else f"{known}: {text}")
            elif rows[-1].notes:
                common.print_line(f"note: {display_name(path)}: {rows[-1].notes}")
            elif now - shown > every:
                rate = len(rows) / (now - began)
                shown = now
                text = f"{len(rows)} of {len(left)}, {rate:.1f} a second"
                print(text if end else f"\r{text} ", end=end, file=sys.stderr, flush=True)
            if interrupt.requested:
                break
    print(end="" if end else "\n", file=sys.stderr)
    solved = [row for row in rows if not row.error]
    failed = len(rows) - len(solved)

    def total(name):
        return sum(float(getattr(row, name)) for row in solved)

    common.print_line(
        f"{common.counted(len(solved), 'problem')} solved, {failed} failed, in "
        f"{time.monotonic() - began:.1f} s\n"
        f"cost {total('initial_cost'):.6g} -> {total('final_cost'):.6g} in all, "
        f"{total('iterations') / max(1, len(solved)):.1f} iterations each"
    )
    if folder:
        common.print_line(f"wrote {folder / COSTS} and the solutions beside it")
    if interrupt.requested and len(rows) < len(left):
        common.print_line(f"{len(left) - len(rows)} are left: --resume goes on")
        return INTERRUPTED
    return (
        common.BAD_INPUT
        if failed
        else common.misfit_status(
            args.strict, sum(bool(row.notes) for row in (*done.values(), *rows))
        )
    )


class _Problems:
    """Problems that are read when their turn comes; what cannot be read is the error itself."""

    def __init__(self, paths: Sequence[str], read: Callable[[str], BundleProblem]) -> None:
        self._paths = paths
        self._read = read
        self.digests = dict[str, str]()
        """Of the files of each problem, from before it was read."""

    def __len__(self) -> int:
        return len(self._paths)

    def __iter__(self) -> Iterator[Any]:
        for path in self._paths:
            self.digests[path] = ""
            try:
                self.digests[path] = files_digest(path)
                problem = self._read(path)
            except (ProblemError, OSError) as error:
                yield error
            else:
                yield problem


def _names(paths: Sequence[str]) -> list[str]:
    """Names of solutions: paths below the folder that all have in common, with .txt if their format
    is only read."""
    absolute = [os.path.abspath(path) for path in paths]
    common_folder = os.path.commonpath([os.path.dirname(path) for path in absolute])
    names = [_written(os.path.relpath(path, common_folder), path) for path in absolute]
    twice = (
        {name for name in names if names.count(name) > 1} if len(set(names)) < len(names) else ()
    )
    common.require(not twice, f"{next(iter(twice), '')}: named twice")
    return names


def _written(name: str, source: str) -> str:
    """A name, as a BAL file if the format of its ending is only read."""
    known = formats.by_ending(name)
    lost = formats.ending(name) in formats.OTHER_ENDINGS if known is None else known.write is None
    return f"{name}.txt" if lost and not is_colmap(source) else name


def _begin(
    folder: Path, paths: Sequence[str], names: Sequence[str], made_by: str, *, resume: bool
) -> dict[str, Row]:
    """Makes the folder and its file of costs, and says what is done already.

    Args:
        folder: of the solutions.
        paths: of all problems.
        names: of their solutions.
        made_by: digest of the options.
        resume: whether a run may go on.

    Returns:
        Rows of solutions that are there, made by the same options from the same files, by their
        names.

    Raises:
        UsageError: a solution would replace a file of a problem, or the folder holds what it may
            not; one line."""
    common.check_folder("--output", str(folder))
    written = {str(path): [folder / name] for path, name in zip(paths, names, strict=True)}
    check_apart(written, {"a problem": [file for path in paths for file in problem_files(path)]})
    folder.mkdir(exist_ok=True)
    costs = folder / COSTS
    where = f"--output {folder}: holds {COSTS} of"
    common.require(
        resume or not costs.exists(), f"{where} an earlier run; --resume goes on with it"
    )
    rows = solved_rows(costs)
    same = all(row.options == made_by for row in rows.values())
    common.require(
        same, f"{where} other options, constraints or policy: repeat those, or name another folder"
    )
    path_of = dict(zip(names, paths, strict=True))
    there = {name for name in rows if name in path_of and is_there(folder / name)}
    done = {name for name in there if rows[name].files == files_digest(path_of[name])}
    anew = [name for name in rows if name in path_of and name not in done]
    write_rows(costs, [row for name, row in rows.items() if name not in anew])
    if rows:
        common.print_line(f"{len(done)} of {len(paths)} are there already")
    if anew:
        changed = len(there - done)
        lost = len(anew) - len(there - done)
        common.print_line(
            f"solved anew: {changed} whose files have changed, {lost} whose solutions are not there"
        )
    return {name: rows[name] for name in done}


def _stored(output: Path, solution: Solution, source: str) -> Result:
    """The solution after it was written, or why it could not be."""
    try:
        output.parent.mkdir(parents=True, exist_ok=True)
        store(str(output), solution, source)
        return solution
    except (OSError, ProblemError) as error:
        return error
