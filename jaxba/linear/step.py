"""The record of a damped step, with its linear model."""

from __future__ import annotations

from typing import NamedTuple

from jax import Array
from jaxtyping import Float, Int


class Step(NamedTuple):
    """A damped step d and the terms of its linear model (lm/damped_step.py)."""

    cameras: Float[Array, "parameters cameras"]  # in the coordinates of the options
    points: Float[Array, "3 points"]
    slope: Float[Array, ""]  # -g.d, which is d.(H + D) d if the step solves the damped system; pixels^2
    damped: Float[Array, ""]  # -g.d - d.H d, which is d.D d if the step solves the damped system; pixels^2
    gradient_max: Float[Array, ""]  # largest absolute gradient entry before the step
    cg_iterations: Int[Array, ""]  # 0 when the system was factored
    forcing: Float[Array, ""]  # forcing term that stopped them; 0 for an exact solve

    def predicted(self, fraction: Float[Array, ""]) -> Float[Array, ""]:
        """Decrease of the cost that the linear model predicts for `fraction * d`, pixels^2.

        `m(0) - m(a d) = -a g.d - a^2 d.H d / 2`, written with `slope` and `damped`, which are not negative, so that
        nothing cancels.
        """
        return fraction * (0.5 * fraction * self.damped + (1 - 0.5 * fraction) * self.slope)
