"""Camera rounds: first every camera, then every point is re-optimised alone, a few times over.

Where a step did less than half of what the linear model predicted and is not hopeless, a step along a curved valley
comes back to its floor. Source: resection and intersection (Chen, Chen, Wang 2019, "Bundle adjustment revisited"), here
as a repair of second-order steps.
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Bool, Int

from jaxba.refinement.acceptance import Candidate, Comparison, assess, chosen
from jaxba.refinement.cameras import refine_cameras

GOOD_GAIN = 0.5
"""Gain ratio from which on the linear model is trusted and cameras stay where it put them."""

HOPELESS = 1.5
"""Candidates that cost more than this times the present cost get no camera rounds: wild points would pull the cameras
after them. On Ladybug-49 under lambda 1e-6 a limit of 10 led into a minimum 19% above, 1.5 did not."""

WITHIN_REACH = (-5.0, -0.5)
"""Gain ratios after one camera round, and after more, from which on a further one may lead to acceptance. On six real
problems it did in none of the 12 and 17 cases with less."""

ROUNDS_OF_OTHERS = 1
"""Camera rounds of a shortened candidate, and of a pattern move. On 457 held-out scenes `learned` came within 1e-4 of
the best in 6.40 iterations on average without any of a shortened one, 6.02 with one, 5.88 with three; on real problems
three took a tenth more work than one."""


def repaired(
    against: Comparison,
    candidate: Candidate,
    best: Candidate,
    whole: Bool[Array, "*parts"],
    going: Bool[Array, "*parts"],
) -> Candidate:
    """A candidate after as many camera rounds as may lead to its acceptance.

    Args:
        against: what it is compared with.
        candidate: to be repaired.
        best: the best one so far, which a pattern move must undercut.
        whole: whether it is the whole step, which may have all rounds.
        going: subproblems that it is for.
    """
    most = against.options.refinement.camera_rounds
    rounds = jnp.where(whole, most, min(ROUNDS_OF_OTHERS, most))
    rounds = jnp.where(going, rounds, 0)

    def one_round(carry: tuple[Candidate, Int[Array, "*parts"]]) -> tuple[Candidate, Int[Array, "*parts"]]:
        candidate, left = carry
        moved = refine_cameras(against.parts.layout, candidate.cameras, candidate.points, against.options)
        again = assess(against, moved, candidate.points, candidate.share, candidate.repairs + 1)
        return chosen(against.parts, worth_it(carry), again, candidate), left - 1

    def worth_it(carry: tuple[Candidate, Int[Array, "*parts"]]) -> Bool[Array, "*parts"]:
        candidate, left = carry
        lacks = jnp.where(best.accepted, candidate.cost >= best.cost, candidate.gain < GOOD_GAIN)
        done = rounds - left
        within_reach = candidate.gain > jnp.select([done == 0, done == 1], [-jnp.inf, WITHIN_REACH[0]], WITHIN_REACH[1])
        return (left > 0) & lacks & (candidate.cost < HOPELESS * against.cost) & within_reach & against.matters

    return lax.while_loop(lambda carry: jnp.any(worth_it(carry)), one_round, (candidate, rounds))[0]
