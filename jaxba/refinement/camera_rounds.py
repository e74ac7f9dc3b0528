"""Camera rounds: every camera, then every point is re-optimised on its own, a few times in turn.

They follow a candidate that achieved less than half of the predicted decrease but is not far off. A step along a curved
valley leaves its floor; independent steps of cameras and points return to it. Source: resection-intersection (Chen,
Chen and Wang 2019, "Bundle adjustment revisited"), used here to correct second-order steps.
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Int

from jaxba.refinement.acceptance import Candidate, Comparison

GOOD_GAIN = 0.5
"""Gain ratio from which the linear model is trusted and there are no camera rounds."""

MAX_COST_RATIO = 1.5
"""Largest cost of a candidate, relative to the cost before the step, for camera rounds: beyond it, outlying points
would pull the cameras away. On Ladybug-49 with a constant lambda of 1e-6, a limit of 10 led to a minimum 19% above that
reached with 1.5."""

MIN_GAINS = (-5.0, -0.5)
"""Smallest gain ratio after one camera round, and after more, for which there is another one. On six real problems none
of the 12 and 17 candidates below was ever accepted."""

ROUNDS_OF_LATER_CANDIDATES = 1
"""Most camera rounds of a backtracked candidate or a pattern move. Measured on 457 held-out scenes with the policy
`learned`: 6.40 iterations to within 1e-4 of the best cost with none for backtracked candidates, 6.02 with one, 5.88
with three; on real problems three took a tenth more work than one."""


def should_refine_cameras(
    against: Comparison,
    candidate: Candidate,
    best: Candidate,
    full_step: Bool[Array, ""],
    done: Int[Array, ""],
) -> Bool[Array, ""]:
    """Whether a camera round, or another one, may lead to the acceptance of a candidate.

    Args:
        against: data of the step.
        candidate: the candidate to improve.
        best: the best candidate so far; a pattern move must have a lower cost.
        full_step: whether the candidate is the full step, which may have all rounds.
        done: number of its camera rounds so far.
    """
    most = against.options.refinement.camera_rounds
    limit = jnp.where(full_step, most, min(ROUNDS_OF_LATER_CANDIDATES, most))
    insufficient = jnp.where(best.accepted, candidate.cost >= best.cost, candidate.gain < GOOD_GAIN)
    promising = candidate.gain > jnp.select([done == 0, done == 1], [-jnp.inf, MIN_GAINS[0]], MIN_GAINS[1])
    near = candidate.cost < MAX_COST_RATIO * against.cost
    return (done < limit) & insufficient & near & promising & against.matters
