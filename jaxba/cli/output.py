"""Output files of `jaxba-solve`: checks before the solve, and writing."""

from __future__ import annotations

import os
from collections.abc import Mapping

import numpy as np

from jaxba.cli import common, table
from jaxba.cli.overwriting import PROBLEM, check_apart, problem_files
from jaxba.io import (
    check_model,
    check_output,
    formats,
    is_colmap,
    is_folder,
    write_colmap,
    write_problem,
    write_transforms,
)
from jaxba.io.files import StrPath
from jaxba.problem.bundle_problem import BundleProblem
from jaxba.solver.solve import Solution


def is_model(output: str, source: str | None) -> bool:
    """Whether the output is written as a COLMAP model: it is a folder, or the problem is a model
    and the output has no ending of a file (`formats.is_file_name`). `source` is the path of the
    problem; None for a random scene."""
    if is_folder(output):
        return True
    if source is None or not is_colmap(source) or formats.is_file_name(output):
        return False
    # a stream or device is no folder's name
    return not os.path.exists(output) or os.path.isfile(output)


def _is_like_source(output: str, source: str | None) -> bool:
    return source is not None and is_colmap(source) and is_model(output, source)


def _is_transforms(output: str, source: str | None) -> bool:
    """Whether cameras alone are written, for nerfstudio."""
    return (
        not is_model(output, source)
        and formats.by_ending(output, written=True) is formats.TRANSFORMS
    )


def check_outputs(
    output: str | None,
    others: Mapping[str, str | None],
    source: str | None,
    read: Mapping[str, str | None],
) -> None:
    """Checks that the output files can be written, and that none is another one or a file that is
    read; only the solution may replace its own problem. `output` is that of `--output`, `others`
    are other output files by their options, `source` is the path of the problem, and `read` are
    other files that are read, by what they are. Raises UsageError, ProblemError: they cannot be, or
    one is; the message is one line."""
    solution: list[StrPath | None] = [output]
    if output and is_model(output, source):
        solution = [*formats.model_files(output)]
        common.check_folder("--output", output)
        if not _is_like_source(output, source):
            check_output(output)
    else:
        common.check_writable("--output", output)
        check_output(output or "")
    for option, path in others.items():
        common.check_writable(option, path)
    written = {option: [path] for option, path in others.items()}
    check_apart({"--output": solution, **written}, {what: [path] for what, path in read.items()})
    same = output and source and os.path.exists(output) and os.path.samefile(output, source)
    replaced = same and not _is_transforms(str(output), source)  # which are cameras alone
    check_apart(
        {"--output": [] if replaced else solution, **written}, {PROBLEM: problem_files(source)}
    )


def check_storable(output: str | None, problem: BundleProblem, source: str | None) -> None:
    """Checks that the format of the output can hold the problem. Raises ProblemError: it cannot;
    one line."""
    if output and is_model(output, source) and not _is_like_source(output, source):
        check_model(problem, output)
    if output and not is_model(output, source):
        known = formats.by_ending(output, written=True) or formats.FORMATS[0]
        if known.check is not None:
            known.check(problem, output)


def store(output: str, solution: Solution, source: str | None) -> None:
    """Writes a solution, without what it rejected. Raises OSError, ProblemError: it cannot be
    written."""
    if _is_like_source(output, source):
        write_colmap(solution.problem, output, like=source, rejected=solution.rejected)
    elif _is_transforms(output, source) and source is not None and is_colmap(source):
        write_transforms(solution.problem, output, like=source)
    else:
        write_problem(fitting(solution), output)


def fitting(solution: Solution) -> BundleProblem:
    """The solved problem without observations that were rejected, and without points that only they
    saw."""
    if solution.rejected is None or not solution.rejected.any():
        return solution.problem
    kept = ~solution.rejected
    return solution.problem.subset(
        kept, points=np.unique(np.asarray(solution.problem.point_index)[kept])
    )


def write_solution(output: str, solution: Solution, source: str | None) -> None:
    """Writes the solution, and prints what was written and what the file cannot store. Raises
    UsageError: it fails."""
    model = is_model(output, source)
    cameras = _is_transforms(output, source)
    like = source is not None and is_colmap(source) and (model or cameras)
    try:
        store(output, solution, source)
    except OSError as error:
        raise common.UsageError(f"--output {output}: {error.strerror or error}") from None
    if (model or cameras) and not like:
        what = "model" if model else "file"
        common.print_line(
            f"note: names and sizes of images, and so principal points, are made up in that {what}"
        )
    common.print_line(f"wrote {output}")
    if formats.ending(output) and formats.by_ending(output) is None and not model:
        common.print_line(f"note: {output} is a BAL file; {formats.formats_written()}")
    if not (like or cameras) and (lost := table.lost_in(solution.problem, model)):
        common.print_line(f"note: that {'model' if model else 'file'} cannot store: {lost}")
