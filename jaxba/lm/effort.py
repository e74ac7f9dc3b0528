"""What an iteration may cost, for policies that decide it anew every time.

Normally `StepOptions` says how many embedded point iterations a step has and how far conjugate gradients go. A policy
that pays for an iteration by what was done in it may choose both with lambda.
"""

from __future__ import annotations

from typing import NamedTuple

from jax import Array
from jaxtyping import Float, Int


class Effort(NamedTuple):
    """Traced: changing it compiles nothing."""

    point_iterations: Int[Array, ""]  # instead of StepOptions.refine_points where there are any, 0 to that
    forcing: Float[Array, ""] | None  # instead of StepOptions.cg_forcing; None: that stays
