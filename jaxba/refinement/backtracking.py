"""Backtracking: a rejected step is tried again at a quarter of its length."""

from __future__ import annotations

from jax import Array
from jaxtyping import Bool, Float

from jaxba.refinement.acceptance import Candidate, Comparison

SHORTER = 0.25
"""Factor on the length of a rejected step. Measured with 4 trials on Ladybug-49 with a constant lambda of 1e-6."""


def should_backtrack(against: Comparison, candidate: Candidate, length: Float[Array, ""]) -> Bool[Array, ""]:
    """Whether a candidate of this length was rejected and a shorter one is left to try."""
    shortest = 1.5 * SHORTER ** (against.options.refinement.trials - 1)
    return ~candidate.accepted & (length > shortest) & against.matters
