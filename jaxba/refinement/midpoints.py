"""Triangulation of points from the rays of their pixels, as an alternative start of embedded point
iterations.

The midpoint is the point nearest to all rays of its pixels, in least squares. With camera centres c
and unit rays u it solves `sum (I - u u^T) X = sum (I - u u^T) c`."""

from __future__ import annotations

import functools

import jax.numpy as jnp
from jax import Array
from jaxtyping import Float, Int

from jaxba.linear.cholesky3 import cholesky3
from jaxba.model import camera
from jaxba.model.linearize import slot_costs, view_residuals
from jaxba.model.observations import Views, point_passes
from jaxba.model.residuals import add_point_terms, points_alone
from jaxba.problem.losses import Loss
from jaxba.refinement.points import PreviousPoints, has_receded, refine_points
from jaxba.runtime import loops
from jaxba.runtime.fusion import compute_in_one_loop
from jaxba.structure.layout import Layout
from jaxba.structure.segment_sums import take_each

# iterations that undistort a pixel: fixed-point for BAL, else Newton's. They need not converge.
UNDISTORTIONS = 10
# the same within an iteration of the solver, where it is done for every candidate
FEW_UNDISTORTIONS = 3


def midpoints(
    layout: Layout, frames: camera.Frames, undistortions: int = UNDISTORTIONS
) -> Float[Array, "3 points"]:
    """The midpoint of the rays of every point. With parallel rays it is anywhere along them, or
    non-finite. `frames` has the camera of every slot (`linearize.slot_frames`); so many iterations
    remove the distortion."""
    zeros = jnp.zeros((3, layout.num_points), frames.lens[0].dtype)
    sums = point_passes(layout, frames)(zeros, functools.partial(_ray_terms, undistortions))

    def solved(sums: list[Array]) -> list[Array]:
        factor = cholesky3(sums[:6])
        return factor.backward(factor.forward(sums[6:]))

    return jnp.stack(compute_in_one_loop(solved, sums))


def _ray_terms(undistortions: int, views: Views) -> list[Array]:
    """Of every observation the six lower entries of `I - u u^T`, row by row, and the three of `(I -
    u u^T) c`."""
    frame = views.frames
    undistorted = frame.model.undistorted(
        list(frame.lens), frame.which, list(views.pixels), undistortions
    )
    inverse_norm = 1 / jnp.sqrt(
        undistorted[0] * undistorted[0] + undistorted[1] * undistorted[1] + 1
    )
    camera_ray = [undistorted[0] * inverse_norm, undistorted[1] * inverse_norm, -inverse_norm]

    def to_world(vector):
        return [sum(frame.rotation[j][i] * vector[j] for j in range(3)) for i in range(3)]

    offset = list(frame.translation)
    for place in frame.places:  # first from the camera to its frame

        def back(vector, place=place):
            return [sum(place[3 * j + i] * vector[j] for j in range(3)) for i in range(3)]

        camera_ray = back(camera_ray)
        offset = [t + b for t, b in zip(offset, back(place[9:]), strict=True)]
    ray = to_world(camera_ray)
    center = [-x for x in to_world(offset)]
    along = sum(ray[i] * center[i] for i in range(3))
    matrix = [(1.0 if i == j else 0.0) - ray[i] * ray[j] for i in range(3) for j in range(i + 1)]
    right = [center[i] - ray[i] * along for i in range(3)]
    return [jnp.where(views.mask, row, jnp.zeros_like(row)) for row in [*matrix, *right]]


def choose_starts(
    layout: Layout,
    cameras: Float[Array, "parameters cameras"],
    frames: camera.Frames,
    points: Float[Array, "3 points"],
    loss: Loss,
    previous: PreviousPoints,
) -> Float[Array, "2 3 points"]:
    """Two starts for every point: its position after the step and the midpoint of its rays.

    First the one of lower cost, or that has not diverged; then the other one, or the same if there
    is none.

    If the linear model sends a point behind its cameras, or so far away that its gradient vanishes,
    its own steps do not bring it back; the midpoint of its rays does, unless it diverged itself
    (`PreviousPoints`)."""
    middle = midpoints(layout, frames, FEW_UNDISTORTIONS)

    def terms(views: Views, front: Array, *other: Array) -> list[Array]:
        found = []
        for start in (views, views._replace(points=jnp.stack(other))):
            projection = start.projected()
            lost = (front & (projection.inverse_depth > 0)).astype(points.dtype)
            found += [
                slot_costs(loss, view_residuals(start, projection)),
                lost,
                projection.inverse_depth,
            ]
        return found

    middle_at_slot = take_each(list(middle), layout.slot_point)
    own, own_lost, own_inverse_depth, costs, lost, other_inverse_depth = point_passes(
        layout, frames
    )(points, terms, previous.front, *middle_at_slot)
    own, costs = (
        add_point_terms(layout, cameras, at, [sums])[0]
        for at, sums in ((points, own), (middle, costs))
    )
    diverged = (own_lost > 0) | has_receded(own_inverse_depth, previous.inverse_depth_sum)
    possible = (
        (lost == 0)
        & ~has_receded(other_inverse_depth, previous.inverse_depth_sum)
        & jnp.isfinite(costs)
    )
    possible = points_alone(layout).where(possible, False)
    better = possible & ((costs < own) | diverged)
    return jnp.stack(
        [jnp.where(better, middle, points), jnp.where(possible & ~better, middle, points)]
    )


def refine_from_starts(
    layout: Layout,
    cameras: Float[Array, "parameters cameras"],
    frames: camera.Frames,
    points: Float[Array, "3 points"],
    loss: Loss,
    iterations: int | Int[Array, ""],
    previous: PreviousPoints,
    starts: int | Int[Array, ""],
    min_decrease: float | Float[Array, ""] = -jnp.inf,
) -> tuple[Float[Array, "3 points"], Float[Array, " points"]]:
    """`refine_points` from one or two starts, of which the result with the lower cost is returned.
    The cost of a point has several minima along its rays. Which is the lowest shows only after a
    few iterations. Arguments as there, after the step; `starts`: 0: from `points`; 1: from the
    likelier of these and the midpoints; 2: from both."""

    def choose(*given):
        return choose_starts(layout, given[0], given[1], given[2], loss, given[3])

    given = cameras, frames, points, previous
    candidates = loops.run_if(starts > 0, choose, given, jnp.stack([points, points]))

    def refine_start(number: Array, best: tuple[Array, Array]) -> tuple[Array, Array]:
        found, costs = refine_points(
            layout, cameras, frames, candidates[number], loss, iterations, previous, min_decrease
        )
        lower = costs < best[1]
        return jnp.where(lower, found, best[0]), jnp.where(lower, costs, best[1])

    infinite = jnp.full_like(points[0], jnp.inf)
    return loops.fori_loop(0, jnp.maximum(starts, 1), refine_start, (points, infinite))
