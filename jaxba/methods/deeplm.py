"""Conjugate gradients on the whole normal equations `(H + D) d = -g`, no variable eliminated (global DeepLM).

Cameras and points are solved for together, preconditioned by their 9 x 9 and 3 x 3 diagonal blocks. A product takes two
passes over the observations and no block of the reduced camera system is ever formed, so memory grows with the
observations alone.

Source: Huang et al. 2021, "DeepLM: Large-scale Nonlinear Least Squares on Deep Learning Frameworks using Stochastic
Domain Decomposition", and the authors' code. There, columns are divided by `1 + |J_j|` before damping, which only
moves the clamp of the diagonal: ours is Ceres'. The recomputation of the residual every ten iterations is left out.
"""

from __future__ import annotations

import functools
import operator

import jax.numpy as jnp
from jax import Array
from jaxtyping import Float, Int

from jaxba.linear.conjugate_gradients import conjugate_gradients
from jaxba.linear.preconditioners import block_inverse
from jaxba.linear.schur import CameraSystem, PointSystem
from jaxba.model.linearize import Linearization
from jaxba.problem.options import StepOptions
from jaxba.structure.layout import Layout
from jaxba.structure.segment_sums import as_rows, point_sums, take_each, tree_sum


def image(
    layout: Layout, linear: Linearization, cameras: Float[Array, "cameras 9"], points: Float[Array, "3 points"]
) -> list[Array]:
    """`J d` of every slot, two vectors, pixels."""
    by_camera, by_point = take_each(cameras.T, layout.slot_camera), take_each(points, layout.slot_point)
    rows = zip(linear.camera_jacobian, linear.point_jacobian, strict=True)
    dot = lambda a, b: functools.reduce(operator.add, [x * y for x, y in zip(a, b, strict=True)])
    return [dot(c, by_camera) + dot(p, by_point) for c, p in rows]


def solve_normal(
    layout: Layout,
    linear: Linearization,
    points: PointSystem,
    system: CameraSystem,
    options: StepOptions,
    forcing: float | Float[Array, ""],
) -> tuple[Float[Array, "cameras 9"], Float[Array, "3 points"], Int[Array, ""]]:
    """Solves for cameras (manifold coordinates) and points at once.

    Args:
        layout: slots.
        linear: Jacobians and residuals.
        points: factored diagonal blocks and damping of the points.
        system: damped diagonal blocks of the cameras.
        options: stopping rule of conjugate gradients ...
        forcing: ... and its forcing term.

    Returns:
        The two parts of the step and the number of iterations.
    """
    cameras = system.gradient.shape[0]
    join = lambda c, p: jnp.concatenate([c.reshape(-1), p.reshape(-1)])
    part = lambda x: (x[: 9 * cameras].reshape(cameras, 9), x[9 * cameras :].reshape(3, -1))
    point_damping = jnp.stack(points.damping)
    inverse = block_inverse(system.blocks)

    def apply(x: Array) -> Array:
        c, p = part(x)
        moved = image(layout, linear, c, p)
        pull = lambda first, second: [a * moved[0] + b * moved[1] for a, b in zip(first, second, strict=True)]
        back = tree_sum(as_rows(pull(*linear.camera_jacobian)), layout.camera_levels)
        back = back + jnp.einsum("cab,cb->ca", system.only_damping, c)
        return join(back, jnp.stack(point_sums(layout, pull(*linear.point_jacobian))) + point_damping * p)

    def precondition(x: Array) -> Array:
        c, p = part(x)
        return join(inverse(c), jnp.stack(points.factor.backward(points.factor.forward(list(p)))))

    right = -join(system.gradient, jnp.stack(points.gradient))
    found, iterations = conjugate_gradients(
        apply,
        right,
        precondition,
        forcing=forcing,
        tolerance=options.cg_tolerance,
        max_iterations=options.cg_max_iterations,
    )
    return *part(found), iterations
