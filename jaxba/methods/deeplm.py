"""DeepLM's global solver (`deeplm`): conjugate gradients on the normal equations `(H + D) d = -g`,
without elimination.

Cameras and points are solved for together, preconditioned by their 9 x 9 and 3 x 3 diagonal blocks.
A product takes two passes over the observations. No reduced camera system is formed: memory is
linear in the observations.

Source: Huang et al. 2021, "DeepLM: Large-scale Nonlinear Least Squares on Deep Learning Frameworks
using Stochastic Domain Decomposition", and the authors' code. Two differences: the authors divide
the columns of J by `1 + |J_j|` before damping, where we clamp the diagonal as Ceres does; and they
recompute the residual every ten iterations."""

from __future__ import annotations

from dataclasses import dataclass, field

import jax.numpy as jnp
from jax import Array
from jaxtyping import Float, Int

from jaxba.linear.conjugate_gradients import conjugate_gradients
from jaxba.linear.preconditioners import block_inverse
from jaxba.linear.schur import CameraSystem, DampedSystem, PointSystem, jacobian_product
from jaxba.lm.method import MethodStep, StepMethod
from jaxba.model.linearize import Linearization
from jaxba.problem.options import ConjugateGradients, StepOptions
from jaxba.structure.layout import Layout
from jaxba.structure.segment_sums import as_rows, point_sums, tree_sum


@dataclass(frozen=True)
class GlobalConjugateGradients(StepMethod):
    """The method `deeplm`."""

    # stopping rule; the preconditioner field is ignored. Source of 1e-3 and 150: the authors' code.
    conjugate_gradients: ConjugateGradients = field(
        default_factory=lambda: ConjugateGradients(forcing=1e-3, max_iterations=150)
    )

    name = "deeplm"

    def solve(self, system: DampedSystem, options: StepOptions) -> MethodStep:
        """See `StepMethod`."""
        rule = self.conjugate_gradients
        step, points, iterations = solve_normal(*system[:4], rule, system.forcing)
        return MethodStep(step, points, iterations, True)


def solve_normal(
    layout: Layout,
    linear: Linearization,
    points: PointSystem,
    system: CameraSystem,
    rule: ConjugateGradients,
    forcing: float | Float[Array, ""],
) -> tuple[Float[Array, "cameras width"], Float[Array, "3 points"], Int[Array, ""]]:
    """Solves `(H + D) d = -g` for cameras and points together. `points` has factored, `system`
    damped diagonal blocks; `rule` has tolerance and iteration limit of conjugate gradients,
    `forcing` is their forcing term. Returns the camera step (manifold coordinates), the point step,
    and the number of iterations."""
    cameras, width = system.gradient.shape

    def join(c, p):
        return jnp.concatenate([c.reshape(-1), p.reshape(-1)])

    def split(x):
        return (
            x[: width * cameras].reshape(cameras, width),
            x[width * cameras :].reshape(3, -1),
        )

    point_damping = jnp.stack(points.damping)
    inverse = block_inverse(system.blocks)

    def apply(x: Array) -> Array:
        c, p = split(x)
        product = jacobian_product(layout, linear, c, p)

        def transposed(first, second):
            return [a * product[0] + b * product[1] for a, b in zip(first, second, strict=True)]

        by_camera = tree_sum(as_rows(transposed(*linear.camera_jacobian)), layout.camera_levels)
        by_camera = by_camera + jnp.einsum("cab,cb->ca", system.own, c)
        return join(
            by_camera,
            jnp.stack(point_sums(layout, transposed(*linear.point_jacobian))) + point_damping * p,
        )

    def precondition(x: Array) -> Array:
        c, p = split(x)
        return join(inverse(c), jnp.stack(points.factor.backward(points.factor.forward(list(p)))))

    right = -join(system.gradient, jnp.stack(points.gradient))
    found, iterations = conjugate_gradients(
        apply,
        right,
        precondition,
        forcing=forcing,
        tolerance=rule.tolerance,
        max_iterations=rule.max_iterations,
    )
    return *split(found), iterations
