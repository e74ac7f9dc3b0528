"""Readers and writers of problems (`jaxba.io.formats` lists them), PLY point clouds; configurations
found by name."""

from __future__ import annotations

import os
import warnings

from jaxba.io import formats
from jaxba.io.bal import read_bal, write_bal
from jaxba.io.bundler import read_bundler, write_bundler
from jaxba.io.colmap import check_model, is_colmap, read_colmap, write_colmap
from jaxba.io.files import StrPath, display_name, visible
from jaxba.io.nerfstudio import write_transforms
from jaxba.io.ply import write_ply
from jaxba.problem.bundle_problem import (
    BundleProblem,
    ProblemError,
    ProblemWarning,
    check_is_problem,
)


def read_problem(path: StrPath, *, strict: bool = False) -> BundleProblem:
    """Reads a problem in any format that is known: a folder is a COLMAP model or OpenSfM's, a file
    is what its ending says (`jaxba.io.formats.FORMATS`). One with another ending is BAL, or what
    its first bytes say. Files may be compressed. `strict` refuses what else is a `ProblemWarning`:
    parts that would be left out and, but for COLMAP models, what looks wrong. Raises ProblemError:
    it cannot be read; one line that names the file and, where there is one, the record and the
    field."""
    if is_colmap(path):
        return read_colmap(path, strict=strict)
    if not strict:
        return formats.read(path)
    with warnings.catch_warnings():
        warnings.simplefilter("error", ProblemWarning)
        try:
            return formats.read(path)
        except ProblemWarning as note:
            raise ProblemError(str(note)) from None


def write_problem(problem: BundleProblem, path: StrPath) -> None:
    """Writes a problem: a folder, or a name that ends in a separator, is a COLMAP model that is
    like no other, `.out` a Bundler model, `.ply` a point cloud for viewers, `.json` cameras for
    nerfstudio, every other name that is not another format's a BAL file. Files may be compressed.
    Raises ProblemError: as `check_output` and the writers do."""
    check_is_problem(problem)
    check_output(path)
    (write_colmap if is_folder(path) else formats.writer(path))(problem, path)


def is_folder(path: StrPath) -> bool:
    """Whether a path is that of a folder that is there, or says by its end that it is one."""
    return os.path.isdir(path) or os.fspath(path).endswith(tuple(filter(None, (os.sep, os.altsep))))


def check_output(path: StrPath) -> None:
    """Refuses a name whose ending is that of a format that `write_problem` does not write. Raises
    ProblemError: it is, or the path is a folder of other things; one line."""
    if not is_folder(path):
        formats.writer(path)
    elif os.path.isdir(path) and visible(path) and not is_colmap(path):
        raise ProblemError(
            f"cannot write {display_name(path)}: the directory holds other files, and no COLMAP "
            "model"
        )
