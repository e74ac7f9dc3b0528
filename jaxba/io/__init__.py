"""Readers and writers of problems (`jaxba.io.formats` lists them), PLY point clouds; configurations found by name."""

from __future__ import annotations

import os

from jaxba.io import formats
from jaxba.io.bal import read_bal, write_bal
from jaxba.io.bundler import read_bundler, write_bundler
from jaxba.io.colmap import is_colmap, read_colmap, write_colmap
from jaxba.io.files import StrPath
from jaxba.io.notes import ProblemWarning
from jaxba.io.ply import write_ply
from jaxba.problem.bundle_problem import BundleProblem

__all__ = [
    "ProblemWarning",
    "check_output",
    "is_colmap",
    "read_bal",
    "read_bundler",
    "read_colmap",
    "read_problem",
    "write_bal",
    "write_bundler",
    "write_colmap",
    "write_ply",
    "write_problem",
]


def read_problem(path: StrPath) -> BundleProblem:
    """Reads a problem in any format that is known: a folder is a COLMAP model or OpenSfM's, a file is what its ending
    says (`jaxba.io.formats.FORMATS`). One with another ending is BAL, or what its first bytes say. Files may be
    compressed.

    What is remarkable but no error, such as observations that were left out, is a `ProblemWarning`.

    Raises:
        ProblemError: it cannot be read; one line that names the file and, where there is one, the record and the field.
    """
    return formats.read_folder(path) if os.path.isdir(path) else formats.read(path)


def write_problem(problem: BundleProblem, path: StrPath) -> None:
    """Writes a problem: `.out` is a Bundler model, `.ply` a point cloud for viewers, every other name that is not
    another format's a BAL file; each also compressed.

    Raises:
        ProblemError: as `check_output` and the writers do.
    """
    formats.writer(path)(problem, path)


def check_output(path: StrPath) -> None:
    """Refuses a name whose ending is that of a format that `write_problem` does not write.

    Raises:
        ProblemError: it is; one line with the endings that are written.
    """
    formats.writer(path)
