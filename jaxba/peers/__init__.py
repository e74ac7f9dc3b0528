"""Other libraries that `jaxba-bench` compares with: optional dependencies, imported only where they
are used."""

from __future__ import annotations

from importlib.util import find_spec

from jaxba.solver.names import SolverName
from jaxba.typing import InputError

NEEDS = {"pyceres": ("ceres", ("pyceres", "pycolmap"))}
"""For each library: the extra of jaxba that installs it, and the packages of that extra."""


def require(solver: SolverName) -> None:
    """Raises InputError: the library of a solver is not installed; names the package to install."""
    if not solver.peer:
        return
    extra, packages = NEEDS[solver.peer.partition(":")[0]]
    missing = [name for name in packages if find_spec(name) is None]
    if missing:
        raise InputError(
            f"{str(solver)!r} needs {' and '.join(missing)}: pip install jaxba[{extra}]"
        )
