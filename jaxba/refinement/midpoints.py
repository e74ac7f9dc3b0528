"""Points from the rays of their pixels: where a point may start when its cameras have moved."""

from __future__ import annotations

import functools
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Float, Int

from jaxba.linear.cholesky3 import cholesky3
from jaxba.model import camera
from jaxba.model.linearize import slot_costs, view_residuals
from jaxba.model.observations import Views, point_passes
from jaxba.problem.losses import Loss
from jaxba.refinement.points import PreviousPoints, gone, refine_points
from jaxba.structure.layout import Layout
from jaxba.structure.segment_sums import take_each

UNDISTORTIONS = 10
"""Fixed-point iterations that turn a pixel into a ray; what they leave open the point's own steps make good ..."""

FEW_UNDISTORTIONS = 3
"""... and so many within a step, where it is done again and again."""


def midpoints(layout: Layout, frames: camera.Frames, undistortions: int = UNDISTORTIONS) -> Float[Array, "3 points"]:
    """The point nearest to all rays of its pixels, in least squares; anywhere along them, or not finite, where they are
    parallel.

    Args:
        layout: slots.
        frames: of every slot (`linearize.slot_frames`).
        undistortions: fixed-point iterations.
    """
    nowhere = jnp.zeros((3, layout.num_points), frames.focal.dtype)
    sums = point_passes(layout, frames)(nowhere, functools.partial(_ray_terms, undistortions))
    factor = cholesky3(sums[:6])
    return jnp.stack(factor.backward(factor.forward(sums[6:])))


def _ray_terms(undistortions: int, views: Views) -> list[Array]:
    """Of every observation the lower entries of `I - u u^T` (row by row) and `(I - u u^T) c`, for its ray u and the
    centre c of its camera. Their sums are the normal equations of the point nearest to its rays."""
    frame, pixel = views.frames, [row.astype(views.frames.focal.dtype) for row in views.pixels]
    scaled = [row / frame.focal for row in pixel]
    plane = scaled
    for _ in range(undistortions):
        squared = plane[0] * plane[0] + plane[1] * plane[1]
        less = 1 / (1 + squared * (frame.k1 + squared * frame.k2))
        plane = [row * less for row in scaled]
    short = 1 / jnp.sqrt(plane[0] * plane[0] + plane[1] * plane[1] + 1)
    inside = [plane[0] * short, plane[1] * short, -short]
    turned = lambda vector: [sum(frame.rotation[j][i] * vector[j] for j in range(3)) for i in range(3)]
    ray, center = turned(inside), [-x for x in turned(frame.translation)]
    along = sum(ray[i] * center[i] for i in range(3))
    matrix = [(1.0 if i == j else 0.0) - ray[i] * ray[j] for i in range(3) for j in range(i + 1)]
    right = [center[i] - ray[i] * along for i in range(3)]
    return [jnp.where(views.mask, row, jnp.zeros_like(row)) for row in [*matrix, *right]]


class Starts(NamedTuple):
    """Two places for every point."""

    likely: Float[Array, "3 points"]  # the cheaper one, or the one that is not diverged
    other: Float[Array, "3 points"]  # the same where there is no other


def better_starts(
    layout: Layout, frames: camera.Frames, points: Float[Array, "3 points"], loss: Loss, previous: PreviousPoints
) -> Starts:
    """Where the step took a point and the midpoint of its rays, if that is a place to start (`refine.PreviousPoints`).

    A step moves points by a linear model. Where that sends one behind its cameras, or so far away or so near that it
    feels nothing any more, no small step of its own finds back; the rays of its pixels say where to look.

    Args:
        layout: slots.
        frames: of every slot, where the cameras are now.
        points: where the step took them.
        loss: robust loss.
        previous: where they were before.
    """
    middle = midpoints(layout, frames, FEW_UNDISTORTIONS)

    def terms(views: Views, front: Array, *other: Array) -> list[Array]:
        found = []
        for place in (views, views._replace(points=jnp.stack(other))):
            projection = place.projected()
            lost = (front & (projection.inverse_depth > 0)).astype(points.dtype)
            found += [slot_costs(loss, view_residuals(place, projection)), lost, projection.inverse_depth]
        return found

    there = take_each(list(middle), layout.slot_point)
    own, own_lost, nearness, costs, lost, other = point_passes(layout, frames)(points, terms, previous.front, *there)
    diverged = (own_lost > 0) | gone(nearness, previous.nearness)
    possible = (lost == 0) & ~gone(other, previous.nearness) & jnp.isfinite(costs)
    better = possible & ((costs < own) | diverged)
    return Starts(jnp.where(better, middle, points), jnp.where(possible & ~better, middle, points))


def refine_from_starts(
    layout: Layout,
    frames: camera.Frames,
    points: Float[Array, "3 points"],
    loss: Loss,
    iterations: int | Int[Array, ""],
    previous: PreviousPoints,
    starts: int | Int[Array, ""],
    enough: float | Float[Array, ""] = -jnp.inf,
) -> tuple[Float[Array, "3 points"], Float[Array, " points"]]:
    """As `refine_points`, from where the step took the points, from the likelier of two starts, or from both, of which
    the cheaper end counts.

    A point has several minima along its rays, and the one that it is in need not be the lowest; which one that is shows
    after a few steps of its own only.

    Args:
        layout: slots.
        frames: of every slot, where the cameras are now.
        points: where the step took them.
        loss: robust loss.
        iterations: steps per point and start.
        previous: where points were before.
        starts: 0, 1 or 2: where the step took them, the likelier of that and their rays, or both.
        enough: see `refine_points`.
    """
    # a loop of at most one turn: under vmap a condition would be computed either way
    places = lambda _, __: jnp.stack(better_starts(layout, frames, points, loss, previous))
    places = lax.fori_loop(0, jnp.minimum(starts, 1), places, jnp.stack([points, points]))

    def visit(turn: Array, best: tuple[Array, Array]) -> tuple[Array, Array]:
        found, costs = refine_points(layout, frames, places[turn], loss, iterations, previous, enough)
        lower = costs < best[1]
        return jnp.where(lower, found, best[0]), jnp.where(lower, costs, best[1])

    nowhere = jnp.full_like(points[0], jnp.inf)
    return lax.fori_loop(0, jnp.maximum(starts, 1), visit, (points, nowhere))
