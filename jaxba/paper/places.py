"""Which real problems a run finds, and in words which it does not."""

from __future__ import annotations

import glob
import os
import re
from dataclasses import dataclass
from pathlib import Path

from jaxba.bench.sources import Source
from jaxba.datasets.bal.paths import resolve
from jaxba.paper.config import FamilyConfig, RealConfig
from jaxba.paper.subproblem import Cut
from jaxba.problem.bundle_problem import ProblemError

DATA_VARIABLE = "JAXBA_DATA"
"""Environment variable: folder of real problems."""

NOT_SET = f"not run: {DATA_VARIABLE} is not set"

_ENDING = re.compile(r"(\.(txt|out|bal))?(\.(bz2|gz|xz))?$")


@dataclass(frozen=True)
class Found:
    """The real problems of one family."""

    family: str
    """Its name."""

    whole: tuple[Source, ...]
    """Files."""

    cuts: tuple[Cut, ...]
    """Sub-problems of them."""

    missing: tuple[str, ...]
    """What was named and is not here, as it was named."""

    reason: str = ""
    """Why nothing was found; empty where something was."""

    @property
    def all(self) -> tuple[Source, ...]:
        """Files, then sub-problems."""
        return (*self.whole, *self.cuts)


def find(config: FamilyConfig) -> Found:
    """Looks for the files of a family; never fails."""
    found, missing = [], []
    for entry in config.files:
        paths = _paths(entry)
        found += [Source(_label(path), config.name, path) for path in paths]
        if not paths:
            missing.append(entry)
    cuts = tuple(
        Cut(f"{source.name}-first{count}", config.name, source.location, cameras=count)
        for source in found
        for count in config.cameras
    )
    reason = ""
    if not found:
        uses_variable = any(DATA_VARIABLE in entry for entry in config.files)
        reason = NOT_SET if uses_variable and not os.environ.get(DATA_VARIABLE) else "not run: no file of it is here"
    return Found(config.name, tuple(found) if config.whole else (), cuts, tuple(missing), reason)


def families(config: RealConfig) -> list[Found]:
    """The families of BAL."""
    return [find(family) for family in config.bal]


def bal(config: RealConfig) -> tuple[Source, ...]:
    """The problems of BAL at hand; parts of them where none enters whole."""
    found = families(config)
    return tuple(source for family in found for source in family.whole) or bal_and_parts(config)


def bal_and_parts(config: RealConfig) -> tuple[Source, ...]:
    """The problems of BAL at hand and the parts that were cut from them."""
    return tuple(source for family in families(config) for source in family.all)


def why_no_bal(config: RealConfig) -> str:
    """The reason why there is no problem of BAL; empty where there is one."""
    reasons = [found.reason for found in families(config)]
    if not reasons:
        return "not run: the configuration names no problem of BAL"
    return "" if "" in reasons else NOT_SET if NOT_SET in reasons else reasons[0]


def _paths(entry: str) -> list[str]:
    expanded = os.path.expandvars(entry)
    if "$" in expanded:
        return []
    try:
        expanded = resolve(expanded)
    except ProblemError:  # a problem of BAL that has not been downloaded
        return []
    return sorted(path for path in glob.glob(expanded) if Path(path).is_file())


def _label(path: str) -> str:
    return _ENDING.sub("", Path(path).name)
