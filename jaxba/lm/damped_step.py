"""One damped step: eliminate the points, solve for the cameras, carry back to the points.

The step solves `(H + D) d = -g`. Elimination: linear/schur.py; solvers of the reduced camera system:
linear/reduced_system.py.
"""

from __future__ import annotations

from typing import cast

import jax.numpy as jnp
from jax import Array
from jaxtyping import Float, Int

from jaxba.linear.reduced_system import solve_reduced
from jaxba.linear.schur import (
    CameraSystem,
    PointSystem,
    RotationCoordinates,
    back_substitute,
    camera_system,
    eliminate_points,
    jacobian_product,
    largest_gradient,
)
from jaxba.linear.step import Effort, Step
from jaxba.linear.two_level import Anchor
from jaxba.lm.method import DampedSystem, MethodStep, StepMethod
from jaxba.model import camera
from jaxba.model.linearize import Linearization
from jaxba.problem.options import StepOptions
from jaxba.structure.conventions import components_first
from jaxba.structure.layout import Layout
from jaxba.structure.segment_sums import as_rows, point_sums, tree_sum


def solve_step(
    layout: Layout,
    linear: Linearization,
    cameras: Float[Array, "9 cameras"],
    points: Float[Array, "3 points"],
    damping: Float[Array, ""],
    options: StepOptions,
    iteration: int | Int[Array, ""] = 0,
    effort: Effort | None = None,
    previous: Float[Array, "steps 9 cameras"] | None = None,
) -> Step:
    """One damped step.

    Args:
        layout: slots; must hold pairs unless the options never form the reduced system.
        linear: Jacobians and residuals at the current parameters.
        cameras: current cameras, for the rotation coordinates.
        points: current points, for the directions of the coarse system.
        damping: lambda, dimensionless for diagonal scaling.
        options: solver, scaling, coordinates.
        iteration: its number, where the step depends on it (random clusters).
        effort: forcing term of conjugate gradients, where it is not that of the options.
        previous: last changes of the cameras, if the step is to be the best one together with them.

    Returns:
        The step; not finite where the factorisation failed, which the caller treats as a rejection.
    """
    truncated = options.truncated
    forcing = options.conjugate_gradients.forcing if truncated is None else truncated.forcing
    if effort is not None and effort.forcing is not None:
        forcing = effort.forcing
    coordinates = RotationCoordinates.of(cameras, options)
    eliminated = eliminate_points(layout, linear, damping, options)
    reduced = camera_system(layout, linear, eliminated, coordinates, damping, options)
    if options.method is None:
        frames = camera.frames(cameras)
        anchor = Anchor(jnp.asarray(frames.rotation), jnp.asarray(frames.translation), points)
        solved = solve_reduced(layout, linear, eliminated, reduced, anchor, options, forcing)
        found = MethodStep(solved[0], None, solved[1], residual_orthogonal=True)
    else:
        system = DampedSystem(layout, linear, eliminated, reduced, damping)
        method = cast(StepMethod, options.method)
        found = method.solve(system, options, forcing, iteration, cameras, previous)
    step = jnp.where(layout.camera_seen[:, None], found.cameras, jnp.zeros_like(found.cameras))
    point_step = found.points
    if point_step is None:
        point_step = jnp.stack(back_substitute(layout, linear, eliminated, step))
    camera_step = coordinates.given(step)
    slope, damped = _slope_and_damping(eliminated, reduced, step, camera_step, point_step)
    if not found.residual_orthogonal:
        damped = slope - sum(jnp.sum(m * m) for m in jacobian_product(layout, linear, step, point_step))
    return Step(
        components_first(camera_step),
        point_step,
        slope,
        damped,
        largest_gradient(eliminated, reduced, coordinates),
        found.iterations,
        jnp.asarray(0.0 if truncated is None else forcing, cameras.dtype),
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
