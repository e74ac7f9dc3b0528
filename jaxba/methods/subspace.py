"""Sequential subspace optimisation: the best step in the span of an inexact step and of previous camera steps.

Inexact solvers (a power series, clusters with Richardson iterations, truncated conjugate gradients) leave a part of the
damped system unsolved. The next iteration starts anew with nearly the same operator and leaves the same part again, as
in a stationary iteration, whose error falls by a constant factor. So the step is replaced by the minimum of the damped
linear model over the span of the inexact step and the last accepted camera steps. For a constant system, a fixed
symmetric solver and one previous step this is the preconditioned conjugate gradient method, continued over iterations.

The cost is one product with the reduced camera system per vector of the span. The residual of the result is orthogonal
to the step, so that the predicted decrease needs no further pass over the observations. An exact solver gains nothing:
its step minimises over all steps.

Source: Narkiss and Zibulevsky 2005, "Sequential subspace optimization method for large-scale unconstrained problems";
Knyazev 2001 for conjugate gradients as the optimum in a plane.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from jaxba.linear.cholesky import solve_positive
from jaxba.linear.schur import DampedSystem, apply_reduced
from jaxba.lm.method import StepMethod
from jaxba.problem.options import StepOptions
from jaxba.rotations import left_jacobian

RIDGE = 64.0
"""Machine epsilons added to the unit diagonal of the scaled Gram matrix, whose vectors may be nearly parallel."""


class SubspaceMethod(StepMethod):
    """A method with the last `Refinement.previous_steps` accepted changes of the cameras as its state, newest first."""

    uses_previous_steps = True

    def begin(self, cameras: Float[Array, "parameters cameras"], options: StepOptions) -> Any:
        """Zeros. See `StepMethod`."""
        return jnp.zeros((options.kept_steps, *cameras.shape), cameras.dtype)

    def advance(self, state: Any, change: Float[Array, "parameters cameras"], options: StepOptions) -> Any:
        """See `StepMethod`."""
        return jnp.concatenate([change[None], state])[: options.kept_steps]


def best_in_span(system: DampedSystem, step: Float[Array, "cameras width"]) -> Float[Array, "cameras width"]:
    """The minimum of the damped linear model over the span of a camera step and of the previous steps of the system.

    Args:
        system: the damped system of a `SubspaceMethod`.
        step: the inexact step, in manifold coordinates.

    Returns:
        A camera step in manifold coordinates.
    """
    changes = jnp.asarray(system.layout.unknowns.restricted(system.state))
    product = lambda x: apply_reduced(system, x)
    return with_previous(product, system.cameras.right, step, on_manifold(system.parameters[0], changes))


def with_previous(
    product: Callable[[Array], Array],
    right: Float[Array, "cameras unknowns"],
    step: Float[Array, "cameras unknowns"],
    previous: Float[Array, "steps cameras unknowns"],
) -> Float[Array, "cameras unknowns"]:
    """The minimum of `x.S x / 2 - b.x` over the span of a step and the previous ones.

    Args:
        product: product with S, symmetric positive definite.
        right: b.
        step: the inexact step; a non-finite one gives a non-finite result.
        previous: previous steps; zeros where there are none yet.
    """
    basis = jnp.concatenate([step[None], previous])
    images = jnp.stack([product(each) for each in basis])
    gram = jnp.einsum("icn,jcn->ij", basis, images, precision="highest")
    slopes = jnp.einsum("icn,cn->i", basis, right, precision="highest")
    norm = jnp.sqrt(jnp.diagonal(gram))
    nonzero = ~(norm == 0)  # true for nan, so that it reaches the result
    scale = jnp.where(nonzero, norm, 1)
    ridge = jnp.where(nonzero, RIDGE * float(jnp.finfo(gram.dtype).eps), 1)
    scaled = 0.5 * (gram + gram.T) / scale[:, None] / scale + jnp.diag(ridge)
    weights = solve_positive(scaled[None], (slopes / scale)[None])[0] / scale
    return jnp.einsum("i,icn->cn", weights, basis, precision="highest")


def on_manifold(
    cameras: Float[Array, "parameters cameras"], changes: Float[Array, "steps parameters cameras"]
) -> Float[Array, "steps cameras width"]:
    """Changes of camera parameters (angle-axis rotations) as steps in manifold coordinates, to first order."""
    jacobian = left_jacobian(cameras[:3])
    rotations = jnp.einsum("ijc,sjc->sci", jacobian, changes[:, :3], precision="highest")
    return jnp.concatenate([rotations, jnp.moveaxis(changes[:, 3:], 1, 2)], axis=2)
