"""The BAL camera model and its analytic derivatives.

    P = R X + t,   p = -P.xy / P.z,   z = f (1 + k1 |p|^2 + k2 |p|^4) p

Arrays are components-first, [3, n], so that vector instructions of a CPU and coalesced reads of a GPU run over
observations. Rotation matrices are computed once per camera; what is computed per observation has no sine, cosine or
branch.

Source of the model: Agarwal et al. 2010, "Bundle Adjustment in the Large". Derivatives by a rotation are those of the
left perturbation `R <- exp(d) R`, Sola et al. 2018, "A micro Lie theory", eqs. 143-146.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxba.runtime.fusion import compute_unfused, fusion_barrier
from jaxba.structure.segment_sums import take
from jaxba.typing import AnyArray

SMALL_ANGLE_SQUARED = 1e-6
"""Squared angle (radians^2) below which functions of the angle are Taylor series, with an error below 1e-20."""


class Frames(NamedTuple):
    """The camera of each observation: rotation matrix and the other parameters."""

    rotation: Float[Array, "3 3 ..."] | list[list[Array]]  # R, world to camera
    translation: Float[Array, "3 ..."] | list[Array]  # t, scene units
    focal: Float[Array, "..."]  # pixels
    k1: Float[Array, "..."]
    k2: Float[Array, "..."]

    def at(self, index: Int[AnyArray, " n"]) -> Frames:
        """The frames of the cameras in `index`.

        They are computed once per camera and stored: a fusion barrier keeps XLA from recomputing the rotation matrices
        for every index.
        """
        rotation = jnp.asarray(self.rotation).reshape(9, -1)
        table = fusion_barrier(jnp.stack([*rotation, *self.translation, self.focal, self.k1, self.k2]))
        # not fused with its uses, in which a gather keeps the compiler from vectorising
        table = compute_unfused(take, table, jnp.asarray(index), index=index)
        return Frames(table[:9].reshape(3, 3, -1), table[9:12], *table[12:])


class Projection(NamedTuple):
    """A projected point, with the intermediate values that its derivatives need."""

    pixel: Float[Array, "2 ..."] | list[Array]  # f d p
    direction: Float[Array, "2 ..."] | list[Array]  # p = -P.xy / P.z
    inverse_depth: Float[Array, "..."]  # 1 / P.z; negative in front of the camera, zero where masked
    radius: Float[Array, "..."]  # |p|^2
    distortion: Float[Array, "..."]  # d = 1 + k1 |p|^2 + k2 |p|^4
    rotated: Float[Array, "3 ..."] | list[Array]  # R X

    def stacked(self) -> Projection:
        """The same with arrays in place of lists."""
        stack = lambda rows: jnp.stack(list(rows))
        pixel, direction, rotated = stack(self.pixel), stack(self.direction), stack(self.rotated)
        return self._replace(pixel=pixel, direction=direction, rotated=rotated)


def _coefficients(squared: Array) -> tuple[Array, Array, Array]:
    """`sin(a)/a`, `(1-cos(a))/a^2` and `(a-sin(a))/a^3` at angle a = sqrt(squared), smooth through zero."""
    small = squared < SMALL_ANGLE_SQUARED
    safe = jnp.where(small, jnp.ones_like(squared), squared)
    angle = jnp.sqrt(safe)
    half = jnp.sin(0.5 * angle)
    first = jnp.where(small, 1 - squared / 6 * (1 - squared / 20), jnp.sin(angle) / angle)
    # 2 sin^2(a/2) instead of 1 - cos(a): no cancellation
    second = jnp.where(small, 0.5 - squared / 24 * (1 - squared / 30), 2 * half * half / safe)
    third = jnp.where(small, 1 / 6 - squared / 120 * (1 - squared / 42), (angle - jnp.sin(angle)) / (safe * angle))
    return first, second, third


def _skew_polynomial(vector: Array, linear: Array, quadratic: Array) -> Float[Array, "3 3 n"]:
    """`I + linear [w]x + quadratic [w]x^2` for vectors [3, n]."""
    x, y, z = vector
    xx, yy, zz = x * x, y * y, z * z
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
    """Inverse of `left_jacobian` (Sola et al., eq. 146); singular where the angle is a multiple of 2 pi."""
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
    real, imaginary = real * sign, imaginary * sign
    squared = jnp.sum(imaginary * imaginary, axis=0)
    small = squared < SMALL_ANGLE_SQUARED
    norm = jnp.sqrt(jnp.where(small, jnp.ones_like(squared), squared))
    # asin's series: the angle is 2 asin(|v|), so angle / |v| = 2 (1 + |v|^2/6 + 3|v|^4/40)
    scale = jnp.where(small, 2 + squared * (1 / 3 + 3 * squared / 20), 2 * jnp.arctan2(norm, real) / norm)
    return scale * imaginary


def _quaternion(angle_axis: Array) -> tuple[Array, Array]:
    half = 0.5 * angle_axis
    squared = jnp.sum(half * half, axis=0)
    first, _, _ = _coefficients(squared)
    small = squared < SMALL_ANGLE_SQUARED
    angle = jnp.sqrt(jnp.where(small, jnp.ones_like(squared), squared))
    real = jnp.where(small, 1 - squared / 2 * (1 - squared / 12), jnp.cos(angle))
    return real, first * half


def frames(cameras: Float[Array, "9 cameras"]) -> Frames:
    """Rotation matrices and intrinsics, once per camera and evaluation."""
    return Frames(rotation_matrix(cameras[:3]), cameras[3:6], cameras[6], cameras[7], cameras[8])


def project(
    frame: Frames, points: Float[Array, "3 ..."] | list[Array], mask: Bool[AnyArray, "..."] | None = None
) -> Projection:
    """Projects one point through one camera per column.

    Args:
        frame: camera of each column.
        points: point of each column, scene units.
        mask: where false, the projection and everything derived from it is exactly zero.

    Returns:
        Pixels (BAL axes) and intermediate values, in lists. A point on the camera plane gives non-finite pixels; a
        point behind the camera is projected like any other, as in BAL.
    """
    rotation = frame.rotation
    rotated = [row[0] * points[0] + row[1] * points[1] + row[2] * points[2] for row in rotation]
    x, y, z = (rotated[k] + frame.translation[k] for k in range(3))
    # masked twice: the derivative of the quotient, too, must not see the depth of an empty slot
    inverse = 1 / (z if mask is None else jnp.where(mask, z, jnp.ones_like(z)))
    if mask is not None:
        inverse = jnp.where(mask, inverse, jnp.zeros_like(inverse))
    u, v = -x * inverse, -y * inverse
    radius = u * u + v * v
    distortion = 1 + radius * (frame.k1 + frame.k2 * radius)
    scale = frame.focal * distortion
    return Projection([scale * u, scale * v], [u, v], inverse, radius, distortion, rotated)


class Derivatives(NamedTuple):
    """Derivatives of the pixel by the camera (rotation on the manifold, translation, f, k1, k2) and by the point."""

    camera: list[list[Array]]  # [2][9] of [n]
    point: list[list[Array]]  # [2][3] of [n]


def derivatives(frame: Frames, projection: Projection) -> Derivatives:
    """Analytic Jacobians of `project`, as lists of columns, each of which is one fused expression.

    With the distortion `d = 1 + k1 |p|^2 + k2 |p|^4` and its derivative `e = k1 + 2 k2 |p|^2` by `|p|^2`:

        dz/dp = f (d I + 2 e p p^T)      dp/dP = -[I | p] / P.z      dz/dt = dz/dP
        dz/dw = -dz/dP [R X]x            dz/dX = dz/dP R             dz/d(f, k1, k2) = (d, f |p|^2, f |p|^4) p
    """
    u, v = projection.direction
    radius, distortion = projection.radius, projection.distortion
    slope = 2 * (frame.k1 + 2 * frame.k2 * radius)
    scale = -frame.focal * projection.inverse_depth
    cross = scale * slope * u * v
    radial = scale * (distortion + slope * radius)
    by_camera_point = [
        [scale * (distortion + slope * u * u), cross, radial * u],
        [cross, scale * (distortion + slope * v * v), radial * v],
    ]
    qx, qy, qz = projection.rotated
    rotation = frame.rotation
    camera, point = [], []
    for row, direction in zip(by_camera_point, (u, v), strict=True):
        a, b, c = row
        by_rotation = [qy * c - qz * b, qz * a - qx * c, qx * b - qy * a]
        by_intrinsics = [
            distortion * direction,
            frame.focal * radius * direction,
            frame.focal * radius * radius * direction,
        ]
        camera.append([*by_rotation, *row, *by_intrinsics])
        point.append([a * rotation[0][k] + b * rotation[1][k] + c * rotation[2][k] for k in range(3)])
    return Derivatives(camera, point)
