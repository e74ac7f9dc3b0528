"""From a damped step to the candidate of an iteration: refinement, backtracking, pattern moves.

The plain algorithm evaluates x + d and accepts or rejects it. The linear model is inaccurate for long steps, but mostly
locally: single points diverge, single cameras turn away from their points. Local corrections are cheap compared with a
linear solve and allow longer steps. `Refinement` switches on four of them:

1. `points`: every point is re-optimised on its own at the new cameras (points.py, midpoints.py).
2. `camera_rounds`: cameras, then points are re-optimised on their own (camera_rounds.py).
3. `trials`: a candidate that is still rejected is tried again at a quarter of the length (backtracking.py). A camera
   whose focal length would change its sign then keeps its previous parameters; without trials such a candidate is
   rejected.
4. `pattern_moves`: an accepted step is repeated in its direction (pattern_move.py).

None of these takes another linear solve, so all of them belong to one iteration.
"""

from __future__ import annotations

from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxba.linear.step import Step
from jaxba.model.linearize import Reference
from jaxba.problem.options import StepOptions
from jaxba.refinement.acceptance import Candidate, Comparison, Work, assess, comparison, select
from jaxba.refinement.backtracking import SHORTER, should_backtrack
from jaxba.refinement.camera_rounds import should_refine_cameras
from jaxba.refinement.cameras import refine_cameras
from jaxba.refinement.pattern_move import should_extend, should_repeat
from jaxba.refinement.retraction import keep_focal_signs, move_cameras, step_between
from jaxba.refinement.subproblems import Subproblems
from jaxba.runtime import loops


class Search(NamedTuple):
    """The candidates of every subproblem: shorter steps until one is accepted, then pattern moves; after each of them
    its camera rounds."""

    best: Candidate
    """The last rejected candidate or, once one was accepted, the one with the lowest cost."""

    cameras: Float[Array, "parameters cameras"]
    """Origin of the next candidate."""

    points: Float[Array, "3 points"]

    direction: tuple[Float[Array, "parameters cameras"], Float[Array, "3 points"]]
    """The step, or the change by the first accepted candidate."""

    length: Float[Array, "*parts"]
    """Length of the next candidate, in units of `direction`."""

    active: Bool[Array, "*parts"]
    """Whether there is a next candidate."""

    candidate: Candidate
    """The candidate that camera rounds improve."""

    rounds: Int[Array, "*parts"]
    """Its camera rounds so far."""

    refining: Bool[Array, "*parts"]
    """Whether it has another camera round, before there is a next candidate."""


def best_candidate(
    parts: Subproblems,
    cameras: Float[Array, "parameters cameras"],
    points: Float[Array, "3 points"],
    cost: Float[Array, "*parts"],
    reference: Reference,
    step: Step,
    options: StepOptions,
    min_gain: float | Float[Array, ""],
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
    """
    against = comparison(parts, cameras, points, cost, reference, step, options, min_gain)
    start = jax.tree.map(jnp.asarray, first_search(cameras, points, cost, step))
    if not has_repairs(options):
        return _assess_next(against, start, start.cameras)

    def advance(search: Search) -> Search:
        if not options.refinement.camera_rounds:
            return next_search(against, search, search.cameras)
        last = search.candidate
        refine = lambda cameras, points: refine_cameras(parts.layout, cameras, points, options)
        refined = loops.run_if(jnp.any(search.refining), refine, (last.cameras, last.points), last.cameras)
        return next_search(against, search, refined)

    # full step, shorter steps, pattern moves and camera rounds are iterations of one loop, so that the program contains
    # the evaluation of a candidate only once
    return loops.while_loop(lambda search: jnp.any(search.active), advance, start).best


def has_repairs(options: StepOptions) -> bool:
    """Whether there may be more than one candidate."""
    refinement = options.refinement
    return refinement.trials > 1 or bool(refinement.pattern_moves) or bool(refinement.camera_rounds)


def first_search(cameras: Any, points: Any, cost: Any, step: Step) -> Search:
    """The search whose next candidate is the full step.

    What it adds are NumPy's arrays: outside of a program each conversion by JAX is a program.

    Args:
        cameras: current cameras [9, cameras]. Arrays, or their shapes and types.
        points: current points [3, points].
        cost: their cost, pixels^2, of every subproblem.
        step: solution of the damped system.
    """
    constant = lambda value, dtype: cast(Array, np.full(cost.shape, value, dtype))
    one, infinite, yes, no = (
        constant(1, cost.dtype),
        constant(np.inf, cost.dtype),
        constant(1, bool),
        constant(0, bool),
    )
    none, before = constant(0, np.int32), constant(-1, np.int32)
    initial = Candidate(cameras, points, infinite, -one, -infinite, no, one, Work(before, none, none))
    return Search(initial, cameras, points, (step.cameras, step.points), one, yes, initial, none, no)


def _assess_next(against: Comparison, search: Search, refined: Float[Array, "parameters cameras"]) -> Candidate:
    """Evaluates the next candidate or, where that is due, a camera round of the last one."""
    parts, best = against.parts, search.best
    lengths = parts.of_cameras(search.length)
    cameras = move_cameras(parts.layout, search.cameras, lengths * search.direction[0], against.options)
    if against.options.refinement.trials > 1:
        cameras = jnp.where(keep_focal_signs(search.cameras, cameras), cameras, search.cameras)
    points = search.points + parts.of_points(search.length) * search.direction[1]
    fraction = jnp.where(best.accepted, best.step_fraction, search.length)
    full_step = jnp.any(_is_full_step(search) & search.active)
    work = best.work._replace(repairs=best.work.repairs + 1)
    if against.options.refinement.camera_rounds:
        last, refining = search.candidate, jnp.any(search.refining)
        cameras = jnp.where(refining, refined, cameras)
        points = jnp.where(refining, last.points, points)
        fraction = jnp.where(refining, last.step_fraction, fraction)
        again = last.work._replace(repairs=last.work.repairs + 1, camera_rounds=last.work.camera_rounds + 1)
        work = jax.tree.map(lambda *pair: jnp.where(refining, *pair), again, work)
        full_step = full_step & ~refining
    return assess(against, cameras, points, fraction, work, full_step)


def _is_full_step(search: Search) -> Bool[Array, "*parts"]:
    return ~search.best.accepted & (search.length == 1)


def next_search(against: Comparison, search: Search, refined: Float[Array, "parameters cameras"]) -> Search:
    """Evaluates a candidate or a camera round, and decides what comes after it.

    Args:
        against: data of the step.
        search: what to evaluate.
        refined: the cameras after a camera round of `search.candidate`, where `search.refining`; else any.
    """
    candidate = _assess_next(against, search, refined)
    if not against.options.refinement.camera_rounds:
        return _after_candidate(against, search._replace(candidate=candidate))
    refined = jnp.any(search.refining)
    candidate = select(against.parts, search.refining | ~refined, candidate, search.candidate)
    rounds = jnp.where(refined, search.rounds + 1, 0)
    full_step = _is_full_step(search)
    refining = should_refine_cameras(against, candidate, search.best, full_step, rounds) & search.active
    same = search._replace(candidate=candidate, rounds=rounds, refining=refining)
    choose = lambda new, old: jnp.where(jnp.any(refining), old, new)
    return jax.tree.map(choose, _after_candidate(against, same), same)


def _after_candidate(against: Comparison, search: Search) -> Search:
    """What to try after a candidate that has had its camera rounds."""
    parts, best, candidate = against.parts, search.best, search.candidate
    first = candidate.accepted & ~best.accepted
    better = candidate.accepted & best.accepted & (candidate.cost < best.cost)
    spent = jax.tree.map(lambda *pair: jnp.where(search.active, *pair), candidate.work, best.work)
    tried = best._replace(work=spent)
    best_now = select(parts, search.active & (better | ~best.accepted), candidate, tried)
    shorter = should_backtrack(against, candidate, search.length)
    if not against.options.refinement.pattern_moves:
        return search._replace(best=best_now, length=SHORTER * search.length, active=search.active & shorter)
    further = should_extend(against, better, search.length)
    continues = jnp.where(first, should_repeat(against, candidate), jnp.where(best.accepted, further, shorter))
    starts_pattern = search.active & first
    change = step_between(against.cameras, best_now.cameras, against.options), best_now.points - against.points
    return search._replace(
        best=best_now,
        cameras=jnp.where(parts.of_cameras(best_now.accepted), best_now.cameras, against.cameras),
        points=jnp.where(parts.of_points(best_now.accepted), best_now.points, against.points),
        direction=(
            jnp.where(parts.of_cameras(starts_pattern), change[0], search.direction[0]),
            jnp.where(parts.of_points(starts_pattern), change[1], search.direction[1]),
        ),
        length=jnp.where(first, 1, jnp.where(best.accepted, 2, SHORTER) * search.length),
        active=search.active & continues,
    )
