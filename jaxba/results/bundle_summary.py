"""What `bundle_adjustment` returns: a solution that speaks as pycolmap's summaries."""

from __future__ import annotations

import importlib
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from jaxba.lm.records import StepInfo
from jaxba.lm.termination import Termination
from jaxba.problem.bundle_problem import CAMERA_SIZE, NONE, BundleProblem
from jaxba.solver.solve import Solution

FAILED = (Termination.NOTHING, Termination.NO_WEIGHT)
"""Ends of a solve that changed nothing, which Ceres calls FAILURE."""


@dataclass(frozen=True, eq=False, repr=False)
class BundleAdjustmentSummary(Solution):
    """A solution with the names that pycolmap's summaries have, of COLMAP 3 and 4."""

    @property
    def termination_type(self) -> Any:
        """`CONVERGENCE`, `NO_CONVERGENCE` or `FAILURE`, as a
        `pycolmap.BundleAdjustmentTerminationType`; of COLMAP 3 a `TerminationType` of Ceres."""
        name = "CONVERGENCE" if self.converged else "NO_CONVERGENCE"
        if self.termination in FAILED:
            name = "FAILURE"
        pycolmap = importlib.import_module("pycolmap")
        if hasattr(pycolmap, "BundleAdjustmentTerminationType"):
            return pycolmap.BundleAdjustmentTerminationType.__members__[name]
        return pycolmap.pyceres.TerminationType.__members__[name]

    @property
    def num_residuals_reduced(self) -> int:
        """`num_residuals`, by the name that COLMAP 3 has for it."""
        return self.num_residuals

    def is_solution_usable(self) -> bool:
        """Whether something was solved, converged or not."""
        return self.termination not in FAILED

    def brief_report(self) -> str:
        """Iterations, costs (pixels^2) and the termination in one line."""
        costs = f"Initial cost: {self.initial_cost:e}, Final cost: {self.final_cost:e}"
        end = f"Termination: {self.termination_type.name}"
        return f"jaxba report: Iterations: {self.iterations}, {costs}, {end}"

    def full_report(self) -> str:
        """`brief_report`, the size of the problem and why the solve ended, a line each."""
        size = f"{self.num_residuals} residuals, {self.num_parameters} parameters"
        return "\n".join([self.brief_report(), size, self.termination.reason])

    @classmethod
    def of(cls, solution: Solution) -> BundleAdjustmentSummary:
        """The summary of a solution."""
        return cls(**{field.name: getattr(solution, field.name) for field in fields(solution)})

    @classmethod
    def nothing(cls) -> BundleAdjustmentSummary:
        """The summary where nothing is observed."""
        empty = np.zeros((0, 2))
        cameras = np.zeros((0, CAMERA_SIZE))
        return cls(
            problem=BundleProblem(cameras, np.zeros((0, 3)), empty, NONE, NONE),
            initial_cost=0.0,
            final_cost=0.0,
            iterations=0,
            accepted=0,
            termination=Termination.NOTHING,
            history=StepInfo.stacked([]),
            linear_solver="none",
            setup_s=0.0,
            compile_s=0.0,
            total_s=0.0,
        )
