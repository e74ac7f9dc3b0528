"""Real problems of the configuration: those that are on this machine, and the reasons for those
that are not."""

from __future__ import annotations

import glob
import os
import re
from dataclasses import dataclass
from pathlib import Path

from jaxba.bench.sources import Source
from jaxba.datasets.bal.paths import resolve
from jaxba.paper.config import FamilyConfig, RealConfig
from jaxba.paper.subproblem import neighbourhood
from jaxba.problem.bundle_problem import ProblemError

DATA_VARIABLE = "JAXBA_DATA"  # environment variable with the folder of real problems

NOT_SET = f"not run: {DATA_VARIABLE} is not set"

_SUFFIXES = re.compile(r"(\.(txt|out|bal))?(\.(bz2|gz|xz))?$")


@dataclass(frozen=True)
class Problems:
    """A set of problems of a table."""

    name: str  # name in the report
    sources: tuple[Source, ...]  # complete problems, then sub-problems of them
    missing: tuple[str, ...] = ()  # entries of the configuration for which no file exists
    reason: str = ""  # why there are no problems; empty if there are some


def find(config: FamilyConfig) -> Problems:
    """The problems of a family that are on this machine. Missing files are not an error."""
    paths = {entry: _paths(entry) for entry in config.files}
    found = [Source(label(path), config.name, path) for one in paths.values() for path in one]
    parts = [neighbourhood(source, count) for source in found for count in config.cameras]
    reason = ""
    if not found:
        uses_variable = any(DATA_VARIABLE in entry for entry in config.files)
        reason = (
            NOT_SET
            if uses_variable and not os.environ.get(DATA_VARIABLE)
            else "not run: no file of it is here"
        )
    missing = tuple(entry for entry, one in paths.items() if not one)
    return Problems(config.name, (*(found if config.whole else ()), *parts), missing, reason)


def bal(config: RealConfig) -> Problems:
    """The BAL problems on this machine and their sub-problems."""
    families = [find(family) for family in config.bal]
    reasons = [found.reason for found in families] or [
        "not run: the configuration names no problem of BAL"
    ]
    return Problems(
        "BAL",
        tuple(source for found in families for source in found.sources),
        tuple(entry for found in families for entry in found.missing),
        "" if "" in reasons else NOT_SET if NOT_SET in reasons else reasons[0],
    )


def training_files(config: RealConfig, source: Source) -> tuple[str, tuple[str, ...]]:
    """What an agent may be trained on that is judged on a problem: the other families of BAL, or
    the other files of KITTI. Returns the name of what is left out, and the paths of the rest; none
    for a problem of neither data set."""
    if source.family == config.kitti.name:
        files = _files(config.kitti)
        return label(source.location), tuple(path for path in files if path != source.location)
    if source.family not in [family.name for family in config.bal]:
        return source.name, ()
    others = [family for family in config.bal if family.name != source.family]
    return source.family, tuple(path for family in others for path in _files(family))


def _files(config: FamilyConfig) -> list[str]:
    return [path for entry in config.files for path in _paths(entry)]


def _paths(entry: str) -> list[str]:
    expanded = os.path.expandvars(entry)
    if "$" in expanded:
        return []
    try:
        expanded = resolve(expanded)
    except ProblemError:  # a problem of BAL that has not been downloaded
        return []
    return sorted(path for path in glob.glob(expanded) if Path(path).is_file())


def label(path: str) -> str:
    """The name of a problem's file without its endings."""
    return _SUFFIXES.sub("", Path(path).name)
