"""Damping policies by the names that commands, tables and files use."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from jaxba.damping.policy import DampingPolicy
from jaxba.damping.policy_file import load_policy
from jaxba.damping.rules import Ceres, Classic, Schedule, gauss_newton, gtsam, nielsen, stba, theseus

POLICIES: dict[str, tuple[Callable[[], DampingPolicy], str]] = {
    "ceres": (Ceres, "Ceres' trust-region rule: x1/3 to x2 by gain ratio, x2, x4, ... after rejections"),
    "classic": (Classic, "the paper's baseline: 1/4, then x1/2 after a good step, x2 otherwise"),
    "gtsam": (gtsam, "GTSAM's legacy rule: 1e-5, then x1/10 or x10"),
    "nielsen": (nielsen, "g2o's rule: 1e-5, as Ceres' but always shrinking after success"),
    "stba": (stba, "STBA's rule: 1e-4, then x1/3 or x3"),
    "theseus": (theseus, "Theseus' adaptive rule: 1e-3, then x1/9 or x11"),
    "schedule": (Schedule, "the paper's cycle 1e-15, 1e-15, 0.194, 0.551"),
    "gauss-newton": (gauss_newton, "next to no damping: 1e-10 throughout"),
}
"""Factory and one line of description by name."""

LEARNED, LEARNED_PLAIN, LEARNED_DRIVER = "learned", "learned-plain", "learned-driver"
"""The shipped policies, each where it is the best: for a step with embedded iterations; for lambda alone
(`learned+refine0`); and for lambda alone where another library makes the step and damps all variables alike. In the
name of a solver `learned` means the one that fits (solver/names.py)."""

SHIPPED = {
    LEARNED: "default.safetensors",
    LEARNED_PLAIN: "plain.safetensors",
    LEARNED_DRIVER: "driver.safetensors",
}
"""Their files in `jaxba/policies`, each made by the preset of `jaxba-train` that has its name, `driver` before a rescue
of the guard changed (docs/game-tried.md)."""

SUFFIX = ".safetensors"
"""Ending by which a name is the path of a policy file."""

CONSTANT = "constant"
"""Prefix of `constant:VALUE`."""


class UnknownPolicyError(ValueError):
    """A name that is no policy. The message is one line for a person."""


def make_policy(name: str) -> DampingPolicy:
    """The policy called `name`.

    Args:
        name: `learned`, here that for plain LM, another of `SHIPPED`, the path of a policy file, a key of `POLICIES`,
            optionally `name:FIRST_LAMBDA` for the rules that have one, or `constant:LAMBDA`.

    Raises:
        UnknownPolicyError: no such policy, or a lambda that is not a positive number.
        PolicyFileError: a path, but not of a policy file.
    """
    if name in SHIPPED:
        return load_policy(Path(__file__).parent.parent / "policies" / SHIPPED[name])
    if is_learned(name):
        return load_policy(name)
    base, colon, number = name.partition(":")
    if base == CONSTANT:
        return Schedule(values=(_damping(name, number),))
    if base not in POLICIES:
        known = ", ".join([LEARNED, *POLICIES, "constant:LAMBDA", f"FILE{SUFFIX}"])
        raise UnknownPolicyError(f"unknown damping policy {name!r}; known: {known}")
    policy = POLICIES[base][0]()
    if not colon:
        return policy
    if isinstance(policy, Schedule):
        raise UnknownPolicyError(f"{base!r} has no first lambda to set; use constant:LAMBDA")
    return replace(policy, initial=_damping(name, number))  # type: ignore[type-var]


def is_learned(name: str) -> bool:
    """Whether a policy of this name has a network and brings its own embedded iterations."""
    return name in SHIPPED or name.endswith(SUFFIX)


def _damping(name: str, number: str) -> float:
    try:
        value = float(number)
    except ValueError:
        value = math.nan
    if not (value > 0 and math.isfinite(value)):
        raise UnknownPolicyError(f"{name!r}: lambda must be a positive number, not {number!r}")
    return value
