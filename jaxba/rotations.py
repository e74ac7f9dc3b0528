"""Rotations in JAX: exponential, logarithm, composition and the left Jacobian of SO(3).

Angle-axis vectors are in radians. The host uses SciPy's `Rotation`.

Source: Sola et al. 2018, "A micro Lie theory", eqs. 143-146."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

SMALL_ANGLE_SQUARED = 1e-6
"""Squared angle (radians^2) below which functions of the angle are Taylor series, with an error
below 1e-20."""


def _coefficients(squared: Array) -> tuple[Array, Array, Array]:
    """`sin(a)/a`, `(1-cos(a))/a^2` and `(a-sin(a))/a^3` at angle a = sqrt(squared), smooth through
    zero."""
    small = squared < SMALL_ANGLE_SQUARED
    safe = jnp.where(small, jnp.ones_like(squared), squared)
    angle = jnp.sqrt(safe)
    half = jnp.sin(0.5 * angle)
    first = jnp.where(small, 1 - squared / 6 * (1 - squared / 20), jnp.sin(angle) / angle)
    # 2 sin^2(a/2) instead of 1 - cos(a): no cancellation
    second = jnp.where(small, 0.5 - squared / 24 * (1 - squared / 30), 2 * half * half / safe)
    third = jnp.where(
        small, 1 / 6 - squared / 120 * (1 - squared / 42), (angle - jnp.sin(angle)) / (safe * angle)
    )
    return first, second, third


def _skew_polynomial(vector: Array, linear: Array, quadratic: Array) -> Float[Array, "3 3 n"]:
    """`I + linear [w]x + quadratic [w]x^2` for vectors [3, n]."""
    x, y, z = vector
    xx = x * x
    yy = y * y
    zz = z * z
    one = jnp.ones_like(x)
    q = quadratic
    rows = [
        [one - q * (yy + zz), q * x * y - linear * z, q * x * z + linear * y],
        [q * x * y + linear * z, one - q * (xx + zz), q * y * z - linear * x],
        [q * x * z - linear * y, q * y * z + linear * x, one - q * (xx + yy)],
    ]
    return jnp.stack([jnp.stack(row) for row in rows])


def rotation_matrix(angle_axis: Float[Array, "3 n"]) -> Float[Array, "3 3 n"]:
    """Rodrigues' formula. Angle-axis in radians; exact at zero and differentiable there."""
    first, second, _ = _coefficients(jnp.sum(angle_axis * angle_axis, axis=0))
    return _skew_polynomial(angle_axis, first, second)


def left_jacobian(angle_axis: Float[Array, "3 n"]) -> Float[Array, "3 3 n"]:
    """`J` with `exp(w + dw) = exp(J dw) exp(w)` to first order (Sola et al., eq. 145)."""
    _, second, third = _coefficients(jnp.sum(angle_axis * angle_axis, axis=0))
    return _skew_polynomial(angle_axis, second, third)


def left_jacobian_inverse(angle_axis: Float[Array, "3 n"]) -> Float[Array, "3 3 n"]:
    """Inverse of `left_jacobian` (Sola et al., eq. 146); singular where the angle is a multiple of
    2 pi."""
    squared = jnp.sum(angle_axis * angle_axis, axis=0)
    small = squared < SMALL_ANGLE_SQUARED
    safe = jnp.where(small, jnp.ones_like(squared), squared)
    half = 0.5 * jnp.sqrt(safe)
    series = 1 / 12 + squared / 720 * (1 + squared / 42)
    quadratic = jnp.where(small, series, (1 - half * jnp.cos(half) / jnp.sin(half)) / safe)
    return _skew_polynomial(angle_axis, jnp.full_like(squared, -0.5), quadratic)


def compose_left(step: Float[Array, "3 n"], angle_axis: Float[Array, "3 n"]) -> Float[Array, "3 n"]:
    """Angle-axis of `exp(step) exp(angle_axis)`, by quaternions, with an angle in [0, pi]."""
    a, u = _quaternion(step)
    b, v = _quaternion(angle_axis)
    real = a * b - jnp.sum(u * v, axis=0)
    imaginary = a * v + b * u + jnp.cross(u, v, axis=0)
    sign = jnp.where(real < 0, -1.0, 1.0).astype(real.dtype)
    real = real * sign
    imaginary = imaginary * sign
    squared = jnp.sum(imaginary * imaginary, axis=0)
    small = squared < SMALL_ANGLE_SQUARED
    norm = jnp.sqrt(jnp.where(small, jnp.ones_like(squared), squared))
    # asin's series: the angle is 2 asin(|v|), so angle / |v| = 2 (1 + |v|^2/6 + 3|v|^4/40)
    scale = jnp.where(
        small, 2 + squared * (1 / 3 + 3 * squared / 20), 2 * jnp.arctan2(norm, real) / norm
    )
    return scale * imaginary


def _quaternion(angle_axis: Array) -> tuple[Array, Array]:
    half = 0.5 * angle_axis
    squared = jnp.sum(half * half, axis=0)
    first, _, _ = _coefficients(squared)
    small = squared < SMALL_ANGLE_SQUARED
    angle = jnp.sqrt(jnp.where(small, jnp.ones_like(squared), squared))
    real = jnp.where(small, 1 - squared / 2 * (1 - squared / 12), jnp.cos(angle))
    return real, first * half


def angle_axis(rotation: Float[Array, "n 3 3"]) -> Float[Array, "n 3"]:
    """Angle-axis vectors with angles in [0, pi], computed from the quaternion's largest entry
    (Shepperd 1978)."""
    m = rotation
    trace = m[:, 0, 0] + m[:, 1, 1] + m[:, 2, 2]
    squares = jnp.stack([trace, m[:, 0, 0], m[:, 1, 1], m[:, 2, 2]], axis=1)
    antisymmetric = [m[:, 2, 1] - m[:, 1, 2], m[:, 0, 2] - m[:, 2, 0], m[:, 1, 0] - m[:, 0, 1]]

    def symmetric(i, j):
        return m[:, i, j] + m[:, j, i]

    x, y, z = antisymmetric
    two = 2 * squares[:, 1:] - trace[:, None]
    rows = jnp.stack(
        [
            jnp.stack([1 + trace, x, y, z], axis=1),
            jnp.stack([x, 1 + two[:, 0], symmetric(0, 1), symmetric(0, 2)], axis=1),
            jnp.stack([y, symmetric(0, 1), 1 + two[:, 1], symmetric(1, 2)], axis=1),
            jnp.stack([z, symmetric(0, 2), symmetric(1, 2), 1 + two[:, 2]], axis=1),
        ],
        axis=1,
    )
    best = jnp.take_along_axis(rows, jnp.argmax(squares, axis=1)[:, None, None], axis=1)[:, 0]
    best = best / jnp.linalg.norm(best, axis=1, keepdims=True)
    best = jnp.where(best[:, :1] < 0, -best, best)
    squared = jnp.sum(best[:, 1:] ** 2, axis=1)
    small = squared < 1e-24
    sine = jnp.sqrt(jnp.where(small, jnp.ones_like(squared), squared))
    scale = jnp.where(small, 2.0, 2 * jnp.arctan2(sine, best[:, 0]) / sine)
    return best[:, 1:] * scale[:, None]
