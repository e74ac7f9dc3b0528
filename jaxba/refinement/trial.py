"""What becomes of a step: the candidate it leads to, embedded iterations around it, and whether it is accepted.

The linear model is wrong far from where it was made, and mostly wrong locally: points fly off, cameras turn away from
what they see. Repairing that locally is cheap beside a linear solve, and lets bolder steps pass:

1. `refine_points`: every point re-optimised alone at the new cameras; one that the step sent behind a camera starts
   from where it was, and so does one that it sent far away. From their rays they start after the whole step only.
2. `camera_rounds`: where the step did less than half of what the model promised and is not hopeless, cameras alone,
   then points alone again, a few times over as long as that may still lead to acceptance. A step along a curved
   valley comes back to its floor.
3. `trials`: a candidate that is still refused is tried again at a quarter of the length, with 1 and at most one round
   of 2. Where steps are tried again, a camera whose focal length would change its sign stays where it was: an image
   seen in a mirror fits for a while, and there is no way back.
4. `pattern_moves`: an accepted candidate that the linear model did not foresee, or that damping held back, lies on the
   floor of a valley, and so does the start; the way from one to the other is repeated, twice as far each time, with 1
   and one round of 2, as long as that costs less.

None of it takes another linear solve, so it is all one iteration (design, section 2). Where a problem falls into parts
that are judged by themselves (`refinement/subproblems.py`), each has its own share, rounds and verdict. Source: 1 is
Jeong et al. 2012, "embedded point iterations", and Ceres' inner iterations; 2 is resection and intersection (Chen,
Chen, Wang 2019, "Bundle adjustment revisited"), here as a repair of second-order steps; 3 is a backtracking line
search; 4 is the pattern move of direct search (Hooke, Jeeves 1961, "Direct search solution of numerical and statistical
problems").
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Bool, Float, Int

from jaxba.linear.step import Effort, Step
from jaxba.model.linearize import Reference
from jaxba.problem.options import StepOptions
from jaxba.refinement.cameras import refine_cameras
from jaxba.refinement.points import Home
from jaxba.refinement.retraction import move_cameras, step_between
from jaxba.refinement.subproblems import Parts, Search

SHORTER = 0.25
"""Factor on the length of a step that was refused. Measured with 4 trials on Ladybug-49 under lambda 1e-6."""

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

FORESEEN = 0.25
"""Difference of the gain ratio from one up to which a step did what the linear model promised."""

FREE = 0.1
"""Share of damping in a step's curvature up to which damping did not hold it back. A step that did what was promised
and was free is Newton's, and there is nothing to be had beyond its end."""

NEGLIGIBLE = 1e-6
"""Promised decrease relative to the cost that is not worth repairs or further trials. Source: Ceres
function_tolerance."""

ENOUGH = 1e-2
"""Decrease by the points' own iterations, relative to what the step promised, after which they need no further one in
what is tried after the whole step. Where it held for that too, `ceres+refine3` took 34 iterations to 1e-3 on
kitti00vo instead of 22."""

LITTLE_LEFT = 1e-3
"""Promised decrease relative to the cost below which points are refined from both of their starts, which takes as
long again. In every trial it brought no more (docs/game-tried.md, "From both starts")."""


class Trial(NamedTuple):
    """A candidate and the verdict on it, one for every part."""

    cameras: Float[Array, "9 cameras"]
    points: Float[Array, "3 points"]
    cost: Float[Array, "*parts"]
    predicted: Float[Array, "*parts"]  # decrease promised by the linear model at this length
    gain: Float[Array, "*parts"]  # actual over predicted decrease
    accepted: Bool[Array, "*parts"]
    share: Float[Array, "*parts"]  # length relative to the whole step
    repairs: Int[Array, "*parts"]  # camera rounds, further trials and pattern moves that it took


def best_trial(
    parts: Parts,
    cameras: Float[Array, "9 cameras"],
    points: Float[Array, "3 points"],
    cost: Float[Array, "*parts"],
    reference: Reference,
    step: Step,
    options: StepOptions,
    min_gain: float | Float[Array, ""],
    effort: Effort | None = None,
) -> Trial:
    """The first accepted candidate, or the last refused one, of every part.

    Args:
        parts: what is judged by itself.
        cameras: present cameras.
        points: present points.
        cost: their cost, pixels squared.
        reference: costs of the slots there, and depths.
        step: the solution of the damped system; its slope and damped part are those of the parts.
        options: static.
        min_gain: a candidate is accepted if the cost falls and the gain ratio exceeds this.
        effort: number of point iterations, where it is not that of the options.
    """
    point_iterations = options.refinement.points
    if effort is not None:
        point_iterations = jnp.minimum(effort.point_iterations, point_iterations)
    # costs are compared term by term: two sums would cancel in float32
    before = parts.terms(reference.costs, options)
    home = Home.of(parts.layout, points, reference.inverse_depth)
    one, none = jnp.ones_like(cost), jnp.zeros(cost.shape, jnp.int32)
    matters = step.predicted(one) > NEGLIGIBLE * cost
    starts = jnp.where(jnp.all(step.predicted(one) <= LITTLE_LEFT * cost), 2, 1)
    no = jnp.zeros((), bool)
    settled = replace(
        options, refinement=replace(options.refinement, starts="step")
    )  # points that a round finds where their cameras left them

    def settle(
        cameras: Array, points: Array, share: Array, repairs: Array, options: StepOptions, whole: Bool[Array, ""]
    ) -> Trial:
        enough = jnp.where(whole, -jnp.inf, ENOUGH * jnp.sum(step.predicted(share)))
        search = Search(point_iterations, jnp.where(whole, starts, 0), enough)
        points, terms = parts.settle(cameras, points, home, options, search)
        candidate, decrease, predicted = parts.sums(terms), parts.sums(before - terms), step.predicted(share)
        gain = decrease / predicted
        accepted = (decrease > 0) & (candidate <= cost) & (predicted > 0) & (gain > min_gain) & jnp.isfinite(candidate)
        return Trial(cameras, points, candidate, predicted, gain, accepted, share, repairs)

    def candidate(turn: _Turn) -> Trial:
        """The next one, with its camera rounds."""
        best, share = turn.best, jnp.where(turn.best.accepted, turn.best.share, turn.length)
        moved = move_cameras(parts.layout, turn.cameras, parts.of_cameras(turn.length) * turn.way[0], options)
        if options.refinement.trials > 1:
            moved = jnp.where(moved[6] * cameras[6] < 0, turn.cameras, moved)
        there = turn.points + parts.of_points(turn.length) * turn.way[1]
        whole = ~best.accepted & (turn.length == 1)
        trial = settle(moved, there, share, best.repairs + 1, options, jnp.any(whole & turn.going))
        if not options.refinement.camera_rounds:
            return trial

        def repair(round_: tuple[Trial, Array]) -> tuple[Trial, Array]:
            trial, left = round_
            moved = refine_cameras(parts.layout, trial.cameras, trial.points, options)
            again = settle(moved, trial.points, trial.share, trial.repairs + 1, settled, no)
            return _chosen(parts, worth_it(round_), again, trial), left - 1

        def worth_it(round_: tuple[Trial, Array]) -> Bool[Array, "*parts"]:
            trial, left = round_
            lacks = jnp.where(best.accepted, trial.cost >= best.cost, trial.gain < GOOD_GAIN)
            done = rounds - left
            within_reach = trial.gain > jnp.select([done == 0, done == 1], [-jnp.inf, WITHIN_REACH[0]], WITHIN_REACH[1])
            return (left > 0) & lacks & (trial.cost < HOPELESS * cost) & within_reach & matters

        rounds = jnp.where(
            whole, options.refinement.camera_rounds, min(ROUNDS_OF_OTHERS, options.refinement.camera_rounds)
        )
        rounds = jnp.where(turn.going, rounds, 0)
        return lax.while_loop(lambda round_: jnp.any(worth_it(round_)), repair, (trial, rounds))[0]

    def turn_over(turn: _Turn) -> _Turn:
        best, trial = turn.best, candidate(turn)
        first = trial.accepted & ~best.accepted
        better = trial.accepted & best.accepted & (trial.cost < best.cost)
        tried = best._replace(repairs=jnp.where(turn.going, trial.repairs, best.repairs))
        after = _chosen(parts, turn.going & (better | ~best.accepted), trial, tried)
        shorter = ~trial.accepted & (turn.length > shortest) & matters
        if not options.refinement.pattern_moves:
            return turn._replace(best=after, length=SHORTER * turn.length, going=turn.going & shorter)
        foreseen = (jnp.abs(trial.gain - 1) <= FORESEEN) & (trial.repairs == 0) & (step.damped <= FREE * step.slope)
        longer = better & (turn.length < longest)
        goes_on = jnp.where(first, matters & ~foreseen, jnp.where(best.accepted, longer, shorter))
        news = turn.going & first
        way = step_between(cameras, after.cameras, options), after.points - points
        return _Turn(
            after,
            jnp.where(parts.of_cameras(after.accepted), after.cameras, cameras),
            jnp.where(parts.of_points(after.accepted), after.points, points),
            (
                jnp.where(parts.of_cameras(news), way[0], turn.way[0]),
                jnp.where(parts.of_points(news), way[1], turn.way[1]),
            ),
            jnp.where(first, 1, jnp.where(best.accepted, 2, SHORTER) * turn.length),
            turn.going & goes_on,
        )

    shortest, longest = 1.5 * SHORTER ** (options.refinement.trials - 1), 2.0 ** (options.refinement.pattern_moves - 1)
    bad, yes = jnp.full_like(cost, jnp.inf), jnp.ones(cost.shape, bool)
    nothing = Trial(cameras, points, bad, -one, -bad, ~yes, one, none - 1)
    start = _Turn(nothing, cameras, points, (step.cameras, step.points), one, yes)
    if options.refinement.trials == 1 and not options.refinement.pattern_moves:
        return candidate(start)
    # the whole step is the first turn of the loop, so that the program has one copy of all this
    return lax.while_loop(lambda turn: jnp.any(turn.going), turn_over, start).best


class _Turn(NamedTuple):
    """What is tried next, by every part: shorter steps until one is accepted, then pattern moves."""

    best: Trial  # the last that was refused or, from the first accepted one on, the cheapest
    cameras: Float[Array, "9 cameras"]  # from where the next one leads away
    points: Float[Array, "3 points"]
    way: tuple[Float[Array, "9 cameras"], Float[Array, "3 points"]]  # the step, or what led to the first accepted one
    length: Float[Array, "*parts"]  # of the next one, in ways
    going: Bool[Array, "*parts"]  # whether there is a next one


def _chosen(parts: Parts, which: Bool[Array, "*parts"], new: Trial, old: Trial) -> Trial:
    """The new trial of some parts, the old one of the others."""
    facts = [jnp.where(which, *pair) for pair in zip(new[2:], old[2:], strict=True)]
    cameras = jnp.where(parts.of_cameras(which), new.cameras, old.cameras)
    return Trial(cameras, jnp.where(parts.of_points(which), new.points, old.points), *facts)
