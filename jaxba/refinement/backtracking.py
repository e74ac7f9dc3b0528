"""Backtracking: a refused candidate is tried again at a quarter of the length."""

from __future__ import annotations

from jax import Array
from jaxtyping import Bool, Float

from jaxba.refinement.acceptance import Candidate, Comparison

SHORTER = 0.25
"""Factor on the length of a step that was refused. Measured with 4 trials on Ladybug-49 under lambda 1e-6."""


def is_tried_again(against: Comparison, candidate: Candidate, length: Float[Array, "*parts"]) -> Bool[Array, "*parts"]:
    """Whether a candidate was refused and a shorter one is left to try."""
    shortest = 1.5 * SHORTER ** (against.options.refinement.trials - 1)
    return ~candidate.accepted & (length > shortest) & against.matters
