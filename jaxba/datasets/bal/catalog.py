"""Names of the problems of BAL ("Bundle Adjustment in the Large", Agarwal et al. 2010), such as ladybug-49."""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from dataclasses import dataclass

from jaxba.datasets.bal.problems import PROBLEMS
from jaxba.problem.bundle_problem import ProblemError


@dataclass(frozen=True)
class Entry:
    """One file of the data set."""

    family: str
    """ladybug, trafalgar, dubrovnik, venice or final; the folder of the file."""

    cameras: int
    points: int

    sha256: str | None
    """Checksum of the compressed file in hexadecimal digits; None where none is published."""

    @property
    def name(self) -> str:
        """Family and number of cameras, as in papers; unique."""
        return f"{self.family}-{self.cameras}"

    @property
    def file(self) -> str:
        """Path of the file relative to the folder of the data set, on the server and in the cache."""
        return f"{self.family}/problem-{self.cameras}-{self.points}-pre.txt.bz2"


ENTRIES = tuple(Entry(family, *row) for family, rows in PROBLEMS.items() for row in rows)
"""The whole data set, sorted by family and size."""


def find(name: str) -> Entry:
    """The problem with a name.

    Raises:
        ProblemError: no such name; the message suggests the closest ones.
    """
    found = next((entry for entry in ENTRIES if entry.name == name.lower()), None)
    if found is None:
        raise ProblemError(_unknown(name, [entry.name for entry in ENTRIES]))
    return found


def select(names: Sequence[str]) -> list[Entry]:
    """The problems with some names, without duplicates; the name of a family stands for all of its problems.

    Raises:
        ProblemError: as `find` does.
    """
    known = [*PROBLEMS, *(entry.name for entry in ENTRIES)]
    found: dict[Entry, None] = {}
    for name in names:
        members = [entry for entry in ENTRIES if name.lower() in (entry.name, entry.family)]
        if not members:
            raise ProblemError(_unknown(name, known))
        found |= dict.fromkeys(members)
    return list(found)


def _unknown(name: str, known: list[str]) -> str:
    """One line that suggests similar names; within a family, those with the nearest numbers of cameras."""
    family, _, cameras = name.lower().partition("-")
    if family in PROBLEMS and cameras.isdecimal():
        nearest = sorted(PROBLEMS[family], key=lambda row: abs(row[0] - int(cameras)))[:3]
        close = [f"{family}-{row[0]}" for row in sorted(nearest)]
    else:
        close = difflib.get_close_matches(name.lower(), known, n=3)
    hint = f"did you mean {', '.join(close)}?" if close else "jaxba-data list shows all names"
    return f"no problem of BAL is called {name!r}; {hint}"
