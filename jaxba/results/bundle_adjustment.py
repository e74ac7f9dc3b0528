"""`bundle_adjustment`: pycolmap's function of this name, by `jaxba.solve`."""

from __future__ import annotations

from typing import Any

from jaxba.io.reconstruction import from_pycolmap
from jaxba.lm.termination import Tolerances
from jaxba.problem.gauge import with_gauge
from jaxba.problem.losses import Loss
from jaxba.solver.options import SolveOptions
from jaxba.solver.solve import Solution, solve

TOLERANCES = {"function_tolerance": "ftol", "gradient_tolerance": "gtol", "parameter_tolerance": "xtol"}
"""COLMAP's tolerances by name, as those of `Tolerances`."""


def bundle_adjustment(reconstruction: Any, options: Any = None, config: Any = None) -> Solution:
    """Optimises a `pycolmap.Reconstruction` in place, as `pycolmap.bundle_adjustment` does, and returns the solution.

    Args:
        reconstruction: start and result.
        options: a `pycolmap.BundleAdjustmentOptions`: what is refined, the loss, the tolerances and the limit of
            iterations. Those that COLMAP has by default mean jaxba's own, and what only says how Ceres computes means
            nothing.
        config: a `pycolmap.BundleAdjustmentConfig`. None: all images, in the gauge of two cameras.

    Raises as `from_pycolmap` and `solve`."""
    problem = with_gauge(from_pycolmap(reconstruction, config, options), "free" if config else "two-cameras")
    solution = solve(problem, options=solve_options(options) if options else SolveOptions())
    solution.update(reconstruction)
    return solution


def solve_options(options: Any) -> SolveOptions:
    """What a `pycolmap.BundleAdjustmentOptions` says of the solve, where it says something else than COLMAP's
    default."""
    given, usual = options.ceres.solver_options, type(options)().ceres.solver_options
    changed = lambda name: getattr(given, name) != getattr(usual, name)
    tolerances = {own: getattr(given, name) for name, own in TOLERANCES.items() if changed(name)}
    limit = {"max_iterations": given.max_num_iterations} if changed("max_num_iterations") else {}
    kind = options.ceres.loss_function_type.name
    loss = Loss() if kind == "TRIVIAL" else Loss(kind.lower(), options.ceres.loss_function_scale)
    return SolveOptions(loss=loss, tolerances=Tolerances(**tolerances), **limit)
