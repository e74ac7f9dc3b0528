"""Real problems of the configuration: those that are on this machine, and the reasons for those that are not."""

from __future__ import annotations

import glob
import os
import re
from dataclasses import dataclass
from pathlib import Path

from jaxba.bench.sources import Source
from jaxba.datasets.bal.paths import resolve
from jaxba.paper.config import FamilyConfig, RealConfig
from jaxba.paper.subproblem import SubProblem
from jaxba.problem.bundle_problem import ProblemError

DATA_VARIABLE = "JAXBA_DATA"
"""Environment variable with the folder of real problems."""

NOT_SET = f"not run: {DATA_VARIABLE} is not set"

_SUFFIXES = re.compile(r"(\.(txt|out|bal))?(\.(bz2|gz|xz))?$")


@dataclass(frozen=True)
class FamilyProblems:
    """The real problems of one family that are on this machine."""

    family: str
    """Name of the family."""

    whole: tuple[Source, ...]
    """Complete problems."""

    sub_problems: tuple[SubProblem, ...]
    """Sub-problems of the files."""

    missing: tuple[str, ...]
    """Entries of the configuration for which no file exists."""

    reason: str = ""
    """Why there are no problems; empty if there are some."""

    @property
    def all(self) -> tuple[Source, ...]:
        """Complete problems, then sub-problems."""
        return (*self.whole, *self.sub_problems)


def find(config: FamilyConfig) -> FamilyProblems:
    """Looks for the files of a family. Missing files are not an error."""
    found, missing = [], []
    for entry in config.files:
        paths = _paths(entry)
        found += [Source(label(path), config.name, path) for path in paths]
        if not paths:
            missing.append(entry)
    sub_problems = tuple(
        SubProblem(f"{source.name}-first{count}", config.name, source.location, cameras=count)
        for source in found
        for count in config.cameras
    )
    reason = ""
    if not found:
        uses_variable = any(DATA_VARIABLE in entry for entry in config.files)
        reason = NOT_SET if uses_variable and not os.environ.get(DATA_VARIABLE) else "not run: no file of it is here"
    return FamilyProblems(config.name, tuple(found) if config.whole else (), sub_problems, tuple(missing), reason)


def families(config: RealConfig) -> list[FamilyProblems]:
    """The problems of each BAL family."""
    return [find(family) for family in config.bal]


def bal(config: RealConfig) -> tuple[Source, ...]:
    """The BAL problems on this machine and their sub-problems."""
    return tuple(source for family in families(config) for source in family.all)


def lens_is_known(config: RealConfig, source: Source) -> bool:
    """Whether only poses and points are unknown, as in the paper: on KITTI, whose cameras are calibrated."""
    return source.family == config.kitti.name


def training_files(config: RealConfig, source: Source) -> tuple[str, tuple[str, ...]]:
    """What an agent may be trained on that is judged on a problem: the other families of BAL, or the other files of
    KITTI.

    Returns:
        Name of what is left out, and the paths of the rest; none for a problem of neither data set.
    """
    if lens_is_known(config, source):
        files = _files(config.kitti)
        return label(source.location), tuple(path for path in files if path != source.location)
    if source.family not in [family.name for family in config.bal]:
        return source.name, ()
    others = [family for family in config.bal if family.name != source.family]
    return source.family, tuple(path for family in others for path in _files(family))


def reason_without_bal(config: RealConfig) -> str:
    """Why there are no BAL problems; empty if there are some."""
    reasons = [found.reason for found in families(config)]
    if not reasons:
        return "not run: the configuration names no problem of BAL"
    return "" if "" in reasons else NOT_SET if NOT_SET in reasons else reasons[0]


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
