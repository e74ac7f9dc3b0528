"""How a step is made: static, hashable, so that each distinct value is compiled once."""

from __future__ import annotations

import operator
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol, get_args, runtime_checkable

from jaxba.problem.losses import Loss
from jaxba.typing import LARGEST_COUNT

LinearSolver = Literal["explicit", "sparse", "implicit"]
LinearSolverChoice = Literal["auto", "explicit", "sparse", "implicit"]
Preconditioner = Literal["two-level", "schur-jacobi", "jacobi"]
Scaling = Literal["diagonal", "identity"]
Rotation = Literal["angle-axis", "manifold"]
Intrinsics = Literal["free", "fixed"]
LensStep = Literal["file", "pixels"]
PointStarts = Literal["step", "rays"]

DIAGONAL_MINIMUM = 1e-6
"""Smallest diagonal entry that damping multiplies. Source: Ceres min_lm_diagonal."""

DIAGONAL_MAXIMUM = 1e32
"""Largest diagonal entry that damping multiplies. Source: Ceres max_lm_diagonal."""


@dataclass(frozen=True)
class ConjugateGradients:
    """How conjugate gradients are preconditioned, and when they stop."""

    preconditioner: Preconditioner = "two-level"
    """`schur-jacobi`: the block diagonal of the reduced camera system. `two-level`: the same and a coarse system for
    the motion of clusters of cameras. `jacobi`: the camera blocks."""

    forcing: float = 0.1
    """They stop when i (Q_i - Q_(i-1)) / Q_i falls below this. Source: Ceres' default."""

    tolerance: float = 0.0
    """... or when the residual is below this fraction of the right-hand side; 0 switches it off."""

    max_iterations: int = 500
    """... or after this many iterations. Source: Ceres max_linear_solver_iterations."""

    def __post_init__(self) -> None:
        _check_known("preconditioner", self.preconditioner, Preconditioner)
        check_count("max_iterations", self.max_iterations, 1)
        for name in ("forcing", "tolerance"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name} must not be negative, is {getattr(self, name)}")


@dataclass(frozen=True)
class Refinement:
    """What is done around a linear solve, without another one: `jaxba/refinement`. The default is a plain step."""

    points: int = 0
    """Embedded point iterations after each camera step."""

    starts: PointStarts = "step"
    """Where embedded point iterations start: where the `step` took a point, or from the `rays` of its pixels, if that
    is cheaper; near convergence from both."""

    trials: int = 1
    """How often a step is tried before it is rejected, each time a quarter as long."""

    camera_rounds: int = 0
    """Rounds in which first every camera, then every point is re-optimised alone, where a step did much less than the
    linear model promised; one at most for a shortened candidate."""

    pattern_moves: int = 0
    """How often at most an accepted step is repeated in its direction, each time twice as far, where the linear model
    did not foresee what it did."""

    previous_steps: int = 0
    """Camera steps of earlier iterations in whose span an inexact step is made the best one, by methods that have a use
    for them (`MethodTraits.uses_previous_steps`)."""

    def __post_init__(self) -> None:
        for name, least in (
            ("points", 0),
            ("camera_rounds", 0),
            ("pattern_moves", 0),
            ("previous_steps", 0),
            ("trials", 1),
        ):
            check_count(name, getattr(self, name), least)
        _check_known("starts", self.starts, PointStarts)


@dataclass(frozen=True)
class Coordinates:
    """Coordinates of a step, and what lambda multiplies in them."""

    scaling: Scaling = "diagonal"
    """What lambda multiplies: `diagonal` the clamped diagonal of the Hessian (Ceres), `identity` the unit
    matrix (the paper's equation)."""

    camera_damping: float = 1.0
    """Damping of the cameras relative to that of the points, a factor on lambda. 1 is Levenberg-Marquardt as published;
    with small ones it is mostly the points that hold a step back."""

    rotation: Rotation = "angle-axis"
    """Coordinates of a rotation step: `angle-axis` adds to the three numbers of the file, as Ceres does with
    BAL cameras; `manifold` multiplies by exp(step). They differ in what diagonal damping damps."""

    lens_step: LensStep = "file"
    """Coordinates in which a step of the intrinsics is added: `file` adds to f, k1 and k2, as Ceres does with a BAL
    camera; `pixels` to f and the distortion per pixel, which a zoom leaves alone. They agree to first order."""

    def __post_init__(self) -> None:
        for name, known in (("scaling", Scaling), ("rotation", Rotation), ("lens_step", LensStep)):
            _check_known(name, getattr(self, name), known)
        if not 0 < self.camera_damping < float("inf"):
            raise ValueError(f"camera_damping must be positive and finite, is {self.camera_damping}")


@runtime_checkable
class MethodTraits(Protocol):
    """What the layout and the compilation must know of a method that replaces the plain step (`jaxba.methods`)."""

    @property
    def name(self) -> str:
        """As in `jaxba.METHODS`."""
        ...

    @property
    def forms_reduced_system(self) -> bool:
        """Whether the layout must list pairs of observations."""
        ...

    @property
    def cluster_cameras(self) -> int | None:
        """Most cameras of a random cluster; None for a method without clusters."""
        ...

    @property
    def conjugate_gradients(self) -> ConjugateGradients | None:
        """Its own, if it solves by truncated conjugate gradients."""
        ...

    @property
    def single_solve(self) -> bool:
        """Whether a step is one linear solve and then one decision, not a round of several."""
        ...

    @property
    def uses_previous_steps(self) -> bool:
        """Whether earlier camera steps can take part in a step."""
        ...


@dataclass(frozen=True)
class StepOptions:
    """Static options of `lm_step`. Each distinct value is compiled once."""

    linear_solver: LinearSolver = "explicit"
    """Of the reduced camera system. `explicit`: form it and factor it. `sparse`: form its blocks, conjugate gradients.
    `implicit`: conjugate gradients without forming it. A method has its own."""

    method: MethodTraits | None = None
    """What replaces the plain Levenberg-Marquardt step, an entry of `jaxba.METHODS`; None: nothing."""

    conjugate_gradients: ConjugateGradients = field(default_factory=ConjugateGradients)
    """Of the solvers `sparse` and `implicit`."""

    refinement: Refinement = field(default_factory=Refinement)
    """What is done around the linear solve."""

    coordinates: Coordinates = field(default_factory=Coordinates)
    """Of the step."""

    intrinsics: Intrinsics = "free"
    """Whether focal lengths and distortions are optimised, as in BAL, or stay: the paper optimises poses and points.
    `fixed` needs the explicit solver."""

    loss: Loss = field(default_factory=Loss)
    """Robust loss of the squared whitened residual."""

    mixed_precision: bool = False
    """Whether the reduced camera system is float32 where all else is in the type of the parameters. A factorisation is
    then the preconditioner of conjugate gradients in full precision, which make good what rounding lost."""

    def __post_init__(self) -> None:
        _check_known("linear_solver", self.linear_solver, LinearSolver)
        _check_known("intrinsics", self.intrinsics, Intrinsics)
        if self.intrinsics == "fixed" and (self.method is not None or self.linear_solver != "explicit"):
            raise ValueError(f"intrinsics 'fixed' need the explicit solver, not {self.solver_name}")

    @property
    def solver_name(self) -> str:
        """How the linear system is solved: the linear solver, or the method in its place."""
        return self.linear_solver if self.method is None else self.method.name

    @property
    def factors_reduced_system(self) -> bool:
        """Whether the reduced camera system as a whole is factored."""
        return self.method is None and self.linear_solver == "explicit"

    @property
    def forms_reduced_system(self) -> bool:
        """Whether the layout must list pairs."""
        if self.method is not None:
            return self.method.forms_reduced_system
        return self.linear_solver in ("explicit", "sparse")

    @property
    def cluster_cameras(self) -> int | None:
        """Most cameras of a random cluster; None where the layout draws none."""
        return None if self.method is None else self.method.cluster_cameras

    @property
    def truncated(self) -> ConjugateGradients | None:
        """Conjugate gradients that end by a forcing term (inexact Newton); None where a step is not made by them."""
        if self.method is not None:
            return self.method.conjugate_gradients
        return None if self.linear_solver == "explicit" else self.conjugate_gradients

    @property
    def single_solve(self) -> bool:
        """Whether a step is one linear solve and then one decision, not a round of several."""
        return self.method is None or self.method.single_solve

    @property
    def kept_steps(self) -> int:
        """How many earlier camera steps take part in a step."""
        return self.refinement.previous_steps if self.method is not None and self.method.uses_previous_steps else 0

    @property
    def uses_camera_clusters(self) -> bool:
        """Whether the layout must group cameras for the two-level preconditioner."""
        truncated = self.truncated if self.method is None else None
        return truncated is not None and truncated.preconditioner == "two-level"


def _check_known(name: str, value: str, kind: Any) -> None:
    if value not in get_args(kind):
        raise ValueError(f"{name} must be one of {', '.join(get_args(kind))}, not {value!r}")


def check_count(name: str, value: Any, least: int) -> None:
    """Refuses what is no whole number, or one that programs cannot hold.

    Raises:
        ValueError: naming it.
    """
    try:
        count = operator.index(value)
    except TypeError:
        raise ValueError(f"{name} must be a whole number, is {value!r}") from None
    if count < least:
        raise ValueError(f"{name} must be at least {least}, is {value}")
    if count > LARGEST_COUNT:
        raise ValueError(f"{name} must be at most {LARGEST_COUNT}, is {value}")
