"""Other libraries that solve the same problem, as peers in `jaxba-bench`. Each is an extra; nothing here imports it."""

from __future__ import annotations

from importlib.util import find_spec

from jaxba.solver.names import SolverName, SolverNameError

NEEDS = {"pyceres": ("ceres", ("pyceres", "pycolmap"))}
"""By the peer's name: the extra that brings it, and the packages of that extra."""


def require(solver: SolverName) -> None:
    """Refuses a solver whose library is not installed.

    Raises:
        SolverNameError: one line that says what to install.
    """
    if not solver.peer:
        return
    extra, packages = NEEDS[solver.peer.partition(":")[0]]
    missing = [name for name in packages if find_spec(name) is None]
    if missing:
        raise SolverNameError(f"{str(solver)!r} needs {' and '.join(missing)}: pip install jaxba[{extra}]")
