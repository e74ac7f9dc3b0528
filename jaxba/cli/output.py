"""Output files of `jaxba-solve`: checks before the solve, and writing."""

from __future__ import annotations

from pathlib import Path

from jaxba.cli import common, table
from jaxba.io import check_output, formats, is_colmap, is_folder, write_colmap, write_problem
from jaxba.io.bal import check_bal_lenses
from jaxba.problem.bundle_problem import BundleProblem


def is_model(output: str, source: str | None) -> bool:
    """Whether the output is written as a COLMAP model: it is a folder, or the problem is a model and the output has no
    ending of a file (`formats.is_file_name`).

    Args:
        output: path of the output.
        source: path of the problem; None for a random scene.
    """
    if is_folder(output):
        return True
    if source is None or not is_colmap(source):
        return False
    return not formats.is_file_name(output)


def _is_like_source(output: str, source: str | None) -> bool:
    """Whether the output is written as a COLMAP model like that of the problem."""
    return source is not None and is_colmap(source) and is_model(output, source)


def check_outputs(output: str | None, log: str | None, source: str | None, name: str = "--log") -> None:
    """Checks that the output files can be written and differ from each other and from the problem.

    Raises:
        UsageError, ProblemError: they cannot; the message is one line.
    """
    if output and is_model(output, source):
        common.check_folder("--output", output)
        if not _is_like_source(output, source):
            check_output(output)
    else:
        common.check_writable("--output", output)
        check_output(output or "")
    common.check_writable(name, log)
    if log and output and Path(log).resolve() == Path(output).resolve():
        raise common.UsageError(f"--output and --log name the same file, {output}")
    if log and source and Path(log).resolve() == Path(source).resolve():
        raise common.UsageError(f"{name} names the problem's file, {log}")


def check_storable(output: str | None, problem: BundleProblem, source: str | None) -> None:
    """Checks that the format of the output can hold the problem's lenses.

    Raises:
        ProblemError: it cannot; one line.
    """
    if output and not is_model(output, source) and formats.holds_bal_only(output):
        check_bal_lenses(problem, output)


def write_solution(output: str, problem: BundleProblem, source: str | None) -> None:
    """Writes the solution, and prints what was written and what the file format cannot store.

    Raises:
        UsageError: the solution cannot be written.
    """
    lost = ""
    model = is_model(output, source)
    try:
        if _is_like_source(output, source):
            write_colmap(problem, output, like=source)
        elif model:
            write_problem(problem, output)
            lost = table.lost_in_new_model(problem)
            common.print_line("note: names and sizes of images, and so principal points, are made up in that model")
        else:
            write_problem(problem, output)
            lost = table.lost_in_file(problem)
    except OSError as error:
        raise common.UsageError(f"--output {output}: {error.strerror or error}") from None
    common.print_line(f"wrote {output}")
    if formats.ending(output) and formats.by_ending(output) is None and not model:
        common.print_line(f"note: {output} is a BAL file; {formats.formats_written()}")
    if lost:
        common.print_line(f"note: that {'model' if model else 'file'} cannot store: {lost}")
