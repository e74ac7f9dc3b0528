"""Options of a solve with their defaults, the same for Python and for the command `jaxba-solve`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from difflib import get_close_matches
from typing import Any, Literal

from jaxba.damping import DampingPolicy
from jaxba.damping.policy import trained_step
from jaxba.lm.method import StepMethod, check_plain
from jaxba.lm.termination import Tolerances
from jaxba.problem.checks import real_number, shown
from jaxba.problem.losses import Loss
from jaxba.problem.options import (
    ConjugateGradients,
    Coordinates,
    Intrinsics,
    LinearSolverChoice,
    Refinement,
    StepOptions,
    check_count,
    check_known,
    check_limit,
)
from jaxba.runtime.compilation import Compilation
from jaxba.solver.methods import DEFAULT_METHOD, make_method

MAX_ITERATIONS = 100
"""Limit of iterations. Source: the experiments of the paper on learned damping, where a solve that
takes more has failed."""

Dtype = Literal["float64", "float32", "mixed"]

_CHOICES = {
    "dtype": Dtype,
    "linear_solver": LinearSolverChoice,
    "intrinsics": Intrinsics,
    "compilation": Compilation,
}
"""Options that are one of a few words."""

_GROUPS = {
    "conjugate_gradients": ConjugateGradients,
    "refinement": Refinement,
    "coordinates": Coordinates,
    "loss": Loss,
    "tolerances": Tolerances,
}
"""Options that are a group of options."""


def refuse_keywords(function: str, keywords: Mapping[str, object]) -> None:
    """Raises a TypeError that says where options belong, if a function was given some as keywords.

    Args:
        function: name of the function.
        keywords: its keyword arguments that it does not have, by name."""
    if not keywords:
        return
    name = next(iter(keywords))
    in_groups = {
        option: f"{group}=jaxba.{kind.__name__}({option}=...)"
        for group, kind in _GROUPS.items()
        for option in _names_of(kind)
    }
    known = in_groups | {option.name: f"{option.name}=..." for option in fields(SolveOptions)}
    if name in known:
        raise TypeError(
            f"{function}() takes {name} in its options: options=jaxba.SolveOptions({known[name]})"
        )
    similar = get_close_matches(name, known, 1)
    meant = f"; did you mean options=jaxba.SolveOptions({known[similar[0]]})?" if similar else ""
    raise TypeError(f"{function}() has no argument {name}{meant}")


def _names_of(group: type[Any]) -> tuple[str, ...]:
    """Names of the options of a group, a dataclass or a named tuple."""
    if is_dataclass(group):
        return tuple(part.name for part in fields(group))
    return group._fields


@dataclass(frozen=True)
class SolveOptions:
    """Options of `solve`. The command `jaxba-solve` has the same defaults, and an option for most
    of these."""

    method: str | StepMethod = DEFAULT_METHOD
    """Method that computes the step: an entry of `jaxba.METHODS` or its name."""

    linear_solver: LinearSolverChoice = "auto"
    """Solver of the reduced camera system in plain LM; other methods have their own. `auto` chooses
    by predicted time (choose.py)."""

    conjugate_gradients: ConjugateGradients = field(default_factory=ConjugateGradients)
    """Conjugate gradients of the linear solvers `sparse` and `implicit`."""

    refinement: Refinement | None = None
    """Improvements of a step without another linear solve. None: those a learned policy was trained
    with; none for a rule."""

    coordinates: Coordinates | None = None
    """Coordinates of a step and of its damping. None: those a learned policy was trained with;
    those of Ceres for a rule. A group that is given counts as a whole: to change one of its fields,
    use `dataclasses.replace(jaxba.trained_step(policy).coordinates, ...)`."""

    intrinsics: Intrinsics = "free"
    """Whether f, k1 and k2 are optimised (`free`) or `fixed`."""

    loss: Loss = field(default_factory=Loss)
    """Robust loss."""

    tolerances: Tolerances = field(default_factory=Tolerances)
    """Convergence tests, and the limit of time."""

    within: float = 0.0
    """Estimated relative distance to the end that is near enough, `Tolerances.within`; 0: no such
    test."""

    max_iterations: int = MAX_ITERATIONS
    """Limit of linear solves; with 0 the cost of the start is computed, and the problem comes back
    as it is."""

    dtype: Dtype = "float64"
    """`float64` or `float32`, the type of all arithmetic; `mixed` is float64 with the reduced
    camera system in float32."""

    pad: bool | None = None
    """Whether array sizes are rounded up to a grid, so that problems of about the same size share
    one compiled program, also in a persistent compilation cache. Results differ by rounding only,
    iterations take 1.1 to 1.6 times as long. None: for at most 64 cameras and 60,000 observations,
    unless compilation is `full`. Padding is for the explicit solver, which `auto` then means; with
    other solvers, with rigs or other residuals, and for larger problems nothing is padded, and
    `Solution.capacity` is None."""

    compilation: Compilation = "auto"
    """Optimisation level of compilation. `full`: fully optimised; for many solves of one shape, and
    for timing of iterations. `quick`: compiles in a third of the time, and iterations take two to
    six times as long. `auto`: shortest time to the end of a single solve; starts with quick
    programs, or for more observations with programs that compile in half of the time and are nearly
    as fast, and replaces them by optimised ones when that pays. Results differ by rounding. On a
    GPU all are `full`."""

    devices: int | None = None
    """Number of devices, in each process, among which points are divided; None: one, or with
    several processes all. A CPU can be several before anything is computed with JAX. For plain LM;
    nothing is padded, compilation is `full`."""

    def __post_init__(self) -> None:
        for name, kind in _GROUPS.items():
            value = getattr(self, name)
            if not isinstance(value, kind) and not (
                value is None and name in ("refinement", "coordinates")
            ):
                raise ValueError(
                    f"{name} must be made with jaxba.{kind.__name__}, is {shown(value)}"
                )
        if isinstance(self.method, str):
            make_method(self.method)
        elif not isinstance(self.method, StepMethod):
            raise ValueError(
                f"method must be an entry of jaxba.METHODS or its name, is {shown(self.method)}"
            )
        for name, known in _CHOICES.items():
            check_known(name, getattr(self, name), known)
        check_count("max_iterations", self.max_iterations, 0)
        if real_number("within", self.within):
            object.__setattr__(self, "tolerances", self.tolerances._replace(within=self.within))
        if self.devices is not None:
            check_count("devices", self.devices, 1)
        tests = self.tolerances._asdict()
        check_limit("seconds", tests.pop("seconds"))
        for name, value in tests.items():
            if not real_number(name, value) >= 0:
                raise ValueError(f"{name} must not be negative, is {value}")

    def step_options(self, policy: DampingPolicy) -> StepOptions:
        """The step options for a policy. The linear solver `auto` is replaced by `explicit`, to be
        chosen later. Raises ValueError: options that exclude each other, or an unknown method."""
        trained = trained_step(policy)
        method = make_method(self.method) if isinstance(self.method, str) else self.method
        step = method.options(
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
        scaling = step.coordinates.scaling
        if (
            getattr(policy, "step_options", None) is not None
            and scaling != trained.coordinates.scaling
        ):
            own = trained.coordinates.scaling
            this = "this policy takes lambda as a factor on the diagonal"
            raise ValueError(f"scaling must be {own!r}: {this}, not with scaling {scaling!r}")
        check_plain(step, mixed=step.mixed_precision, linear_solver=self.linear_solver != "auto")
        return step


def checked_options(options: SolveOptions | None) -> SolveOptions:
    """The options, or the defaults for None. Raises ValueError: they are something else, such as
    the name of a policy."""
    if options is None:
        return SolveOptions()
    if not isinstance(options, SolveOptions):
        raise ValueError(f"options must be made with jaxba.SolveOptions, are {shown(options)}")
    return options
