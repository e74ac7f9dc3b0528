"""Other bundle adjustment libraries that `jaxba-bench` can compare with. Each needs an optional dependency, which is
imported only by the modules that use it."""

from __future__ import annotations

from importlib.util import find_spec

from jaxba.solver.names import SolverName
from jaxba.typing import InputError

NEEDS = {"pyceres": ("ceres", ("pyceres", "pycolmap"))}
"""For each library: the extra of jaxba that installs it, and the packages of that extra."""


def require(solver: SolverName) -> None:
    """Checks that the library of a solver is installed. Raises InputError: it is not; the message names the package to
    install."""
    if not solver.peer:
        return
    extra, packages = NEEDS[solver.peer.partition(":")[0]]
    missing = [name for name in packages if find_spec(name) is None]
    if missing:
        raise InputError(f"{str(solver)!r} needs {' and '.join(missing)}: pip install jaxba[{extra}]")
