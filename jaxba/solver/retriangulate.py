"""Points looked for elsewhere on their rays: what no small step finds.

Bundle adjustment moves every point downhill from where it is. A point that a bold step, a bad start or a wrong depth
took into a valley of its own stays there: behind its cameras, far beyond what it shows, or at a depth where two wrong
rays nearly meet. After convergence such points are what is left of the cost that can still be had, and it can be had
without another linear solve: given the cameras every point is a problem of three unknowns, which is solved from several
depths. Then the adjustment goes on (solver/alternation.py).

Source of the alternation: COLMAP's global refinement (Schoenberger, Frahm 2016, "Structure-from-motion revisited",
section 4.4), bundle adjustment and re-triangulation in turns. Measured: docs/game-tried.md, "Cameras and points".
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import Bool, Float

from jaxba.lm.step import initial_state
from jaxba.model.linearize import slot_costs, slot_frames, view_residuals
from jaxba.model.observations import Views, point_passes
from jaxba.problem import geometry
from jaxba.problem.bundle_problem import BundleProblem, ProblemError
from jaxba.problem.losses import Loss
from jaxba.problem.options import StepOptions
from jaxba.refinement.midpoints import midpoints
from jaxba.refinement.points import refine_points
from jaxba.runtime import process
from jaxba.runtime.compilation import compile_and_run, level_after, program, stages
from jaxba.solver.prepare import explain_start
from jaxba.structure.conventions import components_first, items_first
from jaxba.structure.layout import Layout, build_layout

PLACES = (1.0, 1 / 16, 1 / 4, 1 / 2, 2.0, 16.0, -1.0)
"""Where to start from besides the midpoint of the rays: multiples of a point's distance from the first camera that sees
it. The last is its mirror image, in front of the camera if the point lies behind it. Chosen once, not fitted."""

POINT_ITERATIONS = 6
"""Steps of a point from each place, twice what the learned policy has in an iteration. Chosen once, not fitted."""

VERDICTS = (1 + len(PLACES)) * POINT_ITERATIONS // 3
"""Verdicts on a step, of three point iterations each, that take as long as a search."""

LEAST_GAIN = 1e-3
"""Share of its own cost that a point must gain to be moved: less is the same minimum. Chosen once, not fitted ..."""

NEGLIGIBLE = 1e-6
"""... and share of an average point's cost, at the best places, that this gain must be worth."""


@dataclass(frozen=True)
class Retriangulation:
    """Result of `retriangulate`."""

    problem: BundleProblem
    """The input with some points moved; cameras and all other points are unchanged, bit by bit."""

    moved: int
    """Points that were moved."""

    cost_before: float
    """Pixels squared."""

    cost_after: float
    """Pixels squared; never above the cost before."""

    def pays(self, ftol: float) -> bool:
        """Whether the cost fell by more than `ftol` of it, so that it is worth going on from here."""
        return self.cost_before - self.cost_after > ftol * self.cost_before


class _Found(NamedTuple):
    points: Float[Array, "3 points"]
    moved: Bool[Array, " points"]
    cost_before: Float[Array, ""]
    cost_after: Float[Array, ""]


def retriangulate(problem: BundleProblem, loss: Loss | None = None) -> Retriangulation:
    """Looks for a cheaper place for every point while the cameras stand still.

    A point starts from the midpoint of the rays of its pixels and from several distances from the first camera that
    sees it (`PLACES`), takes `POINT_ITERATIONS` Gauss-Newton steps from each, and moves to the cheapest place, if that
    is worth it (`LEAST_GAIN`) and lies behind no more cameras than where it was.

    Args:
        problem: cameras and points, best at the end of a solve: at a bad start points are fitted to wrong cameras.
        loss: robust loss of the squared whitened residual.

    Returns:
        The problem with the moved points, in float64.

    Raises:
        ProblemError: the cost is not finite.
    """
    with jax.enable_x64(True), process.single_blas_thread():
        layout = build_layout(problem, pairs=False, grid=False)
        order = np.concatenate([np.asarray(members) for members in layout.bucket_points])
        real = order < problem.num_points  # the layout has an empty point besides
        first = np.zeros(problem.num_points, np.int64)
        first[problem.point_index[::-1]] = problem.camera_index[::-1]  # the first observation is written last
        origin = np.zeros((3, len(order)))
        origin[:, real] = components_first(geometry.camera_centers(problem.cameras)[first[order[real]]])
        level = level_after(VERDICTS, stages("acceptance", problem.num_observations))
        search = program(_search, "loss", level=level)
        given = (jax.device_put(layout), problem, jnp.asarray(origin), loss or Loss())
        found = jax.device_get(compile_and_run(search, *given))
        process.release_programs()  # many problems in one process would end it
    if not np.isfinite(found.cost_before):
        raise ProblemError(explain_start(problem))
    points, moved = np.array(problem.points, np.float64), np.asarray(found.moved) & real
    points[order[moved]] = items_first(np.asarray(found.points))[moved]
    return Retriangulation(
        problem.replace(points=points), int(moved.sum()), float(found.cost_before), float(found.cost_after)
    )


def _search(layout: Layout, problem: BundleProblem, origin: Float[Array, "3 points"], loss: Loss) -> _Found:
    """`retriangulate` in layout order; `origin` is where the rays start, in scene units."""
    state = initial_state(layout, problem, StepOptions(loss=loss), jnp.float64)
    frames, start = slot_frames(layout, state.cameras), state.points
    one_pass = point_passes(layout, frames)

    def terms(views: Views) -> list[Array]:
        projection = views.projected()
        behind = projection.inverse_depth > 0  # a camera looks down -z
        return [slot_costs(loss, view_residuals(views, projection)), behind.astype(start.dtype)]

    own, hidden = one_pass(start, terms)

    def visit(best: tuple[Array, Array], place: Float[Array, "3 points"]) -> tuple[tuple[Array, Array], None]:
        points, costs = best
        trial, _ = refine_points(layout, frames, place, loss, POINT_ITERATIONS)
        there, lost = one_pass(trial, terms)
        better = (there < costs) & (lost <= hidden)
        return (jnp.where(better, trial, points), jnp.where(better, there, costs)), None

    places = [origin + factor * (start - origin) for factor in PLACES] + [midpoints(layout, frames)]
    (points, costs), _ = lax.scan(visit, (start, own), jnp.stack(places))
    moved = own - costs > jnp.maximum(LEAST_GAIN * own, NEGLIGIBLE * jnp.mean(costs))
    return _Found(points, moved, jnp.sum(own), jnp.sum(jnp.where(moved, costs, own)))
