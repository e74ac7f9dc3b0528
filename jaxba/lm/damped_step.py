"""One damped step of Levenberg-Marquardt, by the Schur complement.

With residuals `r` and Jacobian `J` (whitened and weighted by the robust loss, model/linearize.py),
the linear model of the cost is

    m(d) = |r + J d|^2 / 2 = f + g.d + d.H d / 2,    g = J^T r,    H = J^T J,

and the damped step d solves `(H + D) d = -g`, where D is `lambda diag(H)` or `lambda I` (times a
constant for cameras). linear/schur.py eliminates the points, a method (lm/method.py) solves for the
cameras, and the points follow.

Source: Triggs et al. 2000, "Bundle Adjustment - A Modern Synthesis", sections 4 and 6."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array
from jaxtyping import Float, Int

from jaxba.linear.schur import DampedSystem, back_substitute, jacobian_product, largest_gradient
from jaxba.lm.method import method_of
from jaxba.model.linearize import Linearization
from jaxba.problem.options import StepOptions
from jaxba.refinement.acceptance import Step
from jaxba.structure.devices import kept, max_over_devices, sum_over_devices
from jaxba.structure.layout import Layout
from jaxba.structure.segment_sums import as_rows, point_sums, tree_sum


def solve_step(
    layout: Layout,
    linear: Linearization,
    cameras: Float[Array, "parameters cameras"],
    points: Float[Array, "3 points"],
    damping: Float[Array, ""],
    options: StepOptions,
    iteration: int | Int[Array, ""] = 0,
) -> Step:
    """Solves `(H + D) d = -g` for cameras and points. The step is non-finite if a factorisation
    failed.

    `linear` is at the current cameras, which define the rotation coordinates, and points, which
    define the coarse space of the two-level preconditioner. `damping` is lambda, dimensionless for
    diagonal scaling. The number of the iteration selects the random clusters of methods that use
    them."""
    forcing = (options.truncated or options.conjugate_gradients).forcing
    system = DampedSystem.of(layout, linear, cameras, points, damping, options)
    system = system._replace(forcing=forcing, iteration=iteration)
    solution = method_of(options).solve(system, options)
    manifold_step = jnp.where(
        layout.camera_seen[:, None], solution.cameras, jnp.zeros_like(solution.cameras)
    )
    point_step = solution.points
    if point_step is None:
        point_step = kept(layout, jnp.stack(back_substitute(system, manifold_step)))
    rotation = jnp.einsum("cij,cj->ci", system.coordinates[1], manifold_step[:, :3])
    camera_step = jnp.concatenate([rotation, manifold_step[:, 3:]], axis=1)
    slope, damped = _slope_and_damping(system, manifold_step, camera_step, point_step)
    if not solution.residual_orthogonal:
        # d.e is not zero: `-g.d - d.H d` takes the place of d.D d, with d.H d = |J d|^2
        change = jacobian_product(layout, linear, manifold_step, point_step)
        damped = slope - sum_over_devices(layout, sum(jnp.sum(m * m) for m in change))
    return Step(
        layout.unknowns.expanded(camera_step.T),
        point_step,
        slope,
        damped,
        largest_gradient(system),
        solution.iterations,
        jnp.asarray(forcing if options.truncated else 0.0, cameras.dtype),
    )


def _slope_and_damping(
    system: DampedSystem, manifold_step: Array, camera_step: Array, point_step: Array
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """`-g.d` and `d.D d`, whose sum gives the decrease of the linear model without cancellation.

    With `(H + D) d = -g - e`, where e is the residual of the linear solve, the decrease is

        m(0) - m(d) = -g.d - d.H d / 2 = (d.D d - g.d + d.e) / 2.

    `d.e` is zero for a factorisation, and for conjugate gradients from zero. The other two terms
    are positive."""
    points = system.points
    cameras = system.cameras
    of_points = (
        jnp.sum(jnp.stack(points.gradient) * point_step),
        jnp.sum(jnp.stack(points.damping) * point_step**2),
    )
    slope, damped = sum_over_devices(system.layout, of_points)
    slope = jnp.sum(cameras.gradient * manifold_step) + slope
    return -slope, jnp.sum(cameras.damping * camera_step**2) + damped


def largest_diagonal(layout: Layout, linear: Linearization) -> Float[Array, ""]:
    """Largest diagonal entry of the undamped `H = J^T J`. Source: the unit of g2o's initial
    lambda."""

    def square(rows):
        return [a * a + b * b for a, b in zip(*rows, strict=True)]

    by_camera = sum_over_devices(
        layout, tree_sum(as_rows(square(linear.camera_jacobian)), layout.camera_levels)
    )
    by_point = jnp.stack(point_sums(layout, square(linear.point_jacobian)))
    return max_over_devices(layout, jnp.maximum(jnp.max(by_camera), jnp.max(by_point)))
