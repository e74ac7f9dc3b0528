"""Preconditioned conjugate gradients with Ceres' stopping rule and an iteration count.

`jax.scipy.sparse.linalg.cg` computes the same iterates, but returns no count and stops on the
residual norm only. An inexact Newton step should stop on the quadratic model instead: late
iterations hardly lower it."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array
from jaxtyping import Float, Int

from jaxba.runtime import loops


class _Carry(NamedTuple):
    x: Array
    residual: Array
    direction: Array
    product: Array  # r . M^-1 r
    model: Array  # Q = x . A x - 2 b . x
    count: Int[Array, ""]
    running: Array


def conjugate_gradients(
    apply: Callable[[Array], Array],
    right: Float[Array, "..."],
    precondition: Callable[[Array], Array],
    *,
    forcing: float | Float[Array, ""],
    tolerance: float,
    max_iterations: int,
) -> tuple[Float[Array, "..."], Int[Array, ""]]:
    """Solves `A x = b` from `x = 0` for a symmetric positive definite operator. Returns the iterate
    and the number of iterations. Negative curvature stops with the last iterate. A non-finite
    number makes the result non-finite.

    Args:
        apply: `A`.
        right: `b`, any shape.
        precondition: `M^-1`, symmetric positive definite.
        forcing: stop when `i (Q_i - Q_(i-1)) / Q_i < forcing`, where `Q_i = x.A x - 2 b.x = -x.(b +
            r)` in iteration i. Source: Ceres conjugate_gradients_solver, after Nash and Sofer 1990.
            Zero switches the test off.
        tolerance: stop when `|r| <= tolerance |b|`.
        max_iterations: upper bound."""
    bound = tolerance * tolerance * jnp.sum(right * right)

    def body(c: _Carry) -> _Carry:
        image = apply(c.direction)
        curvature = jnp.sum(c.direction * image)
        valid = curvature > 0
        step = c.product / jnp.where(valid, curvature, jnp.ones_like(curvature))
        x = c.x + step * c.direction
        residual = c.residual - step * image
        model = -jnp.sum(x * (right + residual))
        count = c.count + 1
        converged = (forcing > 0) & (count * (model - c.model) / model < forcing)
        finished = converged | (jnp.sum(residual * residual) <= bound) | (count >= max_iterations)
        scaled = precondition(residual)
        product = jnp.sum(residual * scaled)
        direction = scaled + product / c.product * c.direction
        done = _Carry(x, residual, direction, product, model, count, valid & ~finished)
        # negative curvature keeps the iterate; a non-finite curvature makes it nan
        rest = c._replace(x=jnp.where(jnp.isfinite(curvature), c.x, jnp.nan), running=valid)
        return _Carry(*(jnp.where(valid, new, old) for new, old in zip(done, rest, strict=True)))

    scaled = precondition(right)
    product = jnp.sum(right * scaled)
    zero = jnp.zeros_like(right)
    start = _Carry(
        zero, right, scaled, product, jnp.zeros_like(product), jnp.zeros((), jnp.int32), product > 0
    )
    end = loops.while_loop(lambda c: c.running, body, start)
    # with a non-finite preconditioner or right-hand side the loop does not start: return nan, not a
    # zero step
    return jnp.where(jnp.isfinite(product), end.x, jnp.full_like(right, jnp.nan)), end.count
