"""What a method must do that takes the place of the plain step: the interface that `lm_step` calls.

`jaxba.methods.registry` holds those there are. A method is a frozen dataclass, so that it can stand in `StepOptions`.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol, runtime_checkable

from jax import Array
from jaxtyping import Bool, Float, Int

from jaxba.linear.schur import CameraSystem, PointSystem
from jaxba.model.linearize import Linearization
from jaxba.problem.options import MethodTraits, StepOptions
from jaxba.structure.layout import Layout


class DampedSystem(NamedTuple):
    """The damped normal equations `(H + D) d = -g` of one iteration, points eliminated."""

    layout: Layout
    linear: Linearization
    points: PointSystem
    cameras: CameraSystem
    damping: Float[Array, ""]


class MethodStep(NamedTuple):
    """What a method proposes."""

    cameras: Float[Array, "cameras 9"]  # on the manifold
    points: Float[Array, "3 points"] | None  # None: they follow from the cameras by back-substitution
    iterations: Int[Array, ""]  # of what it iterates
    residual_orthogonal: bool  # whether the residual of the system that is left is orthogonal to the step


class Round(NamedTuple):
    """What a round of several solves did."""

    cameras: Float[Array, "9 cameras"]
    points: Float[Array, "3 points"]
    cost: Float[Array, ""]  # pixels squared
    predicted: Float[Array, ""]  # decrease that linear models promised: of accepted trials, and of whole refused steps
    gain: Float[Array, ""]  # what clusters that were accepted gained, over that
    slope: Float[Array, ""]  # -g.d
    curvature: Float[Array, ""]  # d.H d
    gradient_max: Float[Array, ""]  # before the round
    share: Float[Array, ""]  # of their steps that clusters took, weighted by what each promised at full length
    repairs: Int[Array, ""]  # camera rounds, further trials and pattern moves of the cluster that took most
    accepted: Bool[Array, ""]


@runtime_checkable
class StepMethod(MethodTraits, Protocol):
    """A method that solves the linear system in another way."""

    def solve(
        self,
        system: DampedSystem,
        options: StepOptions,
        forcing: float | Float[Array, ""],
        iteration: int | Int[Array, ""],
        parameters: Float[Array, "9 cameras"],
        previous: Float[Array, "steps 9 cameras"] | None,
    ) -> MethodStep:
        """The camera step, and that of the points where it is made with it.

        Args:
            system: to be solved.
            options: of the step.
            forcing: of truncated conjugate gradients, where the method has them.
            iteration: number of the iteration, from 0.
            parameters: present cameras.
            previous: last changes of the cameras, where they take part in the step.
        """
        ...


@runtime_checkable
class RoundMethod(MethodTraits, Protocol):
    """A method whose iteration is a round of several solves, parts of which are accepted each by itself."""

    def round(
        self,
        layout: Layout,
        cameras: Float[Array, "9 cameras"],
        points: Float[Array, "3 points"],
        cost: Float[Array, ""],
        damping: Float[Array, ""],
        iteration: int | Int[Array, ""],
        options: StepOptions,
        min_gain: float | Float[Array, ""],
    ) -> Round:
        """One round from the present parameters and their cost."""
        ...
