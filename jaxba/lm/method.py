"""The interface of methods that replace the plain Levenberg-Marquardt step (STBA, DeepLM, PoBA).

`lm_step` calls `StepMethod.solve`. `jaxba.methods.registry` lists the implementations. A method is a frozen dataclass,
so that it can be a field of the static `StepOptions`.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol, runtime_checkable

from jax import Array
from jaxtyping import Float, Int

from jaxba.linear.schur import CameraSystem, PointSystem
from jaxba.model.linearize import Linearization
from jaxba.problem.options import MethodTraits, StepOptions
from jaxba.structure.layout import Layout


class DampedSystem(NamedTuple):
    """The damped normal equations `(H + D) d = -g` of one iteration, points eliminated."""

    layout: Layout
    """The problem's observations."""

    linear: Linearization
    """Residuals and Jacobians."""

    points: PointSystem
    """The eliminated points."""

    cameras: CameraSystem
    """Blocks, gradient and right-hand side of the cameras."""

    damping: Float[Array, ""]
    """Lambda."""

    parameters: Float[Array, "parameters cameras"]
    """Current cameras."""

    iteration: int | Int[Array, ""]
    """Number of the iteration, from 0."""

    forcing: float | Float[Array, ""]
    """Forcing term of truncated conjugate gradients, where they are used."""

    previous_steps: Float[Array, "steps parameters cameras"] | None
    """Last changes of the cameras, newest first; None unless they are part of the search space."""


class MethodStep(NamedTuple):
    """The step that a method proposes."""

    cameras: Float[Array, "cameras width"]  # manifold coordinates
    points: Float[Array, "3 points"] | None  # None: computed from the cameras by back-substitution
    iterations: Int[Array, ""]  # inner iterations, e.g. of conjugate gradients
    residual_orthogonal: bool  # whether the residual of the damped system is orthogonal to the step


@runtime_checkable
class StepMethod(MethodTraits, Protocol):
    """A method that solves the damped linear system in its own way."""

    def solve(self, system: DampedSystem, options: StepOptions) -> MethodStep:
        """The camera step, and the point step if the method computes it too.

        Args:
            system: the damped system.
            options: static options of the step.
        """
        ...
