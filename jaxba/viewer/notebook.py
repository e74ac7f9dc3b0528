"""`jaxba.view`: a problem or a solve in the browser, from Python."""

from __future__ import annotations

from typing import Any

from jaxba.problem.bundle_problem import BundleProblem
from jaxba.solver.solve import Solution


def view(what: BundleProblem | Solution) -> Any:
    """Serves a page with the cameras and points of a problem, or of a solution, to this machine.

    Returns the viewer, with `url` and `close()`; a notebook shows, and saves, a page that needs no
    server. Raises ImportError: viser is not installed (pip install jaxba[view])."""
    from jaxba.viewer.page import Viewer
    from jaxba.viewer.sources import shown

    is_solution = isinstance(what, Solution)
    return Viewer(
        [shown(what.problem if is_solution else what, "solution" if is_solution else "problem")]
    )
