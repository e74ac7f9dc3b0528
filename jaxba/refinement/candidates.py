"""What becomes of a step: candidates along it, until one is accepted, and beyond.

The linear model is wrong far from where it was made, and mostly wrong locally: points fly off, cameras turn away from
what they see. Repairing that locally is cheap beside a linear solve, and lets bolder steps pass:

1. `Refinement.points`: every point re-optimised alone at the new cameras (points.py, midpoints.py).
2. `Refinement.camera_rounds`: cameras alone, then points alone again (camera_rounds.py).
3. `Refinement.trials`: a candidate that is still refused is tried again at a quarter of the length (backtracking.py).
   Where steps are tried again, a camera whose focal length would change its sign stays where it was: an image
   seen in a mirror fits for a while, and there is no way back.
4. `Refinement.pattern_moves`: an accepted candidate is repeated in its direction (pattern_move.py).

None of it takes another linear solve, so it is all one iteration.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Bool, Float

from jaxba.linear.step import Effort, Step
from jaxba.model.linearize import Reference
from jaxba.problem.options import StepOptions
from jaxba.refinement.acceptance import Candidate, Comparison, assess, chosen, comparison
from jaxba.refinement.backtracking import SHORTER, is_tried_again
from jaxba.refinement.camera_rounds import repaired
from jaxba.refinement.pattern_move import goes_further, is_repeated
from jaxba.refinement.retraction import move_cameras, step_between
from jaxba.refinement.subproblems import Subproblems


class _Attempt(NamedTuple):
    """What is tried next, by every subproblem: shorter steps until one is accepted, then pattern moves."""

    best: Candidate  # the last that was refused or, from the first accepted one on, the cheapest
    cameras: Float[Array, "9 cameras"]  # from where the next one leads away
    points: Float[Array, "3 points"]
    direction: tuple[Float[Array, "9 cameras"], Float[Array, "3 points"]]  # the step, or what the first accepted did
    length: Float[Array, "*parts"]  # of the next one, in directions
    going: Bool[Array, "*parts"]  # whether there is a next one


def best_candidate(
    parts: Subproblems,
    cameras: Float[Array, "9 cameras"],
    points: Float[Array, "3 points"],
    cost: Float[Array, "*parts"],
    reference: Reference,
    step: Step,
    options: StepOptions,
    min_gain: float | Float[Array, ""],
    effort: Effort | None = None,
) -> Candidate:
    """The first accepted candidate or what pattern moves made of it, or the last refused one, of every subproblem.

    Args:
        parts: what is accepted by itself.
        cameras: present cameras.
        points: present points.
        cost: their cost, pixels squared.
        reference: costs of the slots there, and depths.
        step: the solution of the damped system; its slope and damped part are those of the subproblems.
        options: static.
        min_gain: a candidate is accepted if the cost falls and the gain ratio exceeds this.
        effort: number of point iterations, where it is not that of the options.
    """
    against = comparison(parts, cameras, points, cost, reference, step, options, min_gain, effort)
    one, yes = jnp.ones_like(cost), jnp.ones(cost.shape, bool)
    bad, none = jnp.full_like(cost, jnp.inf), jnp.zeros(cost.shape, jnp.int32)
    nothing = Candidate(cameras, points, bad, -one, -bad, ~yes, one, none - 1)
    start = _Attempt(nothing, cameras, points, (step.cameras, step.points), one, yes)
    if options.refinement.trials == 1 and not options.refinement.pattern_moves:
        return _next_candidate(against, start)
    # the whole step is the first attempt of the loop, so that the program has one copy of all this
    following = lambda attempt: _following(against, attempt)
    return lax.while_loop(lambda attempt: jnp.any(attempt.going), following, start).best


def _next_candidate(against: Comparison, attempt: _Attempt) -> Candidate:
    """The candidate that an attempt leads to, with its embedded iterations."""
    parts, best = against.parts, attempt.best
    share = jnp.where(best.accepted, best.share, attempt.length)
    lengths = parts.of_cameras(attempt.length)
    moved = move_cameras(parts.layout, attempt.cameras, lengths * attempt.direction[0], against.options)
    if against.options.refinement.trials > 1:
        moved = jnp.where(moved[6] * against.cameras[6] < 0, attempt.cameras, moved)
    there = attempt.points + parts.of_points(attempt.length) * attempt.direction[1]
    whole = ~best.accepted & (attempt.length == 1)
    candidate = assess(against, moved, there, share, best.repairs + 1, jnp.any(whole & attempt.going))
    if not against.options.refinement.camera_rounds:
        return candidate
    return repaired(against, candidate, best, whole, attempt.going)


def _following(against: Comparison, attempt: _Attempt) -> _Attempt:
    """What is tried after an attempt."""
    parts, best, candidate = against.parts, attempt.best, _next_candidate(against, attempt)
    first = candidate.accepted & ~best.accepted
    better = candidate.accepted & best.accepted & (candidate.cost < best.cost)
    tried = best._replace(repairs=jnp.where(attempt.going, candidate.repairs, best.repairs))
    after = chosen(parts, attempt.going & (better | ~best.accepted), candidate, tried)
    shorter = is_tried_again(against, candidate, attempt.length)
    if not against.options.refinement.pattern_moves:
        return attempt._replace(best=after, length=SHORTER * attempt.length, going=attempt.going & shorter)
    further = goes_further(against, better, attempt.length)
    goes_on = jnp.where(first, is_repeated(against, candidate), jnp.where(best.accepted, further, shorter))
    news = attempt.going & first
    done = step_between(against.cameras, after.cameras, against.options), after.points - against.points
    return _Attempt(
        after,
        jnp.where(parts.of_cameras(after.accepted), after.cameras, against.cameras),
        jnp.where(parts.of_points(after.accepted), after.points, against.points),
        (
            jnp.where(parts.of_cameras(news), done[0], attempt.direction[0]),
            jnp.where(parts.of_points(news), done[1], attempt.direction[1]),
        ),
        jnp.where(first, 1, jnp.where(best.accepted, 2, SHORTER) * attempt.length),
        attempt.going & goes_on,
    )
