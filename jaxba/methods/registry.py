"""The optimisation methods by name. Every method works with every damping policy.

Plain Levenberg-Marquardt is `lm`. The others implement `StepMethod` of `jaxba.lm.method`, so that solver,
benchmark and game run all of them through `lm_step`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Literal, Protocol, get_args, runtime_checkable

from jaxba.methods.deeplm import GlobalConjugateGradients
from jaxba.methods.poba import PowerSeries
from jaxba.methods.stba import StochasticClusters
from jaxba.problem.options import StepOptions

MethodName = Literal["lm", "stba", "deeplm", "poba"]

DEFAULT_METHOD: MethodName = "lm"
"""The method of a solver name without one."""


class UnknownMethodError(ValueError):
    """A name is not that of a method. The message is one line for the user."""


@runtime_checkable
class Method(Protocol):
    """An optimisation method: it decides how the step of an iteration is computed."""

    @property
    def name(self) -> str:
        """Name in commands, tables and files."""
        ...

    @property
    def description(self) -> str:
        """One line for the user."""
        ...

    @property
    def rule(self) -> str:
        """Name of the damping rule that the method was published with."""
        ...

    def options(self, base: StepOptions) -> StepOptions:
        """Step options for this method, which keep everything of `base` that the method does not decide."""
        ...


@dataclass(frozen=True)
class LevenbergMarquardt:
    """The method `lm`."""

    name: str = field(default=DEFAULT_METHOD, init=False)
    description: str = field(
        default="Levenberg-Marquardt: one reduced camera system, factored or by conjugate gradients", init=False
    )
    rule: str = field(default="ceres", init=False)

    def options(self, base: StepOptions) -> StepOptions:
        """See `Method`."""
        return replace(base, method=None)


_CLUSTERED: dict[str, Callable[[int], Method]] = {
    "stba": lambda size: StochasticClusters(cluster_cameras=size),
}
"""Methods with clusters, by the largest number of cameras in a cluster."""

METHODS: dict[str, Method] = {
    method.name: method
    for method in (
        LevenbergMarquardt(),
        StochasticClusters(),
        GlobalConjugateGradients(),
        PowerSeries(),
    )
}
"""All methods by name."""

if set(METHODS) != set(get_args(MethodName)):
    raise AssertionError("every method has a name, and every name a method")


def make_method(name: str) -> Method:
    """The method called `name`.

    Args:
        name: a key of `METHODS`; methods with clusters of cameras accept their largest size, as in `stba:16`.

    Raises:
        UnknownMethodError: no such method, or an invalid size.
    """
    base, colon, size = name.partition(":")
    if base not in METHODS:
        raise UnknownMethodError(f"unknown method {name!r}; known: {', '.join(METHODS)}")
    if not colon:
        return METHODS[base]
    if base not in _CLUSTERED:
        raise UnknownMethodError(f"{name!r}: {base} has no clusters whose size could be set")
    if not (size.isdecimal() and int(size) > 0):
        raise UnknownMethodError(f"{name!r}: the cameras of a cluster must be a positive number, not {size!r}")
    return _CLUSTERED[base](int(size))
