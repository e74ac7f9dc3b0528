"""A damped step, what the linear model says about it, and what an iteration may cost."""

from __future__ import annotations

from typing import NamedTuple

from jax import Array
from jaxtyping import Float, Int


class Step(NamedTuple):
    """A step and what the linear model says about it."""

    cameras: Float[Array, "9 cameras"]  # in the coordinates of the options
    points: Float[Array, "3 points"]
    # of the whole, or of every subproblem that is accepted by itself (refinement/subproblems.py):
    slope: Float[Array, "*parts"]  # -g.d = d.(H + D) d, pixels^2
    damped: Float[Array, "*parts"]  # d.D d, pixels^2; of a step that solves no system, what -g.d exceeds d.H d by
    gradient_max: Float[Array, ""]  # largest entry of the gradient before the step
    cg_iterations: Int[Array, ""]  # 0 when the system was factored
    forcing: Float[Array, ""]  # term by which they ended, 0 where that is not by one

    def predicted(self, share: Float[Array, "*parts"]) -> Float[Array, "*parts"]:
        """Decrease of the cost that the linear model predicts for a fraction of the step, pixels^2."""
        return share * (0.5 * share * self.damped + (1 - 0.5 * share) * self.slope)


class Effort(NamedTuple):
    """What an iteration may cost, for policies that decide it anew every time. Traced: changing it compiles nothing."""

    point_iterations: Int[Array, ""]  # instead of Refinement.points where there are any, 0 to that
    forcing: Float[Array, ""] | None  # instead of ConjugateGradients.forcing; None: that stays
