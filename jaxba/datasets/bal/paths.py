"""Names of the problems of BAL ("Bundle Adjustment in the Large", Agarwal et al. 2010), and where
downloaded ones lie.

Cameras and points in `problems.csv` are those of the file names of
https://grail.cs.washington.edu/projects/bal/ ; the download scripts of RootBA and of SymForce list
the same 98. The SHA-256 of the compressed files of Ladybug-49 and Trafalgar-21 were computed on the
files; the others are those of the Julia package VGDatasets. 16 files have none."""

from __future__ import annotations

import difflib
import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from jaxba.datasets import EXAMPLE
from jaxba.problem.bundle_problem import ProblemError
from jaxba.runtime.process import user_cache

# environment variable: folder of downloaded problems, else `bal` in the user's cache
FOLDER_VARIABLE = "JAXBA_BAL"


class Entry(NamedTuple):
    """One file of the data set."""

    family: str  # ladybug, trafalgar, dubrovnik, venice or final; the folder of the file
    cameras: int
    points: int

    sha256: str | None  # of the compressed file, hexadecimal; None where none is published

    @property
    def name(self) -> str:
        """Family and number of cameras, as in papers; unique."""
        return f"{self.family}-{self.cameras}"

    @property
    def file(self) -> str:
        """Path of the file relative to the folder of the data set, on the server and in the
        cache."""
        return f"{self.family}/problem-{self.cameras}-{self.points}-pre.txt.bz2"


_, *_ROWS = Path(__file__).with_name("problems.csv").read_text(encoding="ascii").split()
ENTRIES = tuple(
    Entry(family, int(cameras), int(points), checksum or None)
    for family, cameras, points, checksum in (row.split(",") for row in _ROWS)
)
"""The whole data set, sorted by family and size."""

FAMILIES = tuple(dict.fromkeys(entry.family for entry in ENTRIES))

_NAME = re.compile(rf"(?:{'|'.join(FAMILIES)})-\d+", re.IGNORECASE)


def select(names: Sequence[str]) -> list[Entry]:
    """The problems with some names, without duplicates; the name of a family stands for all of its
    problems. Raises ProblemError: no such name; the message suggests the closest ones."""
    found: dict[Entry, None] = {}
    for name in names:
        members = [entry for entry in ENTRIES if name.lower() in (entry.name, entry.family)]
        if not members:
            raise ProblemError(_unknown(name))
        found |= dict.fromkeys(members)
    return list(found)


def _unknown(name: str) -> str:
    """One line that suggests similar names; within a family, those with the nearest numbers of
    cameras."""
    family, _, cameras = name.lower().partition("-")
    known = [entry for entry in ENTRIES if entry.family == family]
    if known and cameras.isdecimal():
        nearest = sorted(known, key=lambda entry: abs(entry.cameras - int(cameras)))[:3]
        close = [entry.name for entry in sorted(nearest)]
    else:
        close = difflib.get_close_matches(
            name.lower(), [*FAMILIES, *(entry.name for entry in ENTRIES)], n=3
        )
    hint = f"did you mean {', '.join(close)}?" if close else "jaxba-data list shows all names"
    return f"no problem of BAL is called {name!r}; {hint}"


def data_folder() -> Path:
    """The folder of downloaded problems. It need not exist."""
    return Path(os.environ.get(FOLDER_VARIABLE) or user_cache("bal"))


def downloaded_path(entry: Entry) -> Path | None:
    """Path of a problem if it has been downloaded, else None."""
    path = data_folder() / entry.file
    return path if path.is_file() else None


def local_path(name: str) -> Path:
    """Path of a downloaded problem. Raises ProblemError: no such problem, or not downloaded; says
    how to."""
    found = next((entry for entry in ENTRIES if entry.name == name.lower()), None)
    if found is None:
        raise ProblemError(_unknown(name))
    path = downloaded_path(found)
    if path is None:
        raise ProblemError(
            f"{found.name} is not here; get it with: jaxba-data download {found.name}"
        )
    return path


def resolve(location: str) -> str:
    """The path of a problem's name, such as ladybug-49 or `example`, if no file is called so; every
    other location as it is. Raises ProblemError: as `local_path` does, for a location that has the
    form of a name."""
    if location == EXAMPLE.name.partition(".")[0] and not os.path.lexists(location):
        return str(EXAMPLE)
    if _NAME.fullmatch(location) and not os.path.lexists(location):
        return str(local_path(location))
    return location
