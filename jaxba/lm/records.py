"""What an iteration starts from and what it reports: all that a damping policy may see."""

from __future__ import annotations

from typing import NamedTuple

from jax import Array
from jaxtyping import Bool, Float, Int


class LMState(NamedTuple):
    """Parameters in layout order and their cost."""

    cameras: Float[Array, "9 cameras"]
    points: Float[Array, "3 points"]
    cost: Float[Array, ""]
    previous_steps: Float[Array, "steps 9 cameras"] | None = None  # last changes of the cameras; None: not used


class StepInfo(NamedTuple):
    """What one iteration did. Everything a damping policy may look at is here or follows from it."""

    cost: Float[Array, ""]  # accepted cost after the iteration, pixels^2
    previous_cost: Float[Array, ""]  # accepted cost before it
    candidate_cost: Float[Array, ""]  # cost at the proposed parameters, perhaps not finite
    predicted: Float[Array, ""]  # decrease predicted by the linear model
    gain_ratio: Float[Array, ""]  # actual over predicted decrease
    accepted: Bool[Array, ""]
    damping: Float[Array, ""]  # lambda that was used
    gradient_max: Float[Array, ""]  # largest gradient entry before the step
    step_norm: Float[Array, ""]  # of the proposed step as long as it was tried, refined points included
    parameter_norm: Float[Array, ""]  # before the step
    cg_iterations: Int[Array, ""]
    forcing: Float[Array, ""]  # term by which conjugate gradients ended; 0 where the step is not inexact by design
    share: Float[Array, ""]  # length of the candidate relative to the whole step, below 1 after further trials
    damping_share: Float[Array, ""]  # share of the step's curvature that is damping's, 0 (Gauss-Newton) to 1
    repairs: Int[Array, ""]  # camera rounds, further trials and pattern moves after the first candidate
