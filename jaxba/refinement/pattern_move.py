"""Pattern moves: an accepted step is repeated in its direction, twice as far each time, as long as that costs less.

An accepted candidate that the linear model did not foresee, or that damping held back, lies on the floor of a valley,
and so does the start. Source: Hooke, Jeeves 1961, "Direct search solution of numerical and statistical problems".
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float

from jaxba.refinement.acceptance import Candidate, Comparison

FORESEEN = 0.25
"""Difference of the gain ratio from one up to which a step did what the linear model predicted."""

FREE = 0.1
"""Share of damping in a step's curvature up to which damping did not hold it back. A step that did what was predicted
and was free is Newton's, and there is nothing to be had beyond its end."""


def is_repeated(against: Comparison, first: Candidate) -> Bool[Array, "*parts"]:
    """Whether the first accepted candidate is repeated in its direction."""
    step = against.step
    foreseen = (jnp.abs(first.gain - 1) <= FORESEEN) & (first.repairs == 0) & (step.damped <= FREE * step.slope)
    return against.matters & ~foreseen


def goes_further(
    against: Comparison, better: Bool[Array, "*parts"], length: Float[Array, "*parts"]
) -> Bool[Array, "*parts"]:
    """Whether a pattern move that was `better` is followed by one of twice the length."""
    return better & (length < 2.0 ** (against.options.refinement.pattern_moves - 1))
