"""Sequential subspace optimisation: an inexact step, made the best one in the span of it and of earlier steps.

A power series, repaired clusters and truncated conjugate gradients leave a part of the damped system unsolved, and the
next iteration begins anew with the same operator, which leaves the same part again: iterations of a fixed linear
scheme, whose error shrinks by a constant factor. So the step is taken as the minimum of the damped linear model over
the span of what the solver found and of the last accepted camera steps. On one and the same system, with a fixed
symmetric solver and one earlier step, that is the preconditioned method of conjugate gradients, continued from one
iteration to the next; the earlier steps make good what the solver leaves out again and again.

It takes one product with the reduced camera system for each of the steps, the new one included, and as the residual
that is left is orthogonal to the step, promised decreases need no further pass. An exact solver gains nothing: its step
is the minimum over all steps already.

Source: Narkiss and Zibulevsky 2005, "Sequential subspace optimization method for large-scale unconstrained problems";
Knyazev 2001 for conjugate gradients as the optimum in a plane.
"""

from __future__ import annotations

from collections.abc import Callable

import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from jaxba.linear.cholesky import solve_positive
from jaxba.linear.schur import apply_reduced
from jaxba.lm.method import DampedSystem
from jaxba.model import camera

RIDGE = 64.0
"""Rounding units added to the scaled Gram matrix, whose steps may be nearly parallel."""


def best_in_span(
    system: DampedSystem,
    step: Float[Array, "cameras 9"],
    parameters: Float[Array, "9 cameras"],
    previous: Float[Array, "steps 9 cameras"],
) -> Float[Array, "cameras 9"]:
    """The minimum of the damped linear model over the span of a camera step and of earlier changes of the cameras.

    Args:
        system: the damped system, points eliminated.
        step: what a solver found, on the manifold.
        parameters: present cameras.
        previous: last changes of the cameras' parameters, newest first; zeros stand for none.
    """
    product = lambda x: apply_reduced(system.layout, system.linear, system.points, system.cameras, x)
    return with_previous(product, system.cameras.right, step, on_manifold(parameters, previous))


def with_previous(
    product: Callable[[Array], Array],
    right: Float[Array, "cameras unknowns"],
    step: Float[Array, "cameras unknowns"],
    previous: Float[Array, "steps cameras unknowns"],
) -> Float[Array, "cameras unknowns"]:
    """The minimum of `x.S x / 2 - b.x` over the span of a step and the previous ones.

    Args:
        product: `S x`, symmetric positive definite.
        right: `b`.
        step: what a solver found; where it is not finite, neither is the result.
        previous: others; zeros stand for none.
    """
    basis = jnp.concatenate([step[None], previous])
    images = jnp.stack([product(each) for each in basis])
    gram = jnp.einsum("icn,jcn->ij", basis, images, precision="highest")
    slopes = jnp.einsum("icn,cn->i", basis, right, precision="highest")
    size = jnp.sqrt(jnp.diagonal(gram))
    live = ~(size == 0)  # a size that is no number stays in
    unit = jnp.where(live, size, 1)
    own = jnp.where(live, RIDGE * float(jnp.finfo(gram.dtype).eps), 1)
    scaled = 0.5 * (gram + gram.T) / unit[:, None] / unit + jnp.diag(own)
    weights = solve_positive(scaled[None], (slopes / unit)[None])[0] / unit
    return jnp.einsum("i,icn->cn", weights, basis, precision="highest")


def on_manifold(
    cameras: Float[Array, "9 cameras"], changes: Float[Array, "steps 9 cameras"]
) -> Float[Array, "steps cameras 9"]:
    """Changes of the file's camera numbers, to first order as steps from where the cameras are now."""
    turn = camera.left_jacobian(cameras[:3])
    turned = jnp.einsum("ijc,sjc->sci", turn, changes[:, :3], precision="highest")
    return jnp.concatenate([turned, jnp.moveaxis(changes[:, 3:], 1, 2)], axis=2)
