"""Pattern moves: an accepted step is repeated in its direction, each time twice as far, while the cost falls.

An accepted candidate that the linear model did not predict, or whose length damping limited, lies on the floor of a
valley, as does the start: the direction between the two follows the valley.

Source: Hooke and Jeeves 1961, "Direct search solution of numerical and statistical problems".
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float

from jaxba.refinement.acceptance import Candidate, Comparison

GAIN_TOLERANCE = 0.25
"""Difference of the gain ratio from one up to which the linear model predicted the step."""

SMALL_DAMPING_FRACTION = 0.1
"""Damping fraction `d.D d / d.(H + D) d` up to which damping did not limit the length of a step. If the linear model
predicted such a step, it is a Gauss-Newton step, and nothing is gained beyond it."""


def should_repeat(against: Comparison, first: Candidate) -> Bool[Array, ""]:
    """Whether the first accepted candidate is repeated in its direction."""
    step = against.step
    predicted = (
        (jnp.abs(first.gain - 1) <= GAIN_TOLERANCE)
        & (first.work.repairs == 0)
        & (step.damped <= SMALL_DAMPING_FRACTION * step.slope)
    )
    return bool(against.options.refinement.pattern_moves) & against.matters & ~predicted


def should_extend(against: Comparison, better: Bool[Array, ""], length: Float[Array, ""]) -> Bool[Array, ""]:
    """Whether a pattern move that was `better` is followed by one of twice the length."""
    return better & (length < 2.0 ** (against.options.refinement.pattern_moves - 1))
