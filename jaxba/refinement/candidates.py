"""From a damped step to the candidate of an iteration: refinement, backtracking, pattern moves.

The plain algorithm evaluates x + d and accepts or rejects it. The linear model is inaccurate for
long steps, but mostly locally: single points diverge, single cameras turn away from their points.
Local corrections are cheap compared with a linear solve and allow longer steps. `Refinement`
switches on four of them:

1. `points`: every point is re-optimised on its own at the new cameras (points.py, midpoints.py).
2. `camera_rounds`: every camera, then every point is re-optimised on its own, a few times in turn,
   after a candidate that achieved less than half of the predicted decrease but is not far off. A
   step along a curved valley leaves its floor; independent steps of cameras and points return to
   it. Source: resection-intersection (Chen, Chen and Wang 2019, "Bundle adjustment revisited"),
   used here to correct second-order steps.
3. `trials`: a candidate that is still rejected is tried again at a quarter of the length. A camera
   whose focal length would change its sign then keeps its previous parameters; without trials such
   a candidate is rejected.
4. `pattern_moves`: an accepted step is repeated in its direction, each time twice as far, while the
   cost falls. A candidate that the linear model did not predict, or whose length damping limited,
   lies on the floor of a valley, as does the start: the direction between the two follows the
   valley. Source: Hooke and Jeeves 1961, "Direct search solution of numerical and statistical
   problems".

None of these takes another linear solve, so all of them belong to one iteration."""

from __future__ import annotations

from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxba.problem.options import StepOptions
from jaxba.refinement.acceptance import Candidate, Comparison, Step, assess, select
from jaxba.refinement.cameras import refine_cameras
from jaxba.refinement.retraction import keep_focal_signs, move_cameras, step_between
from jaxba.runtime import loops

# factor on the length of a rejected step. Measured with 4 trials on Ladybug-49, lambda 1e-6
SHORTER = 0.25
GOOD_GAIN = 0.5  # gain ratio from which the linear model is trusted and there are no camera rounds
# of a candidate for camera rounds: a limit of 10 ended 19% higher on Ladybug-49, lambda 1e-6
MAX_COST_RATIO = 1.5
# of a candidate after one camera round, and after more, for another: none below was accepted
MIN_GAINS = (-5.0, -0.5)

ROUNDS_OF_LATER_CANDIDATES = 1
"""Most camera rounds of a backtracked candidate or a pattern move. On 457 scenes 6.40 iterations to
1e-4 with none for backtracked candidates, 6.02 with one, 5.88 with three; on real problems three
took a tenth more work than one."""

# difference of the gain ratio from one up to which the linear model predicted the step
GAIN_TOLERANCE = 0.25
# up to which a step is a Gauss-Newton step, and nothing is gained beyond it
SMALL_DAMPING_FRACTION = 0.1


class Search(NamedTuple):
    """The candidates of a step: shorter ones until one is accepted, then pattern moves; after each,
    camera rounds."""

    best: Candidate  # the last rejected one or, once one was accepted, the one with the lowest cost
    cameras: Float[Array, "parameters cameras"]  # origin of the next candidate
    points: Float[Array, "3 points"]
    # the step, or the change by the first accepted candidate
    direction: tuple[Float[Array, "parameters cameras"], Float[Array, "3 points"]]
    length: Float[Array, ""]  # of the next candidate, in units of `direction`
    active: Bool[Array, ""]  # whether there is a next candidate
    candidate: Candidate  # the one that camera rounds improve
    rounds: Int[Array, ""]  # its camera rounds so far
    refining: Bool[Array, ""]  # whether it has another one, before there is a next candidate


def best_candidate(against: Comparison) -> Candidate:
    """Evaluates a step: the candidate of the iteration, with the accept decision.

    It is the first accepted candidate, possibly extended by pattern moves, or the last rejected
    one."""
    options = against.options
    start = first_search(against.cameras, against.previous.points, against.cost, against.step)
    start = jax.tree.map(jnp.asarray, start)
    if not has_repairs(options):
        return _assess_next(against, start, start.cameras)

    def advance(search: Search) -> Search:
        last = search.candidate
        refined = search.cameras
        if options.refinement.camera_rounds:

            def refine(cameras, points):
                return refine_cameras(against.layout, cameras, points, options)

            refined = loops.run_if(
                search.refining, refine, (last.cameras, last.points), last.cameras
            )
        return next_search(against, search, refined)

    # full step, shorter steps, pattern moves and camera rounds are iterations of one loop, so that
    # the program contains the evaluation of a candidate only once
    return loops.while_loop(lambda search: search.active, advance, start).best


def has_repairs(options: StepOptions) -> bool:
    """Whether there may be more than one candidate."""
    refinement = options.refinement
    return refinement.trials > 1 or bool(refinement.pattern_moves) or bool(refinement.camera_rounds)


def first_search(cameras: Any, points: Any, cost: Any, step: Step) -> Search:
    """The search whose next candidate is the full step.

    What it adds are NumPy's arrays: outside of a program each conversion by JAX is a program.
    Cameras [9, cameras] and points [3, points] are the current ones: arrays, or their shapes and
    types. `cost` is theirs, pixels^2, and `step` the solution of the damped system."""

    def constant(value, dtype):
        return cast(Array, np.full(cost.shape, value, dtype))

    one = constant(1, cost.dtype)
    infinite = constant(np.inf, cost.dtype)
    yes = constant(1, bool)
    no = constant(0, bool)
    initial = Candidate(cameras, points, infinite, -one, -infinite, no, one, constant(-1, np.int32))
    return Search(
        initial,
        cameras,
        points,
        (step.cameras, step.points),
        one,
        yes,
        initial,
        constant(0, np.int32),
        no,
    )


def _assess_next(
    against: Comparison, search: Search, refined: Float[Array, "parameters cameras"]
) -> Candidate:
    """Evaluates the next candidate or, where that is due, a camera round of the last one."""
    best = search.best
    cameras = move_cameras(
        against.layout, search.cameras, search.length * search.direction[0], against.options
    )
    if against.options.refinement.trials > 1:
        cameras = jnp.where(keep_focal_signs(search.cameras, cameras), cameras, search.cameras)
    points = search.points + search.length * search.direction[1]
    fraction = jnp.where(best.accepted, best.step_fraction, search.length)
    full_step = _is_full_step(search) & search.active
    last = search.candidate
    refining = search.refining
    cameras, points, fraction, repairs = select(
        refining,
        (refined, last.points, last.step_fraction, last.repairs),
        (cameras, points, fraction, best.repairs),
    )
    return assess(against, cameras, points, fraction, repairs + 1, full_step & ~refining)


def _is_full_step(search: Search) -> Bool[Array, ""]:
    return ~search.best.accepted & (search.length == 1)


def next_search(
    against: Comparison, search: Search, refined: Float[Array, "parameters cameras"]
) -> Search:
    """Evaluates a candidate or a camera round, and decides what comes after it. `refined` are the
    cameras after a camera round of `search.candidate`, where `search.refining`; else any."""
    candidate = _assess_next(against, search, refined)
    rounds = jnp.where(search.refining, search.rounds + 1, 0)
    full_step = _is_full_step(search)
    refining = (
        _has_another_round(against, candidate, search.best, full_step, rounds) & search.active
    )
    same = search._replace(candidate=candidate, rounds=rounds, refining=refining)
    return select(refining, same, _after_candidate(against, same))


def _after_candidate(against: Comparison, search: Search) -> Search:
    """What to try after a candidate that has had its camera rounds."""
    best = search.best
    candidate = search.candidate
    first = candidate.accepted & ~best.accepted
    better = candidate.accepted & best.accepted & (candidate.cost < best.cost)
    tried = best._replace(repairs=jnp.where(search.active, candidate.repairs, best.repairs))
    best_now = select(search.active & (better | ~best.accepted), candidate, tried)
    refinement = against.options.refinement
    shortest = 1.5 * SHORTER ** (refinement.trials - 1)
    shorter = ~candidate.accepted & (search.length > shortest) & against.matters
    further = better & (search.length < 2.0 ** (refinement.pattern_moves - 1))
    continues = jnp.where(
        first, _is_repeated(against, candidate), jnp.where(best.accepted, further, shorter)
    )
    change = (
        step_between(against.cameras, best_now.cameras, against.options),
        best_now.points - against.previous.points,
    )
    origin = select(
        best_now.accepted,
        (best_now.cameras, best_now.points),
        (against.cameras, against.previous.points),
    )
    return search._replace(
        best=best_now,
        cameras=origin[0],
        points=origin[1],
        direction=select(search.active & first, change, search.direction),
        length=jnp.where(first, 1, jnp.where(best.accepted, 2, SHORTER) * search.length),
        active=search.active & continues,
    )


def _has_another_round(
    against: Comparison,
    candidate: Candidate,
    best: Candidate,
    full_step: Bool[Array, ""],
    done: Int[Array, ""],
) -> Bool[Array, ""]:
    """Whether a camera round, or another one, may lead to the acceptance of a candidate."""
    most = against.options.refinement.camera_rounds
    limit = jnp.where(full_step, most, min(ROUNDS_OF_LATER_CANDIDATES, most))
    insufficient = jnp.where(best.accepted, candidate.cost >= best.cost, candidate.gain < GOOD_GAIN)
    promising = candidate.gain > jnp.select(
        [done == 0, done == 1], [-jnp.inf, MIN_GAINS[0]], MIN_GAINS[1]
    )
    near = candidate.cost < MAX_COST_RATIO * against.cost
    return (done < limit) & insufficient & near & promising & against.matters


def _is_repeated(against: Comparison, first: Candidate) -> Bool[Array, ""]:
    """Whether the first accepted candidate is repeated in its direction: not if the linear model
    predicted it."""
    undamped = against.step.damped <= SMALL_DAMPING_FRACTION * against.step.slope
    predicted = (jnp.abs(first.gain - 1) <= GAIN_TOLERANCE) & (first.repairs == 0) & undamped
    return bool(against.options.refinement.pattern_moves) & against.matters & ~predicted
