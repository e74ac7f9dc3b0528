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
from jaxba.problem.options import StepOptions
from jaxba.refinement.acceptance import Candidate, Comparison, Work, assess, select
from jaxba.refinement.backtracking import SHORTER, should_backtrack
from jaxba.refinement.camera_rounds import should_refine_cameras
from jaxba.refinement.cameras import refine_cameras
from jaxba.refinement.pattern_move import should_extend, should_repeat
from jaxba.refinement.retraction import keep_focal_signs, move_cameras, step_between
from jaxba.runtime import loops


class Search(NamedTuple):
    """The candidates of a step: shorter ones until one is accepted, then pattern moves; after each of them its camera
    rounds."""

    best: Candidate
    """The last rejected candidate or, once one was accepted, the one with the lowest cost."""

    cameras: Float[Array, "parameters cameras"]
    """Origin of the next candidate."""

    points: Float[Array, "3 points"]

    direction: tuple[Float[Array, "parameters cameras"], Float[Array, "3 points"]]
    """The step, or the change by the first accepted candidate."""

    length: Float[Array, ""]
    """Length of the next candidate, in units of `direction`."""

    active: Bool[Array, ""]
    """Whether there is a next candidate."""

    candidate: Candidate
    """The candidate that camera rounds improve."""

    rounds: Int[Array, ""]
    """Its camera rounds so far."""

    refining: Bool[Array, ""]
    """Whether it has another camera round, before there is a next candidate."""


def best_candidate(against: Comparison) -> Candidate:
    """Evaluates a step: the candidate of the iteration, with the accept decision.

    It is the first accepted candidate, possibly extended by pattern moves, or the last rejected one.
    """
    options = against.options
    start = first_search(against.cameras, against.previous.points, against.cost, against.step)
    start = jax.tree.map(jnp.asarray, start)
    if not has_repairs(options):
        return _assess_next(against, start, start.cameras)

    def advance(search: Search) -> Search:
        last, refined = search.candidate, search.cameras
        if options.refinement.camera_rounds:
            refine = lambda cameras, points: refine_cameras(against.layout, cameras, points, options)
            refined = loops.run_if(search.refining, refine, (last.cameras, last.points), last.cameras)
        return next_search(against, search, refined)

    # full step, shorter steps, pattern moves and camera rounds are iterations of one loop, so that the program contains
    # the evaluation of a candidate only once
    return loops.while_loop(lambda search: search.active, advance, start).best


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
        cost: their cost, pixels^2.
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
    best = search.best
    cameras = move_cameras(against.layout, search.cameras, search.length * search.direction[0], against.options)
    if against.options.refinement.trials > 1:
        cameras = jnp.where(keep_focal_signs(search.cameras, cameras), cameras, search.cameras)
    points = search.points + search.length * search.direction[1]
    fraction = jnp.where(best.accepted, best.step_fraction, search.length)
    full_step = _is_full_step(search) & search.active
    work = best.work._replace(repairs=best.work.repairs + 1)
    last, refining = search.candidate, search.refining
    again = last.work._replace(repairs=last.work.repairs + 1, camera_rounds=last.work.camera_rounds + 1)
    cameras, points, fraction, work = select(
        refining, (refined, last.points, last.step_fraction, again), (cameras, points, fraction, work)
    )
    return assess(against, cameras, points, fraction, work, full_step & ~refining)


def _is_full_step(search: Search) -> Bool[Array, ""]:
    return ~search.best.accepted & (search.length == 1)


def next_search(against: Comparison, search: Search, refined: Float[Array, "parameters cameras"]) -> Search:
    """Evaluates a candidate or a camera round, and decides what comes after it.

    Args:
        against: data of the step.
        search: what to evaluate.
        refined: the cameras after a camera round of `search.candidate`, where `search.refining`; else any.
    """
    candidate = _assess_next(against, search, refined)
    rounds = jnp.where(search.refining, search.rounds + 1, 0)
    full_step = _is_full_step(search)
    refining = should_refine_cameras(against, candidate, search.best, full_step, rounds) & search.active
    same = search._replace(candidate=candidate, rounds=rounds, refining=refining)
    return select(refining, same, _after_candidate(against, same))


def _after_candidate(against: Comparison, search: Search) -> Search:
    """What to try after a candidate that has had its camera rounds."""
    best, candidate = search.best, search.candidate
    first = candidate.accepted & ~best.accepted
    better = candidate.accepted & best.accepted & (candidate.cost < best.cost)
    tried = best._replace(work=select(search.active, candidate.work, best.work))
    best_now = select(search.active & (better | ~best.accepted), candidate, tried)
    shorter = should_backtrack(against, candidate, search.length)
    further = should_extend(against, better, search.length)
    continues = jnp.where(first, should_repeat(against, candidate), jnp.where(best.accepted, further, shorter))
    change = step_between(against.cameras, best_now.cameras, against.options), best_now.points - against.previous.points
    origin = select(best_now.accepted, (best_now.cameras, best_now.points), (against.cameras, against.previous.points))
    return search._replace(
        best=best_now,
        cameras=origin[0],
        points=origin[1],
        direction=select(search.active & first, change, search.direction),
        length=jnp.where(first, 1, jnp.where(best.accepted, 2, SHORTER) * search.length),
        active=search.active & continues,
    )
