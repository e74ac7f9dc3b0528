"""Paths of downloaded problems, by their names."""

from __future__ import annotations

import os
import re
from pathlib import Path

from jaxba.datasets.bal.catalog import Entry, find
from jaxba.datasets.bal.problems import PROBLEMS
from jaxba.problem.bundle_problem import ProblemError
from jaxba.runtime.user_cache import user_cache

FOLDER_VARIABLE = "JAXBA_BAL"
"""Environment variable: folder of downloaded problems, instead of `bal` in the user's cache folder."""

_NAME = re.compile(rf"(?:{'|'.join(PROBLEMS)})-\d+", re.IGNORECASE)


def data_folder() -> Path:
    """The folder of downloaded problems. It need not exist."""
    return Path(os.environ.get(FOLDER_VARIABLE) or user_cache("bal"))


def downloaded_path(entry: Entry) -> Path | None:
    """Path of a problem if it has been downloaded, else None."""
    path = data_folder() / entry.file
    return path if path.is_file() else None


def local_path(name: str) -> Path:
    """Path of the downloaded problem of a name.

    Raises:
        ProblemError: there is no problem of that name, or it has not been downloaded; one line that says how to.
    """
    entry = find(name)
    path = downloaded_path(entry)
    if path is None:
        raise ProblemError(f"{entry.name} is not here; get it with: jaxba-data download {entry.name}")
    return path


def resolve(location: str) -> str:
    """The path of a problem's name, such as ladybug-49, if no file is called so; every other location as it is.

    Raises:
        ProblemError: as `local_path` does, for a location that has the form of a name.
    """
    if _NAME.fullmatch(location) and not os.path.lexists(location):
        return str(local_path(location))
    return location
