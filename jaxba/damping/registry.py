"""Damping policies by the names that commands, tables and files use."""

from __future__ import annotations

import functools
import importlib.util
import math
import os
import re
import sys
import traceback
from collections.abc import Callable
from dataclasses import replace
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from jaxba.damping.agent_config import embedded
from jaxba.damping.default_policy import Guarded
from jaxba.damping.learned import LearnedPolicy, always
from jaxba.damping.policy import DampingPolicy, check_policy
from jaxba.damping.policy_check import check_traceable
from jaxba.damping.policy_file import load_policy
from jaxba.damping.rules import (
    Ceres,
    Classic,
    Schedule,
    gauss_newton,
    gtsam,
    nielsen,
    stba,
    theseus,
)
from jaxba.problem.checks import shown
from jaxba.typing import InputError

# the shipped network, for lambda alone, and the guard of agents without a network
LEARNED = "learned"
BOLD = "bold"
GUARDED = "guarded"  # the default policy of a solve

SHIPPED = Path(__file__).parent.parent / "policies" / "default.safetensors"
"""File of `learned`, trained with the preset of `jaxba-train` that has its name."""


def bold() -> LearnedPolicy:
    """The smallest lambda that the guard of agents allows, in every iteration, and all embedded
    iterations."""
    return always(-1.0, embedded())


POLICIES: dict[str, tuple[Callable[[], DampingPolicy], str]] = {
    "ceres": (
        Ceres,
        "Ceres' trust-region rule: x1/3 to x2 by gain ratio, x2, x4, ... after rejections",
    ),
    "classic": (Classic, "the paper's baseline: 1/4, then x1/2 after a good step, x2 otherwise"),
    "gtsam": (gtsam, "GTSAM's legacy rule: 1e-5, then x1/10 or x10"),
    "nielsen": (nielsen, "g2o's rule: 1e-5, as Ceres' but always shrinking after success"),
    "stba": (stba, "STBA's rule: 1e-4, then x1/3 or x3"),
    "theseus": (theseus, "Theseus' adaptive rule: 1e-3, then x1/9 or x11"),
    "schedule": (Schedule, "the paper's cycle 1e-15, 1e-15, 0.194, 0.551"),
    "gauss-newton": (gauss_newton, "next to no damping: 1e-10 throughout"),
    GUARDED: (
        Guarded,
        "1e-6, then 1e-8, raised by half a decade after a failure; Ceres' rule after two in a row",
    ),
    BOLD: (
        bold,
        "the smallest lambda that the guard of agents allows: 1e-5, then /32 down to 1e-9",
    ),
}
"""Factory and one line of description by name."""

SUFFIX = ".safetensors"  # ending by which a name is the path of a policy file
OWN = r".+\.py:\w+"  # pattern of the name of a class in a Python file
CONSTANT = "constant"  # prefix of `constant:VALUE`


def make_policy(name: str) -> DampingPolicy:
    """The policy called `name`: `learned`; the path of a policy file; `FILE.py:CLASS`, for which
    the file is run; a key of `POLICIES`, with `:FIRST_LAMBDA` for rules that have one; or
    `constant:LAMBDA`. Raises InputError: no such policy, a lambda that is not a positive number, or
    a path that is not of a policy file."""
    if not isinstance(name, str):
        raise InputError(f"the name of a policy must be a text, not {shown(name)}")
    if re.fullmatch(OWN, name):
        return _own(*name.rsplit(":", 1))
    if is_learned(name):
        return load_policy(SHIPPED if name == LEARNED else name)
    base, colon, number = name.partition(":")
    if base == CONSTANT:
        return Schedule(values=(_damping(name, number),))
    if "+" in base:
        raise InputError(
            f"unknown damping policy {name!r}: its name has no '+'; the method and embedded "
            "iterations are options"
        )
    if base not in POLICIES:
        known = ", ".join([LEARNED, *POLICIES, "constant:LAMBDA", f"FILE{SUFFIX}", "FILE.py:CLASS"])
        similar = get_close_matches(base, [LEARNED, *POLICIES], 1)
        meant = f", did you mean {similar[0]}?" if similar else ";"
        raise InputError(f"unknown damping policy {name!r}{meant} known: {known}")
    policy = POLICIES[base][0]()
    if not colon:
        return policy
    if not hasattr(policy, "initial"):
        raise InputError(f"{base!r} has no first lambda to set; use constant:LAMBDA")
    return replace(policy, initial=_damping(name, number))  # type: ignore[type-var]


def is_learned(name: str) -> bool:
    """Whether a policy of this name has a network."""
    return name == LEARNED or name.endswith(SUFFIX)


def file_of(name: str) -> str | None:
    """The file of a policy's name; None if it names none."""
    if re.fullmatch(OWN, name):
        return name.rsplit(":", 1)[0]
    return name if name.endswith(SUFFIX) else None


def _own(path: str, name: str) -> DampingPolicy:
    """A policy of the user, made without arguments."""
    try:
        module = _module(os.path.abspath(path), os.stat(path).st_mtime_ns)
        policy = getattr(module, name)() if hasattr(module, name) else None
        if policy is not None:
            check_policy(policy)
            check_traceable(policy)
    except Exception as error:
        raise InputError(fault(error, path)) from None
    if policy is None:
        raise InputError(f"{path} has no class {name}")
    return policy


@functools.cache
def _module(path: str, _changed: int) -> Any:
    """The module of a file; one for all calls, so that its classes are the same ones."""
    spec = importlib.util.spec_from_file_location(path, path)
    assert spec is not None
    assert spec.loader is not None
    sys.modules[path] = module = importlib.util.module_from_spec(spec)  # dataclasses look there
    spec.loader.exec_module(module)
    return module


def fault(error: Exception, path: str) -> str:
    """What went wrong in a file of Python, and where, in one line."""
    # of an error that explains another one, the place is that of the other
    frames = traceback.extract_tb((error.__cause__ or error).__traceback__)
    numbers = [frame.lineno for frame in frames if frame.filename == os.path.abspath(path)]
    where = f"{path}, line {numbers[-1]}" if numbers else path
    if isinstance(error, OSError) and not numbers:
        return f"{where}: {error.strerror}"
    return f"{where}: {type(error).__name__}: {str(error).partition(chr(10))[0]}"


def brings_step(name: str) -> bool:
    """Whether a policy of this name brings a step of its own, with embedded iterations or
    without."""
    if re.fullmatch(OWN, name):
        return hasattr(make_policy(name), "step_options")
    return is_learned(name) or name.partition(":")[0] in (BOLD, GUARDED)


def _damping(name: str, number: str) -> float:
    try:
        value = float(number)
    except ValueError:
        value = math.nan
    if not (value > 0 and math.isfinite(value)):
        raise InputError(f"{name!r}: lambda must be a positive number, not {number!r}")
    return value
