"""The interface of methods that replace the plain Levenberg-Marquardt step (STBA, DeepLM, PoBA).

`lm_step` calls either `StepMethod.solve` or `RoundMethod.round`. `jaxba.methods.registry` lists the implementations. A
method is a frozen dataclass, so that it can be a field of the static `StepOptions`.
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
    damping: Float[Array, ""]  # lambda
    parameters: Float[Array, "9 cameras"]  # current cameras
    iteration: int | Int[Array, ""]  # number of the iteration, from 0
    forcing: float | Float[Array, ""]  # forcing term of truncated conjugate gradients, where they are used
    # last changes of the cameras, newest first; None unless they are part of the search space
    previous_steps: Float[Array, "steps 9 cameras"] | None


class MethodStep(NamedTuple):
    """The step that a method proposes."""

    cameras: Float[Array, "cameras 9"]  # manifold coordinates
    points: Float[Array, "3 points"] | None  # None: computed from the cameras by back-substitution
    iterations: Int[Array, ""]  # inner iterations, e.g. of conjugate gradients
    residual_orthogonal: bool  # whether the residual of the damped system is orthogonal to the step


class Round(NamedTuple):
    """Result of one round of a method that solves several subproblems, each with its own accept decision."""

    cameras: Float[Array, "9 cameras"]
    points: Float[Array, "3 points"]
    cost: Float[Array, ""]  # pixels^2
    predicted: Float[Array, ""]  # predicted decrease, summed over accepted candidates and full rejected steps, pixels^2
    gain: Float[Array, ""]  # actual decrease of the accepted clusters over `predicted`
    slope: Float[Array, ""]  # -g.d
    curvature: Float[Array, ""]  # d.H d
    gradient_max: Float[Array, ""]  # largest absolute gradient entry before the round
    # mean step fraction of the clusters, weighted by the predicted decrease of their full steps
    step_fraction: Float[Array, ""]
    repairs: Int[Array, ""]  # see `StepInfo.repairs`: the largest of all clusters
    accepted: Bool[Array, ""]


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


@runtime_checkable
class RoundMethod(MethodTraits, Protocol):
    """A method whose iteration is a round of several solves, each with its own accept decision."""

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
        """One round from the current parameters.

        Args:
            layout: the problem's observations.
            cameras: current cameras.
            points: current points.
            cost: their cost, pixels^2.
            damping: lambda.
            iteration: number of the iteration, from 0.
            options: static options of the step.
            min_gain: a subproblem's step is accepted if its cost falls and its gain ratio exceeds this.
        """
        ...
