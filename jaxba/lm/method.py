"""The interface of methods, each a way to compute the step of an iteration, and plain
Levenberg-Marquardt.

`lm_step` calls `StepMethod.solve`. A method is a frozen dataclass, so that it can be a field of the
static `StepOptions`; its other properties are attributes of the class. `solver/methods.py` finds
methods by name."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import NamedTuple, cast

from jax import Array
from jaxtyping import Float, Int

from jaxba.linear.reduced_system import solve_reduced
from jaxba.linear.schur import DampedSystem
from jaxba.problem.options import MethodTraits, StepOptions


class MethodStep(NamedTuple):
    """The step that a method proposes."""

    cameras: Float[Array, "cameras width"]  # manifold coordinates
    points: Float[Array, "3 points"] | None  # None: computed from the cameras by back-substitution
    iterations: Int[Array, ""]  # inner iterations, e.g. of conjugate gradients
    residual_orthogonal: bool  # whether the residual of the damped system is orthogonal to the step


class StepMethod(MethodTraits, ABC):
    """A way to compute the step of an iteration."""

    rule: str = "ceres"
    """Name of the damping rule that the method was published with."""

    def options(self, base: StepOptions) -> StepOptions:
        """Step options for this method, which keep everything of `base` that the method does not
        decide."""
        return replace(base, method=self)

    @abstractmethod
    def solve(self, system: DampedSystem, options: StepOptions) -> MethodStep:
        """The camera step of the damped system, and the point step if the method has it; the
        options are static."""


@dataclass(frozen=True)
class LevenbergMarquardt(StepMethod):
    """The method `lm`, which options without a method mean."""

    name = "lm"

    def options(self, base: StepOptions) -> StepOptions:
        """See `StepMethod`."""
        return replace(base, method=None)

    def solve(self, system: DampedSystem, options: StepOptions) -> MethodStep:
        """See `StepMethod`."""
        step, iterations = solve_reduced(system, options)
        return MethodStep(step, None, iterations, residual_orthogonal=True)


PLAIN = LevenbergMarquardt()


def method_of(options: StepOptions) -> StepMethod:
    """The method of step options."""
    return cast(StepMethod, options.method or PLAIN)


def check_plain(options: StepOptions, error: type[ValueError] = ValueError, **asked: bool) -> None:
    """Refuses what only plain LM has, by an error of this kind; `asked` says which keys of
    `PLAIN_ONLY` there are."""
    for what, wanted in asked.items():
        if wanted and options.method:
            raise error(PLAIN_ONLY[what].format(options.solver_name))


# what only plain LM has, with the message of its refusal for the name of another method
PLAIN_ONLY = {
    "rigs": "rigs need plain LM, not {}",
    "shared_lenses": "shared lenses need plain LM, not {}",
    "residuals": "priors and residuals of your own need plain LM, not {}",
    "devices": "several devices are for plain LM, not for {}",
    "mixed": "mixed types are for plain LM; methods have float64 or float32",
    "linear_solver": "linear_solver is for method lm; {} has its own",
}
