"""What a caller may ask of a solve: the one table of defaults, for Python and for the command."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal, get_args

from jaxba.damping import DampingPolicy
from jaxba.damping.policy import trained_step
from jaxba.lm.termination import Tolerances
from jaxba.methods.registry import DEFAULT_METHOD, Method, make_method
from jaxba.problem.losses import Loss
from jaxba.problem.options import (
    ConjugateGradients,
    Coordinates,
    Intrinsics,
    LinearSolverChoice,
    Refinement,
    StepOptions,
    check_count,
)
from jaxba.runtime.compilation import Compilation

MAX_ITERATIONS = 100
"""Iterations after which a solve has failed. Source: the paper."""

Dtype = Literal["float64", "float32", "mixed"]


@dataclass(frozen=True)
class SolveOptions:
    """Options of `solve`; `jaxba-solve` has the same ones, with the same defaults."""

    method: str | Method = DEFAULT_METHOD
    """How a step is made: an entry of `jaxba.METHODS` or its name."""

    linear_solver: LinearSolverChoice = "auto"
    """Of the reduced camera system in plain LM; a method has its own.
    `auto` chooses by a cost model (cost_model.py)."""

    conjugate_gradients: ConjugateGradients = field(default_factory=ConjugateGradients)
    """Of the linear solvers `sparse` and `implicit`."""

    refinement: Refinement | None = None
    """What is done around a linear solve. None: what a learned policy was trained with; nothing under a rule."""

    coordinates: Coordinates | None = None
    """Coordinates of a step and of its damping. None: those that a learned policy was trained with; Ceres' under a
    rule."""

    intrinsics: Intrinsics = "free"
    """Whether focal lengths and distortions are optimised or stay."""

    loss: Loss = field(default_factory=Loss)
    """Robust loss."""

    tolerances: Tolerances = field(default_factory=Tolerances)
    """Convergence tests."""

    max_iterations: int = MAX_ITERATIONS
    """Limit of linear solves."""

    dtype: Dtype = "float64"
    """`float64` or `float32`, the type of all arithmetic; `mixed` is float64 with the reduced camera system in
    float32."""

    pad: bool = False
    """Rounds sizes up to a coarse grid, so that similar problems share one compiled program, also through a persistent
    compilation cache; results differ by rounding alone. For many small problems with the explicit solver, which `auto`
    then means. Other solvers and larger problems are left as they are: `Solution.capacity` is None then."""

    compilation: Compilation = "auto"
    """`full`: all optimisation, for many solves of a shape and for whoever takes the time of iterations. `quick`:
    compiled in a third of the time, iterations take two to six times as long. `auto`: quick or, with more observations,
    in half of the time and nearly as fast, and optimised after as many iterations as pay for it; the end of one solve
    comes soonest. They differ by rounding. On a GPU all are `full`."""

    def __post_init__(self) -> None:
        for name, known in (("dtype", Dtype), ("linear_solver", LinearSolverChoice), ("compilation", Compilation)):
            if getattr(self, name) not in get_args(known):
                raise ValueError(f"{name} must be one of {', '.join(get_args(known))}, not {getattr(self, name)!r}")
        check_count("max_iterations", self.max_iterations, 1)
        for name, value in self.tolerances._asdict().items():
            if not value >= 0:
                raise ValueError(f"{name} must not be negative, is {value}")

    def step_options(self, policy: DampingPolicy) -> StepOptions:
        """The step that is asked for under a policy; the linear solver `auto` is the explicit one.

        Raises:
            ValueError, UnknownMethodError: options that do not go together, or no such method.
        """
        trained = trained_step(policy)
        method = make_method(self.method) if isinstance(self.method, str) else self.method
        return method.options(
            StepOptions(
                linear_solver="explicit" if self.linear_solver == "auto" else self.linear_solver,
                conjugate_gradients=self.conjugate_gradients,
                refinement=trained.refinement if self.refinement is None else self.refinement,
                coordinates=trained.coordinates if self.coordinates is None else self.coordinates,
                intrinsics=self.intrinsics,
                loss=self.loss,
                mixed_precision=self.dtype == "mixed",
            )
        )
