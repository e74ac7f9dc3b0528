"""Methods: ways to make a step, or something in its place, each of which any damping policy can drive.

A method says which part of `StepOptions` it fixes; `lm_step` does the rest, so that solver, benchmark and game run all
of them alike. How to choose: docs/methods.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any, Literal, get_args

from jaxba.problem.options import StepOptions

MethodName = Literal["lm", "stba", "deeplm", "ddlm", "poba"]

DEFAULT_METHOD: MethodName = "lm"
"""Understood where none is named."""


class UnknownMethodError(ValueError):
    """A name that is no method. The message is one line for a person."""


@dataclass(frozen=True)
class Method:
    """One way to make a step."""

    name: MethodName
    """In commands, tables and files."""

    description: str
    """One line."""

    rule: str
    """The damping policy that the method was published with."""

    fixes: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}))
    """Fields of `StepOptions` that make the method."""

    def options(self, base: StepOptions) -> StepOptions:
        """The options of a step of this method; what it does not fix is that of `base`."""
        return replace(base, **self.fixes)


def _fixed(**fields: Any) -> Mapping[str, Any]:
    return MappingProxyType(fields)


METHODS: dict[str, Method] = {
    method.name: method
    for method in (
        Method("lm", "Levenberg-Marquardt: one reduced camera system, factored or by conjugate gradients", "ceres"),
        Method(
            "stba",
            "stochastic bundle adjustment: random clusters of cameras solved apart, then four repairs",
            "stba",
            _fixed(linear_solver="clustered"),
        ),
        # 1e-3 and 150: DeepLM, authors' code
        Method(
            "deeplm",
            "DeepLM's global solver: conjugate gradients on cameras and points together",
            "ceres",
            _fixed(linear_solver="normal", cg_forcing=1e-3, cg_max_iterations=150),
        ),
        Method(
            "ddlm",
            "DeepLM's stochastic domain decomposition: clusters optimised beside each other, then the points between",
            "ceres",
            _fixed(linear_solver="decomposed"),
        ),
        Method(
            "poba",
            "power bundle adjustment: a power series for the inverse of the reduced camera system",
            "ceres",
            _fixed(linear_solver="power"),
        ),
    )
}
"""All methods by name."""

if set(METHODS) != set(get_args(MethodName)):
    raise AssertionError("every method has a name, and every name a method")


def make_method(name: str) -> Method:
    """The method called `name`.

    Args:
        name: a key of `METHODS`; those that cluster cameras take the size of a cluster, as in `stba:16`.

    Raises:
        UnknownMethodError: no such method, or a size that makes no sense.
    """
    base, colon, size = name.partition(":")
    if base not in METHODS:
        raise UnknownMethodError(f"unknown method {name!r}; known: {', '.join(METHODS)}")
    method = METHODS[base]
    if not colon:
        return method
    if not method.options(StepOptions()).uses_partitions:
        raise UnknownMethodError(f"{name!r}: {base} has no clusters whose size could be set")
    if not (size.isdecimal() and int(size) > 0):
        raise UnknownMethodError(f"{name!r}: the cameras of a cluster must be a positive number, not {size!r}")
    return replace(method, fixes=_fixed(**method.fixes, cluster_cameras=int(size)))
