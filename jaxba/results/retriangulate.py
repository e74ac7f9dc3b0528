"""Retriangulation: global search for the position of every point, with the cameras held fixed.

Bundle adjustment moves every point downhill from where it is. A point that a long step, a bad start
or a wrong depth took to a local minimum stays there: behind its cameras, far too distant, or at a
depth where two wrong rays nearly meet. With the cameras fixed every point is a problem of three
unknowns, which is solved here from several depths, without a linear solve of the whole problem.
Bundle adjustment then continues (results/alternation.py).

Source of the alternation: COLMAP's global refinement (Schoenberger, Frahm 2016,
"Structure-from-motion revisited", section 4.4)."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import Bool, Float, Int

from jaxba.lm.step import initial_state
from jaxba.model.linearize import slot_costs, slot_frames, view_residuals
from jaxba.model.observations import Views, point_passes
from jaxba.model.residuals import add_point_terms, points_alone
from jaxba.problem import geometry
from jaxba.problem.bundle_problem import BundleProblem, ProblemError
from jaxba.problem.facing import facing_away
from jaxba.problem.losses import Loss
from jaxba.problem.options import StepOptions
from jaxba.refinement.midpoints import midpoints
from jaxba.refinement.points import refine_points
from jaxba.runtime import process
from jaxba.runtime.compilation import compile_and_run, program
from jaxba.runtime.numerics import numerics
from jaxba.solver.diagnosis import explain_start
from jaxba.solver.place import check_problem, placed
from jaxba.structure.layout import NO_SYSTEM, Layout, build_layout
from jaxba.typing import ArrayRecord

START_DISTANCES = (1.0, 1 / 16, 1 / 4, 1 / 2, 2.0, 16.0, -1.0)
"""Starts besides the midpoint of the rays: multiples of the distance of a point from the first
camera that sees it. The last one is the mirror image, for points behind that camera. Chosen once,
not fitted."""

POINT_ITERATIONS = 6
"""Gauss-Newton steps of a point from each start, twice those of all embedded iterations. Chosen
once, not fitted."""

EQUIVALENT_STEPS = (1 + len(START_DISTANCES)) * POINT_ITERATIONS // 3
"""Accept decisions with three point iterations each that take as long as a search, to choose the
compilation level."""

BREAK_EVEN = 3_000_000
"""Observations times accept decisions after which a better program has paid
(`benchmarks.compilation`)."""

MIN_RELATIVE_GAIN = 1e-3
"""Smallest decrease, relative to its cost, for which a point is moved: less is the same minimum.
Not fitted."""

MIN_GAIN = 1e-6
"""Smallest decrease for which a point is moved, relative to the mean cost of a point after the
search."""


@dataclass(frozen=True, eq=False, repr=False)
class Retriangulation(ArrayRecord):
    """Result of `retriangulate`."""

    problem: BundleProblem
    """The input with some points moved; cameras and all other points are exactly the same."""

    moved: int
    """Number of points that were moved."""

    cost_before: float
    """Pixels squared."""

    cost_after: float
    """Pixels squared; never above the cost before."""

    def pays(self, ftol: float) -> bool:
        """Whether the cost fell by more than `ftol` times the cost, so that another solve is
        worthwhile."""
        return self.cost_before - self.cost_after > ftol * self.cost_before


def retriangulate(problem: BundleProblem, loss: Loss | None = None) -> Retriangulation:
    """Searches a position with a lower cost for every point, with the cameras held fixed.

    Every point starts from the midpoint of the rays of its pixels and at several distances from the
    first camera that sees it (`START_DISTANCES`), and takes `POINT_ITERATIONS` Gauss-Newton steps
    from each start. It moves to the best result, if the cost falls enough (`MIN_RELATIVE_GAIN`,
    `MIN_GAIN`) and it is behind no more cameras than before. Constant points stay. Images that face
    away from their points are left out, as by `solve`. Best at the end of a solve: at a bad start
    points would be fitted to wrong cameras.

    `loss` is that of the squared whitened residual. Returns the problem with moved points, in
    float64. Raises ProblemError: the cost is not finite."""
    check_problem(problem)
    return retriangulate_without(facing_away(problem), problem, loss)


def retriangulate_without(
    away: Int[np.ndarray, " away"], problem: BundleProblem, loss: Loss | None = None
) -> Retriangulation:
    """`retriangulate` where it is known which images face away."""
    with numerics(np.float64):
        counted, offset, here = placed(problem, away)
        layout = build_layout(here, NO_SYSTEM)
        order, real = layout.points, layout.points < problem.num_points  # without padding points
        first = np.zeros(here.num_points, np.int64)
        # the first observation is written last and stays
        first[here.point_index[::-1]] = here.camera_index[::-1]
        # others stand for rows of points, which stay
        first = np.minimum(first, counted.num_cameras - 1)
        origin = np.zeros((3, len(order)))
        centers = geometry.camera_centers(counted.cameras) - offset
        origin[:, real] = centers[first[order[real]]].T
        level = "quick" if EQUIVALENT_STEPS * here.num_observations < BREAK_EVEN else "full"
        search = program(_search, "loss", level=level)
        arguments = (jax.device_put(layout), here, jnp.asarray(origin), loss or Loss())
        found, moved, before, after = jax.device_get(compile_and_run(search, *arguments))
        process.release_programs()  # see `release_programs`: too many programs end a process
    if not np.isfinite(before):
        raise ProblemError(explain_start(problem, loss))
    points = np.array(problem.points, np.float64)
    moved = np.asarray(moved) & real
    points[order[moved]] = np.asarray(found).T[moved] + offset
    return Retriangulation(
        problem.replace(points=points), int(moved.sum()), float(before), float(after)
    )


def _search(
    layout: Layout, problem: BundleProblem, origin: Float[Array, "3 points"], loss: Loss
) -> tuple[Float[Array, "3 points"], Bool[Array, " points"], Array, Array]:
    """`retriangulate` in layout order, with the centre of the first camera of each point as
    `origin`, scene units: points, which of them moved, and the cost before and after."""
    state = initial_state(layout, problem, StepOptions(loss=loss), jnp.float64)
    frames = slot_frames(layout, state.cameras)
    start = state.points
    one_pass = point_passes(layout, frames)

    def terms(views: Views) -> list[Array]:
        projection = views.projected()
        behind = projection.inverse_depth > 0  # a camera looks down -z
        return [slot_costs(loss, view_residuals(views, projection)), behind.astype(start.dtype)]

    def evaluate(points: Float[Array, "3 points"]) -> tuple[Array, Array]:
        costs, hidden = one_pass(points, terms)
        return add_point_terms(layout, state.cameras, points, [costs])[0], hidden

    (own, hidden) = evaluate(start)
    alone = points_alone(layout)

    def try_start(
        best: tuple[Array, Array], position: Float[Array, "3 points"]
    ) -> tuple[tuple[Array, Array], None]:
        points, costs = best
        position = alone.where(position, start)
        trial, _ = refine_points(layout, state.cameras, frames, position, loss, POINT_ITERATIONS)
        trial_costs, lost = evaluate(trial)
        better = (trial_costs < costs) & (lost <= hidden)
        return (jnp.where(better, trial, points), jnp.where(better, trial_costs, costs)), None

    starts = [origin + factor * (start - origin) for factor in START_DISTANCES] + [
        midpoints(layout, frames)
    ]
    (points, costs), _ = lax.scan(try_start, (start, own), jnp.stack(starts))
    costs = alone.where(costs, own)
    moved = own - costs > jnp.maximum(MIN_RELATIVE_GAIN * own, MIN_GAIN * jnp.mean(costs))
    before = jnp.sum(own)
    # XLA may sum the same numbers in two orders: where nothing moves the cost stays to the last
    # digit
    after = jnp.where(jnp.any(moved), jnp.sum(jnp.where(moved, costs, own)), before)
    return points, moved, before, after
