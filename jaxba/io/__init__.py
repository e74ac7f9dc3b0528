"""Readers and writers: BAL text, Bundler and COLMAP models, PLY point clouds; configurations found by name."""

from __future__ import annotations

import os
from pathlib import PurePath

from jaxba.io.bal import read_bal, write_bal
from jaxba.io.bundler import read_bundler
from jaxba.io.colmap import is_colmap, read_colmap, write_colmap
from jaxba.io.files import StrPath, display_name, strip_compression
from jaxba.io.ply import write_ply
from jaxba.problem.bundle_problem import BundleProblem, ProblemError

__all__ = [
    "check_output",
    "is_colmap",
    "is_folder",
    "read_bal",
    "read_bundler",
    "read_colmap",
    "read_problem",
    "write_bal",
    "write_colmap",
    "write_ply",
    "write_problem",
]


def read_problem(path: StrPath, *, strict: bool = False) -> BundleProblem:
    """Reads a problem: a folder is a COLMAP model, `.out` a Bundler model, every other name a BAL file, these two also
    compressed.

    Args:
        path: file or folder.
        strict: refuse a problem of which a part would be left out, as only `read_colmap` does.

    Raises:
        ProblemError: as `read_colmap`, `read_bundler` and `read_bal` do.
    """
    if os.path.isdir(path):
        return read_colmap(path, strict=strict)
    return (read_bundler if _kind(path) == ".out" else read_bal)(path)


def write_problem(problem: BundleProblem, path: StrPath) -> None:
    """Writes a problem: a folder, or a name that ends in a separator, is a COLMAP model that is like no other, `.ply`
    is a point cloud for viewers, every other name a BAL file; these two also compressed.

    Raises:
        ProblemError: as `check_output`, `write_colmap`, `write_ply` and `write_bal` do.
    """
    check_output(path)
    if is_folder(path):
        write_colmap(problem, path)
        return
    (write_ply if _kind(path) == ".ply" else write_bal)(problem, path)


def is_folder(path: StrPath) -> bool:
    """Whether a path is that of a folder that is there, or says by its end that it is one."""
    return os.path.isdir(path) or os.fspath(path).endswith(tuple(filter(None, (os.sep, os.altsep))))


def check_output(path: StrPath) -> None:
    """Refuses a name that `read_problem` would not read as the format that `write_problem` writes.

    Raises:
        ProblemError: the name is that of a Bundler model, or of a folder of other things; one line.
    """
    if is_folder(path):
        if os.path.isdir(path) and os.listdir(path) and not is_colmap(path):
            raise ProblemError(
                f"cannot write {display_name(path)}: the directory holds other files, and no COLMAP model"
            )
    elif _kind(path) == ".out":
        raise ProblemError(f"cannot write {display_name(path)}: Bundler models are only read; .txt is for BAL")


def _kind(path: StrPath) -> str:
    return PurePath(strip_compression(path)).suffix.lower()
