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
from jaxba.refinement.acceptance import Work
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


class Round(NamedTuple):
    """Result of one round of a method that solves several subproblems, each with its own accept decision."""

    cameras: Float[Array, "parameters cameras"]
    """Cameras after the round."""

    points: Float[Array, "3 points"]
    """Points after the round, scene units."""

    cost: Float[Array, ""]
    """Cost after the round, pixels^2."""

    predicted: Float[Array, ""]
    """Predicted decrease, summed over accepted candidates and full rejected steps, pixels^2."""

    gain: Float[Array, ""]
    """Actual decrease of the accepted clusters over `predicted`."""

    slope: Float[Array, ""]
    """-g.d, with the gradient g and the step d."""

    curvature: Float[Array, ""]
    """d.H d, with the Gauss-Newton Hessian H."""

    gradient_max: Float[Array, ""]
    """Largest absolute gradient entry before the round."""

    step_fraction: Float[Array, ""]
    """Mean step fraction of the clusters, weighted by the predicted decrease of their full steps."""

    work: Work
    """What the search for candidates took: the largest numbers of all clusters."""

    accepted: Bool[Array, ""]
    """Whether any cluster was accepted."""

    weightless: Bool[Array, ""]
    """See `StepInfo`."""


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
        cameras: Float[Array, "parameters cameras"],
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
