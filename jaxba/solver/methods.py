"""The methods that compute a step, by name. Every method works with every damping policy.

Plain Levenberg-Marquardt is `lm`. The others are experiments: none is imported before it is asked
for by name. Another package can add one by an entry point of the group `jaxba.methods`: its name is
that of the method, its object a class derived from `lm.method.StepMethod` that needs no arguments.
`SolveOptions.method` also takes an object, without a name."""

from __future__ import annotations

import functools
from collections.abc import Iterator, Mapping
from dataclasses import replace
from importlib.metadata import EntryPoint, entry_points
from typing import Any, cast

from jaxba.lm.method import PLAIN, StepMethod
from jaxba.problem.checks import shown
from jaxba.typing import InputError

DEFAULT_METHOD = PLAIN.name
"""The method of a solver name without one."""

GROUP = "jaxba.methods"
"""Group of the entry points of other packages."""

SHIPPED = {
    "lm": "jaxba.lm.method:LevenbergMarquardt",
    "stba": "jaxba.methods.stba:StochasticClusters",
    "deeplm": "jaxba.methods.deeplm:GlobalConjugateGradients",
}
"""Where the classes of the package's own methods are."""


class _Methods(Mapping[str, StepMethod]):
    """The mapping `METHODS`, made of entry points."""

    @functools.cached_property
    def _found(self) -> dict[str, EntryPoint]:
        own = (EntryPoint(name, place, GROUP) for name, place in SHIPPED.items())
        return {entry.name: entry for entry in (*own, *entry_points(group=GROUP))}

    def __getitem__(self, name: str) -> StepMethod:
        return self._found[name].load()()

    def __iter__(self) -> Iterator[str]:
        return iter(self._found)

    def __len__(self) -> int:
        return len(self._found)

    def __contains__(self, name: object) -> bool:
        return name in self._found


METHODS: Mapping[str, StepMethod] = _Methods()
"""All methods by name. Each is imported when it is looked up."""


def make_method(name: str) -> StepMethod:
    """The method called `name`, a key of `METHODS`; methods with clusters of cameras accept their
    largest size, as in `stba:16`. Raises InputError: no such method, or an invalid size."""
    if not isinstance(name, str):
        raise InputError(f"the name of a method must be a text, not {shown(name)}")
    if name == DEFAULT_METHOD:
        return PLAIN
    base, colon, size = name.partition(":")
    if base not in METHODS:
        raise InputError(f"unknown method {name!r}; known: {', '.join(METHODS)}")
    method = METHODS[base]
    if not colon:
        return method
    if method.cluster_cameras is None:
        raise InputError(f"{name!r}: {base} has no clusters whose size could be set")
    if not (size.isdecimal() and int(size) > 0):
        raise InputError(
            f"{name!r}: the cameras of a cluster must be a positive number, not {size!r}"
        )
    return cast(StepMethod, replace(cast(Any, method), cluster_cameras=int(size)))
