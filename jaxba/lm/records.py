"""The state of an LM iteration and the record of it: everything that a damping policy can see."""

from __future__ import annotations

from typing import NamedTuple

from jax import Array
from jaxtyping import Bool, Float, Int


class LMState(NamedTuple):
    """Current parameters, in layout order, and their cost."""

    cameras: Float[Array, "9 cameras"]
    points: Float[Array, "3 points"]
    cost: Float[Array, ""]  # pixels^2
    previous_steps: Float[Array, "steps 9 cameras"] | None = None  # last changes of the cameras; None: not used


class StepInfo(NamedTuple):
    """Record of one iteration. A damping policy sees this and nothing else of the solve."""

    cost: Float[Array, ""]  # accepted cost after the iteration, pixels^2
    previous_cost: Float[Array, ""]  # accepted cost before it, pixels^2
    candidate_cost: Float[Array, ""]  # cost at the proposed parameters, may be non-finite
    predicted: Float[Array, ""]  # decrease predicted by the linear model, pixels^2
    gain_ratio: Float[Array, ""]  # actual over predicted decrease
    accepted: Bool[Array, ""]
    damping: Float[Array, ""]  # lambda of this iteration
    gradient_max: Float[Array, ""]  # largest absolute gradient entry before the step
    step_norm: Float[Array, ""]  # norm of the candidate's step, including refined points
    parameter_norm: Float[Array, ""]  # norm of the parameters before the step
    cg_iterations: Int[Array, ""]  # 0 for a factorisation
    forcing: Float[Array, ""]  # forcing term of conjugate gradients; 0 for an exact solve
    step_fraction: Float[Array, ""]  # length of the candidate's step over the full step; below 1 after backtracking
    damping_fraction: Float[Array, ""]  # d.D d / d.(H + D) d: 0 for Gauss-Newton, 1 for gradient descent
    repairs: Int[Array, ""]  # camera rounds, backtracking trials and pattern moves after the first candidate
