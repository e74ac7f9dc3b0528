"""One damped step: eliminate the points, solve for the cameras, carry back to the points.

The step solves `(H + D) d = -g`. Elimination: linear/schur.py; solvers of the reduced camera system:
linear/reduced_system.py.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array
from jaxtyping import Float, Int

from jaxba.linear.reduced_system import solve_reduced
from jaxba.linear.schur import (
    CameraSystem,
    Coordinates,
    PointSystem,
    apply_reduced,
    back_substitute,
    camera_system,
    eliminate_points,
    largest_gradient,
)
from jaxba.linear.two_level import Anchor
from jaxba.lm.effort import Effort
from jaxba.methods.deeplm import image, solve_normal
from jaxba.methods.stba import clustered_step
from jaxba.methods.subspace import on_manifold, with_remembered
from jaxba.model import camera
from jaxba.model.linearize import Linearization
from jaxba.problem.options import StepOptions
from jaxba.structure.layout import Layout, partition_of
from jaxba.structure.segment_sums import as_rows, point_sums, tree_sum


class Step(NamedTuple):
    """A step and what the linear model says about it."""

    cameras: Float[Array, "9 cameras"]  # in the coordinates of the options
    points: Float[Array, "3 points"]
    # of the whole, or of every part that is judged by itself (refinement/subproblems.py):
    slope: Float[Array, "*parts"]  # -g.d = d.(H + D) d, pixels^2
    damped: Float[Array, "*parts"]  # d.D d, pixels^2; of a step that solves no system, what -g.d exceeds d.H d by
    gradient_max: Float[Array, ""]  # largest entry of the gradient before the step
    cg_iterations: Int[Array, ""]  # 0 when the system was factored
    forcing: Float[Array, ""]  # term by which they ended, 0 where that is not by one

    def predicted(self, share: Float[Array, "*parts"]) -> Float[Array, "*parts"]:
        """Decrease of the cost that the linear model promises at a share of the step, pixels^2."""
        return share * (0.5 * share * self.damped + (1 - 0.5 * share) * self.slope)


def solve_step(
    layout: Layout,
    linear: Linearization,
    cameras: Float[Array, "9 cameras"],
    points: Float[Array, "3 points"],
    damping: Float[Array, ""],
    options: StepOptions,
    turn: int | Int[Array, ""] = 0,
    effort: Effort | None = None,
    remembered: Float[Array, "steps 9 cameras"] | None = None,
) -> Step:
    """One damped step.

    Args:
        layout: slots; must hold pairs unless the options never form the reduced system.
        linear: Jacobians and residuals at the current parameters.
        cameras: current cameras, for the rotation coordinates.
        points: current points, for the directions of the coarse system.
        damping: lambda, dimensionless for diagonal scaling.
        options: solver, scaling, coordinates.
        turn: number of the iteration, where the step depends on it (random clusters).
        effort: forcing term of conjugate gradients, where it is not that of the options.
        remembered: last changes of the cameras, if the step is to be the best one together with them.

    Returns:
        The step; not finite where the factorisation failed, which the caller treats as a rejection.
    """
    forcing = options.cg_forcing if effort is None or effort.forcing is None else effort.forcing
    coordinates = Coordinates.of(cameras, options)
    frames = camera.frames(cameras)
    anchor = Anchor(jnp.asarray(frames.rotation), jnp.asarray(frames.translation), points)
    eliminated = eliminate_points(layout, linear, damping, options)
    system = camera_system(layout, linear, eliminated, coordinates, damping, options)
    point_step = None
    if options.linear_solver == "normal":
        step, point_step, iterations = solve_normal(layout, linear, eliminated, system, options, forcing)
    elif options.linear_solver == "clustered":
        partition = partition_of(layout).at(turn)
        step = clustered_step(layout, linear, eliminated, system, damping, partition, options)
        iterations = jnp.zeros((), jnp.int32)
    else:
        step, iterations = solve_reduced(layout, linear, eliminated, system, anchor, options, forcing)
    if remembered is not None:  # the points then follow the cameras
        product = lambda x: apply_reduced(layout, linear, eliminated, system, x)
        step, point_step = with_remembered(product, system.right, step, on_manifold(cameras, remembered)), None
    step = jnp.where(layout.camera_seen[:, None], step, jnp.zeros_like(step))
    if point_step is None:
        point_step = jnp.stack(back_substitute(layout, linear, eliminated, step))
    camera_step = coordinates.given(step)
    slope, damped = _slope_and_damping(eliminated, system, step, camera_step, point_step)
    if options.leaves_rest and remembered is None:
        damped = slope - sum(jnp.sum(m * m) for m in image(layout, linear, step, point_step))
    return Step(
        camera_step.T,
        point_step,
        slope,
        damped,
        largest_gradient(eliminated, system, coordinates),
        iterations,
        jnp.asarray(forcing if options.inexact else 0.0, cameras.dtype),
    )


def _slope_and_damping(
    points: PointSystem, system: CameraSystem, step: Array, camera_step: Array, moves: Array
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """`-g.d` and `d.D d`, from which the linear model's decrease follows as a sum that does not cancel.

    For steps that solve the system. The decrease is `-(g.d + d.H d / 2)`. `(H + D) d = -g - rest` turns it into
    `(d.D d - g.d - d.rest) / 2`. The rest is zero for a factored system, and orthogonal to the step for conjugate
    gradients started at zero, as for the best step of a span. Both kept terms are positive.
    """
    slope = jnp.sum(system.gradient * step) + jnp.sum(jnp.stack(points.gradient) * moves)
    damped = jnp.sum(system.damping * camera_step**2) + jnp.sum(jnp.stack(points.damping) * moves**2)
    return -slope, damped


def largest_diagonal(layout: Layout, linear: Linearization) -> Float[Array, ""]:
    """Largest diagonal entry of the undamped Hessian, the unit of g2o's first lambda."""
    square = lambda rows: [a * a + b * b for a, b in zip(*rows, strict=True)]
    by_camera = tree_sum(as_rows(square(linear.camera_jacobian)), layout.camera_levels)
    by_point = jnp.stack(point_sums(layout, square(linear.point_jacobian)))
    return jnp.maximum(jnp.max(by_camera), jnp.max(by_point))
