"""From a damped step to the candidate of an iteration: refinement, backtracking, pattern moves.

The plain algorithm evaluates x + d and accepts or rejects it. The linear model is inaccurate for long steps, but mostly
locally: single points diverge, single cameras turn away from their points. Local corrections are cheap compared with a
linear solve and allow longer steps. `Refinement` switches on four of them:

1. `points`: every point is re-optimised on its own at the new cameras (points.py, midpoints.py).
2. `camera_rounds`: cameras, then points are re-optimised on their own (camera_rounds.py).
3. `trials`: a candidate that is still rejected is tried again at a quarter of the length (backtracking.py). A camera
   whose focal length would change its sign then keeps its previous parameters: a mirrored image can fit for a while,
   and the iterations do not lead back.
4. `pattern_moves`: an accepted step is repeated in its direction (pattern_move.py).

None of these takes another linear solve, so all of them belong to one iteration.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float

from jaxba.linear.step import Effort, Step
from jaxba.model.linearize import Reference
from jaxba.problem.options import StepOptions
from jaxba.refinement.acceptance import Candidate, Comparison, assess, comparison, select
from jaxba.refinement.backtracking import SHORTER, should_backtrack
from jaxba.refinement.camera_rounds import with_camera_rounds
from jaxba.refinement.pattern_move import should_extend, should_repeat
from jaxba.refinement.retraction import move_cameras, step_between
from jaxba.refinement.subproblems import Subproblems
from jaxba.runtime import loops


class _Attempt(NamedTuple):
    """The next candidate of every subproblem: shorter steps until one is accepted, then pattern moves."""

    best: Candidate  # the last rejected candidate or, once one was accepted, the one with the lowest cost
    cameras: Float[Array, "9 cameras"]  # origin of the next candidate
    points: Float[Array, "3 points"]
    # the step, or the change by the first accepted candidate
    direction: tuple[Float[Array, "9 cameras"], Float[Array, "3 points"]]
    length: Float[Array, "*parts"]  # length of the next candidate, in units of `direction`
    active: Bool[Array, "*parts"]  # whether there is a next candidate


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
    """Evaluates a step: the candidate of the iteration, with the accept decision, for every subproblem.

    It is the first accepted candidate, possibly extended by pattern moves, or the last rejected one.

    Args:
        parts: the subproblems that are accepted separately.
        cameras: current cameras.
        points: current points.
        cost: their cost, pixels^2.
        reference: costs and depths of the slots at the current parameters.
        step: solution of the damped system, with the linear model of each subproblem.
        options: static options of the step.
        min_gain: a candidate is accepted if the cost falls and the gain ratio exceeds this.
        effort: overrides the number of point iterations of the options.
    """
    against = comparison(parts, cameras, points, cost, reference, step, options, min_gain, effort)
    ones, true = jnp.ones_like(cost), jnp.ones(cost.shape, bool)
    infinite, zeros = jnp.full_like(cost, jnp.inf), jnp.zeros(cost.shape, jnp.int32)
    initial = Candidate(cameras, points, infinite, -ones, -infinite, ~true, ones, zeros - 1)
    start = _Attempt(initial, cameras, points, (step.cameras, step.points), ones, true)
    if options.refinement.trials == 1 and not options.refinement.pattern_moves:
        return _next_candidate(against, start)
    # the full step is the first iteration of the loop, so that the program contains its body only once
    advance = lambda attempt: _next_attempt(against, attempt)
    return loops.while_loop(lambda attempt: jnp.any(attempt.active), advance, start).best


def _next_candidate(against: Comparison, attempt: _Attempt) -> Candidate:
    """Evaluates the next candidate, with its embedded iterations and camera rounds."""
    parts, best = against.parts, attempt.best
    step_fraction = jnp.where(best.accepted, best.step_fraction, attempt.length)
    lengths = parts.of_cameras(attempt.length)
    new_cameras = move_cameras(parts.layout, attempt.cameras, lengths * attempt.direction[0], against.options)
    if against.options.refinement.trials > 1:
        new_cameras = jnp.where(new_cameras[6] * against.cameras[6] < 0, attempt.cameras, new_cameras)
    new_points = attempt.points + parts.of_points(attempt.length) * attempt.direction[1]
    full_step = ~best.accepted & (attempt.length == 1)
    candidate = assess(
        against, new_cameras, new_points, step_fraction, best.repairs + 1, jnp.any(full_step & attempt.active)
    )
    if not against.options.refinement.camera_rounds:
        return candidate
    return with_camera_rounds(against, candidate, best, full_step, attempt.active)


def _next_attempt(against: Comparison, attempt: _Attempt) -> _Attempt:
    """Evaluates the next candidate and decides what to try after it."""
    parts, best, candidate = against.parts, attempt.best, _next_candidate(against, attempt)
    first = candidate.accepted & ~best.accepted
    better = candidate.accepted & best.accepted & (candidate.cost < best.cost)
    tried = best._replace(repairs=jnp.where(attempt.active, candidate.repairs, best.repairs))
    best_now = select(parts, attempt.active & (better | ~best.accepted), candidate, tried)
    shorter = should_backtrack(against, candidate, attempt.length)
    if not against.options.refinement.pattern_moves:
        return attempt._replace(best=best_now, length=SHORTER * attempt.length, active=attempt.active & shorter)
    further = should_extend(against, better, attempt.length)
    continues = jnp.where(first, should_repeat(against, candidate), jnp.where(best.accepted, further, shorter))
    starts_pattern = attempt.active & first
    change = step_between(against.cameras, best_now.cameras, against.options), best_now.points - against.points
    return _Attempt(
        best_now,
        jnp.where(parts.of_cameras(best_now.accepted), best_now.cameras, against.cameras),
        jnp.where(parts.of_points(best_now.accepted), best_now.points, against.points),
        (
            jnp.where(parts.of_cameras(starts_pattern), change[0], attempt.direction[0]),
            jnp.where(parts.of_points(starts_pattern), change[1], attempt.direction[1]),
        ),
        jnp.where(first, 1, jnp.where(best.accepted, 2, SHORTER) * attempt.length),
        attempt.active & continues,
    )
