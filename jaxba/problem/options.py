"""Options of an iteration: linear solver, refinement, coordinates and loss.

All options are static and hashable: each distinct value compiles a program of its own."""

from __future__ import annotations

import operator
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

from jaxba.problem.checks import real_number, shown
from jaxba.problem.losses import Loss
from jaxba.typing import LARGEST_COUNT

LinearSolver = Literal["explicit", "sparse", "implicit", "cg"]
LinearSolverChoice = Literal["auto", "explicit", "sparse", "implicit", "cg"]
Preconditioner = Literal["two-level", "schur-jacobi", "jacobi"]
Scaling = Literal["diagonal", "identity"]
Rotation = Literal["angle-axis", "manifold"]
Intrinsics = Literal["free", "fixed"]
LensStep = Literal["file", "pixels"]
PointStarts = Literal["step", "rays"]

# smallest diagonal entry that damping multiplies. Source: Ceres min_lm_diagonal
DIAGONAL_MINIMUM = 1e-6
# largest diagonal entry that damping multiplies. Source: Ceres max_lm_diagonal
DIAGONAL_MAXIMUM = 1e32


@dataclass(frozen=True)
class ConjugateGradients:
    """Preconditioner and stopping rule of conjugate gradients."""

    preconditioner: Preconditioner = "two-level"
    """`schur-jacobi`: the block diagonal of the reduced camera system. `two-level`: the same, with
    a coarse correction for the motion of clusters of cameras. `jacobi`: the camera blocks of the
    normal equations."""

    forcing: float = 0.1
    """Stop when `i (Q_i - Q_(i-1)) / Q_i` falls below this, for the quadratic model Q after
    iteration i. Source: Ceres' default."""

    tolerance: float = 0.0
    """Stop when the residual is below this fraction of the right-hand side; 0 switches it off."""

    max_iterations: int = 500
    """Stop after this many iterations. Source: Ceres max_linear_solver_iterations."""

    budget: int = 12
    """Iterations of the solver `cg`, which makes no fewer unless rounding ends them. Twelve is what
    the rule of the others takes with the two-level preconditioner: 6 to 20 on real problems."""

    def __post_init__(self) -> None:
        check_known("preconditioner", self.preconditioner, Preconditioner)
        check_count("max_iterations", self.max_iterations, 1)
        check_count("budget", self.budget, 1)
        for name in ("forcing", "tolerance"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name} must not be negative, is {getattr(self, name)}")


@dataclass(frozen=True)
class Refinement:
    """Improvements of a step without another linear solve (`jaxba/refinement`). The default is
    none: plain LM."""

    points: int = 0
    """Number of embedded point iterations for each candidate; 0 for none."""

    starts: PointStarts = "step"
    """Start of embedded point iterations: `step`: the position after the step; `rays`: the midpoint
    of the rays of its pixels if the cost is lower there, and both near convergence."""

    trials: int = 1
    """Number of backtracking trials before a step is rejected; each is a quarter as long as the one
    before."""

    camera_rounds: int = 0
    """Most rounds in which every camera, then every point is re-optimised on its own, after a step
    that achieved much less than the predicted decrease; at most one for a backtracked candidate."""

    pattern_moves: int = 0
    """Most repetitions of an accepted step in its direction, each twice as far, if the linear model
    did not predict its decrease or damping limited its length."""

    def __post_init__(self) -> None:
        for name, least in (
            ("points", 0),
            ("camera_rounds", 0),
            ("pattern_moves", 0),
            ("trials", 1),
        ):
            check_count(name, getattr(self, name), least)
        check_known("starts", self.starts, PointStarts)


@dataclass(frozen=True)
class Coordinates:
    """Coordinates of a step, and the damping matrix D in them."""

    scaling: Scaling = "diagonal"
    """Damping matrix: `diagonal`: `lambda diag(H)` with a clamped diagonal (Ceres); `identity`:
    `lambda I` (the paper on learned damping)."""

    rotation: Rotation = "angle-axis"
    """Coordinates of a rotation step: `angle-axis`: addition to the angle-axis vector, as Ceres
    does with BAL cameras; `manifold`: `R <- exp(step) R`. Diagonal damping differs between them."""

    lens_step: LensStep = "file"
    """Coordinates in which a step of the intrinsics is added: `file`: f, k1 and k2, as Ceres does
    with BAL cameras; `pixels`: f and the distortion per pixel, `k1 / f^2` and `k2 / f^4`. They
    agree to first order."""

    def __post_init__(self) -> None:
        for name, known in (("scaling", Scaling), ("rotation", Rotation), ("lens_step", LensStep)):
            check_known(name, getattr(self, name), known)


class MethodTraits:
    """What layout and compilation know of a method that computes the step
    (`lm.method.StepMethod`)."""

    name: str
    """Name in commands, tables and files."""

    forms_reduced_system: bool = False
    """Whether it forms the reduced camera system, so that the layout must list pairs of
    observations."""

    cluster_cameras: int | None = None
    """Largest number of cameras in a random cluster; None for a method without clusters."""

    conjugate_gradients: ConjugateGradients | None = None
    """Stopping rule if it solves by truncated conjugate gradients, else None."""


@dataclass(frozen=True)
class StepOptions:
    """Static options of `lm_step`. Each distinct value compiles a program of its own."""

    linear_solver: LinearSolver = "explicit"
    """Solver of the reduced camera system. `explicit`: form and factor it. `sparse`: form its
    blocks, then conjugate gradients. `implicit`: conjugate gradients without forming it. `cg`: the
    same by `jax.scipy.sparse.linalg.cg`, with a fixed number of iterations. Ignored by methods,
    which have their own."""

    method: MethodTraits | None = None
    """Method that replaces the plain Levenberg-Marquardt step, an entry of `jaxba.METHODS`; None:
    plain LM."""

    conjugate_gradients: ConjugateGradients = field(default_factory=ConjugateGradients)
    """Conjugate gradients of the solvers `sparse`, `implicit` and `cg`."""

    refinement: Refinement = field(default_factory=Refinement)
    """Improvements of the step without another linear solve."""

    coordinates: Coordinates = field(default_factory=Coordinates)
    """Coordinates of the step and of its damping."""

    intrinsics: Intrinsics = "free"
    """Whether intrinsics are optimised, as in BAL, or `fixed`."""

    loss: Loss = field(default_factory=Loss)
    """Robust loss of the squared whitened residual."""

    mixed_precision: bool = False
    """Whether the reduced camera system is float32, with everything else in the type of the
    parameters. A factorisation is then the preconditioner of a few conjugate gradient iterations in
    full precision."""

    def __post_init__(self) -> None:
        check_known("linear_solver", self.linear_solver, LinearSolver)
        check_known("intrinsics", self.intrinsics, Intrinsics)

    @property
    def solver_name(self) -> str:
        """Name of the linear solver, or of the method that replaces it."""
        return self.method.name if self.method else self.linear_solver

    @property
    def factors_reduced_system(self) -> bool:
        """Whether the whole reduced camera system is factored."""
        return not self.method and self.linear_solver == "explicit"

    @property
    def forms_reduced_system(self) -> bool:
        """Whether blocks of the reduced camera system are formed, so that the layout must list
        pairs."""
        if self.method:
            return self.method.forms_reduced_system
        return self.linear_solver in ("explicit", "sparse")

    @property
    def cluster_cameras(self) -> int | None:
        """Largest number of cameras in a random cluster; None if the layout needs no random
        clusters."""
        return self.method.cluster_cameras if self.method else None

    @property
    def truncated(self) -> ConjugateGradients | None:
        """Conjugate gradients that stop by a forcing term (inexact Newton); None if the step does
        not use them."""
        if self.method:
            return self.method.conjugate_gradients
        return None if self.linear_solver == "explicit" else self.conjugate_gradients

    @property
    def uses_camera_clusters(self) -> bool:
        """Whether the layout needs camera clusters, for the two-level preconditioner."""
        exact = self.method or self.linear_solver == "explicit"
        return not exact and self.conjugate_gradients.preconditioner == "two-level"


def check_known(name: str, value: Any, kind: Any) -> None:
    """Raises a ValueError unless a value is one of a `Literal`."""
    if not isinstance(value, str) or value not in get_args(kind):
        raise ValueError(f"{name} must be one of {', '.join(get_args(kind))}, not {shown(value)}")


def check_count(name: str, value: Any, least: int) -> None:
    """Raises ValueError: an option is no integer in [least, `LARGEST_COUNT`]; the message contains
    its name."""
    try:
        count = operator.index(value)
    except TypeError:
        raise ValueError(f"{name} must be a whole number, is {shown(value)}") from None
    if count < least:
        raise ValueError(f"{name} must be at least {least}, is {value}")
    if count > LARGEST_COUNT:
        raise ValueError(f"{name} must be at most {LARGEST_COUNT}, is {value}")


def check_limit(name: str, value: Any) -> None:
    """Raises ValueError: an option is neither None, which is no limit, nor a positive number; one
    line with its name."""
    if value is not None and not real_number(name, value) > 0:
        raise ValueError(f"{name} must be positive, is {value}")


EMBEDDED = Refinement(points=3, starts="rays", trials=4, camera_rounds=3, pattern_moves=1)
"""All embedded iterations, `+embedded` in a solver's name."""
