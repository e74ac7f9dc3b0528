"""Bundle adjustment in JAX whose Levenberg-Marquardt damping is chosen by a policy, learned or
written."""

from __future__ import annotations

import gc
import importlib
from typing import TYPE_CHECKING, Any

_collects = gc.isenabled()
gc.disable()  # imports make no garbage, and looking for it takes a tenth of their time

from jaxba.damping import (
    POLICIES,
    Ceres,
    Classic,
    DampingPolicy,
    Geometric,
    ProblemInfo,
    Schedule,
    load_policy,
    make_policy,
    save_policy,
)
from jaxba.damping.agent_config import AgentConfig
from jaxba.damping.learned import LearnedPolicy
from jaxba.damping.policy import trained_step
from jaxba.datasets import example_problem
from jaxba.io import (
    read_bal,
    read_bundler,
    read_colmap,
    read_problem,
    write_bal,
    write_bundler,
    write_colmap,
    write_ply,
    write_problem,
    write_transforms,
)
from jaxba.lm.method import StepMethod
from jaxba.lm.records import LMState, StepInfo
from jaxba.lm.step import initial_state, lm_step
from jaxba.lm.termination import Termination, Tolerances
from jaxba.model.registration import with_residual
from jaxba.problem.bundle_problem import BundleProblem, ProblemError, ProblemWarning
from jaxba.problem.camera_models import CAMERA_MODELS, CameraModel, register_camera_model
from jaxba.problem.constants import Constants
from jaxba.problem.gauge import with_gauge
from jaxba.problem.hold import hold, release
from jaxba.problem.intrinsics import Lenses
from jaxba.problem.losses import Loss
from jaxba.problem.measured import with_lens_priors, with_position_priors, with_rotation_priors
from jaxba.problem.options import ConjugateGradients, Coordinates, Refinement, StepOptions
from jaxba.problem.part import part
from jaxba.problem.preprocess import perturb
from jaxba.problem.residuals import residual
from jaxba.problem.rigs import Rigs
from jaxba.runtime.gymnasium_registry import register_game
from jaxba.scenes import SceneConfig, random_scene, random_scene_with_truth, scene_like
from jaxba.solver.drivers import IterationRecord
from jaxba.solver.iteration import Carry
from jaxba.solver.loop import solve_loop
from jaxba.solver.methods import METHODS, make_method
from jaxba.solver.options import SolveOptions
from jaxba.solver.prepare import Prepared, prepare
from jaxba.solver.solve import Solution, solve
from jaxba.structure.layout import Layout, build_layout
from jaxba.typing import register_pytree

if TYPE_CHECKING:
    from jaxba import residuals
    from jaxba.constraints.file import survey
    from jaxba.io.reconstruction import from_pycolmap
    from jaxba.results.alternation import solve_and_retriangulate
    from jaxba.results.bundle_adjustment import (
        bundle_adjustment,
        create_default_bundle_adjuster,
        create_pose_prior_bundle_adjuster,
    )
    from jaxba.results.covariance import Covariance, covariance
    from jaxba.results.derivatives import SolveInputs, differentiable_solve, inputs_of
    from jaxba.results.graduated import solve_graduated
    from jaxba.results.retriangulate import Retriangulation, retriangulate
    from jaxba.runtime.program_cache import keep_programs
    from jaxba.solver.many import solve_many
    from jaxba.solver.prepared_programs import prepare_programs
    from jaxba.solver.recipes import solve_recipes
    from jaxba.training.api import make_env, train
    from jaxba.viewer.notebook import view

if _collects:
    gc.enable()

register_game()

__version__ = "0.1.0"

_LATE = {
    "results.alternation": ("solve_and_retriangulate",),
    "constraints.file": ("survey",),
    "io.reconstruction": ("from_pycolmap",),
    "results.bundle_adjustment": (
        "bundle_adjustment",
        "create_default_bundle_adjuster",
        "create_pose_prior_bundle_adjuster",
    ),
    "results.covariance": ("Covariance", "covariance"),
    "results.derivatives": ("SolveInputs", "differentiable_solve", "inputs_of"),
    "results.graduated": ("solve_graduated",),
    "results.retriangulate": ("Retriangulation", "retriangulate"),
    "runtime.program_cache": ("keep_programs",),
    "solver.many": ("solve_many",),
    "solver.prepared_programs": ("prepare_programs",),
    "solver.recipes": ("solve_recipes",),
    "training.api": ("make_env", "train"),
    "viewer.notebook": ("view",),
}
"""Public names that most solves do without, by module; they are loaded when they are first asked
for."""


def __getattr__(name: str) -> Any:
    if name == "residuals":
        return importlib.import_module("jaxba.residuals")
    for module, names in _LATE.items():
        if name in names:
            return getattr(importlib.import_module(f"jaxba.{module}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


__all__ = [
    "CAMERA_MODELS",
    "METHODS",
    "POLICIES",
    "AgentConfig",
    "BundleProblem",
    "CameraModel",
    "Carry",
    "Ceres",
    "Classic",
    "ConjugateGradients",
    "Constants",
    "Coordinates",
    "Covariance",
    "DampingPolicy",
    "Geometric",
    "IterationRecord",
    "LMState",
    "Layout",
    "LearnedPolicy",
    "Lenses",
    "Loss",
    "Prepared",
    "ProblemError",
    "ProblemInfo",
    "ProblemWarning",
    "Refinement",
    "Retriangulation",
    "Rigs",
    "SceneConfig",
    "Schedule",
    "Solution",
    "SolveInputs",
    "SolveOptions",
    "StepInfo",
    "StepMethod",
    "StepOptions",
    "Termination",
    "Tolerances",
    "build_layout",
    "bundle_adjustment",
    "covariance",
    "create_default_bundle_adjuster",
    "create_pose_prior_bundle_adjuster",
    "differentiable_solve",
    "example_problem",
    "from_pycolmap",
    "hold",
    "initial_state",
    "inputs_of",
    "keep_programs",
    "lm_step",
    "load_policy",
    "make_env",
    "make_method",
    "make_policy",
    "part",
    "perturb",
    "prepare",
    "prepare_programs",
    "random_scene",
    "random_scene_with_truth",
    "read_bal",
    "read_bundler",
    "read_colmap",
    "read_problem",
    "register_camera_model",
    "register_pytree",
    "release",
    "residual",
    "residuals",
    "retriangulate",
    "save_policy",
    "scene_like",
    "solve",
    "solve_and_retriangulate",
    "solve_graduated",
    "solve_loop",
    "solve_many",
    "solve_recipes",
    "survey",
    "train",
    "trained_step",
    "view",
    "with_gauge",
    "with_lens_priors",
    "with_position_priors",
    "with_residual",
    "with_rotation_priors",
    "write_bal",
    "write_bundler",
    "write_colmap",
    "write_ply",
    "write_problem",
    "write_transforms",
]
