"""The files of `jaxba-solve`: whether they can be written is checked before the solve."""

from __future__ import annotations

from pathlib import Path

from jaxba.cli import common, table
from jaxba.io import check_output, write_colmap, write_problem
from jaxba.io.files import strip_compression
from jaxba.problem.bundle_problem import BundleProblem

FILE_ENDINGS = (".txt", ".bal", ".ply")
"""Endings by which the output of a COLMAP model is a file and no model, besides those of compression."""


def is_model(output: str, source: str | None) -> bool:
    """Whether the output is the folder of a COLMAP model: what has no ending of a file, where the problem is a model.

    Args:
        output: where to write.
        source: path of the problem; None if it has none.
    """
    if source is None or not Path(source).is_dir():
        return False
    bare = strip_compression(output)
    is_file = bare != output or Path(bare).suffix.lower() in FILE_ENDINGS
    return Path(output).is_dir() or not is_file


def check_outputs(output: str | None, log: str | None, source: str | None) -> None:
    """Refuses what could not be written later, or would replace something else.

    Raises:
        UsageError, ProblemError: in one line.
    """
    if output and is_model(output, source):
        common.check_folder("--output", output)
    else:
        common.check_writable("--output", output)
        check_output(output or "")
    common.check_writable("--log", log)
    if log and output and Path(log).resolve() == Path(output).resolve():
        raise common.UsageError(f"--output and --log name the same file, {output}")
    if log and source and Path(log).resolve() == Path(source).resolve():
        raise common.UsageError(f"--log names the problem's file, {log}")


def write_solution(output: str, problem: BundleProblem, source: str | None) -> None:
    """Writes the solution, and says so.

    Raises:
        UsageError: it could not be written.
    """
    lost = ""
    try:
        if source is not None and is_model(output, source):
            write_colmap(problem, output, like=source)
        else:
            write_problem(problem, output)
            lost = table.lost_in_bal(problem)
    except OSError as error:
        raise common.UsageError(f"--output {output}: {error.strerror or error}") from None
    common.print_line(f"wrote {output}")
    if lost:
        common.print_line(f"note: that file cannot store: {lost}")
