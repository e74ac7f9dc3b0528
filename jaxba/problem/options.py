"""What a step may be asked to do differently; hashable, so that it selects a compiled program."""

from __future__ import annotations

import operator
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

from jaxba.problem.losses import Loss
from jaxba.typing import LARGEST_COUNT

LinearSolver = Literal["explicit", "sparse", "implicit", "power", "normal", "clustered", "decomposed"]
LinearSolverChoice = Literal["auto", "explicit", "sparse", "implicit", "power"]
REDUCED_SOLVERS: tuple[LinearSolver, ...] = ("explicit", "sparse", "implicit")
"""Solvers that give the same step to their tolerance, so that `auto` may choose among them."""

Preconditioner = Literal["two-level", "schur-jacobi", "jacobi", "power-series"]
Scaling = Literal["diagonal", "identity"]
Rotation = Literal["angle-axis", "manifold"]
Algebra = Literal["full", "mixed"]
Intrinsics = Literal["free", "fixed"]
LensStep = Literal["file", "pixels"]
PointStarts = Literal["step", "rays"]

DIAGONAL_MINIMUM = 1e-6
"""Smallest diagonal entry that damping multiplies. Source: Ceres min_lm_diagonal."""

DIAGONAL_MAXIMUM = 1e32
"""Largest diagonal entry that damping multiplies. Source: Ceres max_lm_diagonal."""


@dataclass(frozen=True)
class StepOptions:
    """Static options of `lm_step`. Each distinct value is compiled once."""

    linear_solver: LinearSolver = "explicit"
    """`explicit`: form the reduced camera system and factor it. `sparse`: form its blocks, conjugate gradients.
    `implicit`: conjugate gradients without forming it. `power`: a power series, without forming it. `normal`: conjugate
    gradients on all variables (methods/deeplm.py). `clustered`: clusters of cameras, then repairs (methods/stba.py).
    `decomposed`: clusters that are optimised beside each other (methods/ddlm.py). The last four are methods
    (methods/registry.py)."""

    preconditioner: Preconditioner = "two-level"
    """Of conjugate gradients. `schur-jacobi`: the block diagonal of the reduced system. `two-level`: the same and a
    coarse system for the motion of clusters of cameras. `jacobi`: the camera blocks. `power-series`: a short series."""

    preconditioner_order: int = 5
    """Terms of a power series as preconditioner. Source: Ceres max_num_spse_iterations."""

    power_order: int = 20
    """Terms of a power series as solver. Source: Weber et al. 2023, section 5 (order 20)."""

    cluster_cameras: int = 100
    """Cameras of a cluster at most. Source: STBA, authors' code."""

    repairs: int = 4
    """Richardson steps that repair a clustered step. Source: STBA, authors' code."""

    remembered_steps: int = 0
    """Camera steps of earlier iterations in whose span that of a power series, or of conjugate gradients on all
    variables, is made the best one (methods/subspace.py). Other solvers were found to have no use for them."""

    block_steps: int = 1
    """Steps of each cluster in a round of domain decomposition; one, so that a round is one linear solve."""

    scaling: Scaling = "diagonal"
    """What lambda multiplies: `diagonal` the clamped diagonal of the Hessian (Ceres), `identity` the unit
    matrix (the paper's equation)."""

    camera_damping: float = 1.0
    """Damping of the cameras relative to that of the points, a factor on lambda. 1 is Levenberg-Marquardt as published.
    Small ones leave it to the points to hold a step back (docs/game-tried.md, "Cameras and points")."""

    rotation: Rotation = "angle-axis"
    """Coordinates of a rotation step: `angle-axis` adds to the three numbers of the file, as Ceres does with
    BAL cameras; `manifold` multiplies by exp(step). They differ in what diagonal damping damps."""

    lens_step: LensStep = "file"
    """Coordinates in which a lens step is added: `file` adds to f, k1 and k2, as Ceres does with a BAL camera; `pixels`
    to f and the distortion per pixel, which a zoom leaves alone
    (refinement/retraction.py). They agree to first order."""

    refine_points: int = 0
    """Embedded point iterations after each camera step."""

    point_starts: PointStarts = "step"
    """Where embedded point iterations start: where the `step` took a point, or from the `rays` of its pixels, if that
    is cheaper; at last from both (refinement/midpoints.py)."""

    trials: int = 1
    """How often a step is tried before it is rejected, each time a quarter as long; see `refinement/trial.py`."""

    camera_rounds: int = 0
    """Rounds in which first every camera, then every point is re-optimised alone, where a step did much less than the
    linear model promised; one at most for a shortened candidate; see `refinement/trial.py`."""

    pattern_moves: int = 0
    """How often at most the way of an accepted step is repeated, each time twice as far, where the linear model did not
    foresee what it did; see `refinement/trial.py`."""

    intrinsics: Intrinsics = "free"
    """Whether focal lengths and distortions are optimised, as in BAL, or stay: the seed paper optimises poses and
    points. `fixed` works with the explicit solver."""

    loss: Loss = field(default_factory=Loss)
    """Robust loss of the squared whitened residual."""

    algebra: Algebra = "full"
    """`full`: everything in the type of the parameters. `mixed`: residuals, gradient and elimination of the points in
    it, the reduced camera system in float32; a factorisation is then the preconditioner of conjugate gradients in full
    precision, which repair what rounding lost."""

    cg_forcing: float = 0.1
    """Conjugate gradients stop when i (Q_i - Q_(i-1)) / Q_i falls below this. Source: Ceres' default."""

    cg_tolerance: float = 0.0
    """... or when the residual is below this share of the right-hand side; 0 switches it off."""

    cg_max_iterations: int = 500
    """... or after this many iterations. Source: Ceres max_linear_solver_iterations."""

    def __post_init__(self) -> None:
        for name, known in (
            ("linear_solver", get_args(LinearSolver)),
            ("preconditioner", get_args(Preconditioner)),
            ("scaling", get_args(Scaling)),
            ("rotation", get_args(Rotation)),
            ("algebra", get_args(Algebra)),
            ("intrinsics", get_args(Intrinsics)),
            ("lens_step", get_args(LensStep)),
            ("point_starts", get_args(PointStarts)),
        ):
            if getattr(self, name) not in known:
                raise ValueError(f"{name} must be one of {', '.join(known)}, not {getattr(self, name)!r}")
        for name, least in (("refine_points", 0), ("camera_rounds", 0), ("pattern_moves", 0), ("trials", 1)):
            check_count(name, getattr(self, name), least)
        for name in ("cluster_cameras", "block_steps"):
            check_count(name, getattr(self, name), 1)
        for name in ("preconditioner_order", "power_order", "repairs", "remembered_steps"):
            check_count(name, getattr(self, name), 0)
        if not 0 < self.camera_damping < float("inf"):
            raise ValueError(f"camera_damping must be positive and finite, is {self.camera_damping}")
        if self.intrinsics == "fixed" and self.linear_solver != "explicit":
            raise ValueError(f"fixed intrinsics need the explicit solver, not {self.linear_solver}")
        check_count("cg_max_iterations", self.cg_max_iterations, 1)
        for name in ("cg_forcing", "cg_tolerance"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name} must not be negative, is {getattr(self, name)}")

    @property
    def forms_reduced_system(self) -> bool:
        """Whether the layout must list pairs."""
        return self.linear_solver in ("explicit", "sparse") or self.uses_partitions

    @property
    def uses_partitions(self) -> bool:
        """Whether the layout must draw random clusters of cameras."""
        return self.linear_solver in ("clustered", "decomposed")

    @property
    def inexact(self) -> bool:
        """Whether conjugate gradients end by a forcing term (inexact Newton)."""
        return self.linear_solver in ("sparse", "implicit", "normal")

    @property
    def factors(self) -> bool:
        """Whether linear systems are factored, not iterated upon."""
        return self.linear_solver in ("explicit", "clustered", "decomposed")

    @property
    def in_two(self) -> bool:
        """Whether a step is one linear solve and then the verdict on it, not a round of many."""
        return self.linear_solver != "decomposed"

    @property
    def leaves_rest(self) -> bool:
        """Whether a step leaves a residual of the linear system that is not orthogonal to it."""
        return self.linear_solver in ("clustered", "power")

    @property
    def remembers(self) -> int:
        """How many earlier camera steps take part in a step."""
        return self.remembered_steps if self.linear_solver in ("power", "normal") else 0

    @property
    def uses_clusters(self) -> bool:
        """Whether the layout must group cameras."""
        return self.linear_solver in ("sparse", "implicit") and self.preconditioner == "two-level"


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
