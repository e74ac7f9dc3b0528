"""Projection and its derivatives: of BAL's camera model by formulas, of all others by forward mode.

    P = R X + t,   p = -P.xy / P.z,   z = f (1 + k1 |p|^2 + k2 |p|^4) p      BAL
                                      z = model(P.x, -P.y, -P.z)             others (problem/camera_models.py)

Arrays are components-first, [3, n], so that vector instructions of a CPU and coalesced reads of a GPU run over
observations. Rotation matrices are computed once per camera; what is computed per observation has no sine, cosine or
branch.

Source of the model: Agarwal et al. 2010, "Bundle Adjustment in the Large". Derivatives by a rotation are those of the
left perturbation `R <- exp(d) R`, Sola et al. 2018, "A micro Lie theory", eqs. 143-146.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxba.problem.camera_models import CameraModel
from jaxba.runtime.fusion import compute_unfused, fusion_barrier
from jaxba.structure.segment_sums import take
from jaxba.structure.unknowns import Unknowns
from jaxba.typing import AnyArray

SMALL_ANGLE_SQUARED = 1e-6
"""Squared angle (radians^2) below which functions of the angle are Taylor series, with an error below 1e-20."""


@jax.tree_util.register_static
@dataclass(frozen=True)
class Models:
    """The camera models of a problem that has others than BAL's."""

    models: tuple[CameraModel, ...]


class Frames(NamedTuple):
    """The camera of each observation: rotation matrix and the other parameters."""

    rotation: Float[Array, "3 3 ..."] | list[list[Array]]  # R, world to camera
    translation: Float[Array, "3 ..."] | list[Array]  # t, scene units
    lens: Float[Array, "numbers ..."] | list[Array]  # f (pixels), k1, k2 of BAL
    model: Int[Array, "..."] | None = None  # position in the models; None: the only one
    models: Models | None = None  # None: all cameras are BAL's
    from_rig: Float[Array, "12 ..."] | None = None  # M by rows, and m: from the frame of a rig to the camera

    def at(self, index: Int[AnyArray, " n"]) -> Frames:
        """The frames of the cameras in `index`.

        They are computed once per camera and stored: a fusion barrier keeps XLA from recomputing the rotation matrices
        for every index.
        """
        rotation = jnp.asarray(self.rotation).reshape(9, -1)
        place = [] if self.from_rig is None else self.from_rig
        table = fusion_barrier(jnp.stack([*rotation, *self.translation, *self.lens, *place]))
        # not fused with its uses, in which a gather keeps the compiler from vectorising
        table = compute_unfused(take, table, jnp.asarray(index), index=index)
        model = None if self.model is None else take(self.model, jnp.asarray(index))
        end = len(table) - len(place)
        found = Frames(table[:9].reshape(3, 3, -1), table[9:12], table[12:end], model, self.models)
        return found if self.from_rig is None else found._replace(from_rig=table[end:])


class Projection(NamedTuple):
    """A projected point, with the intermediate values that its derivatives need."""

    pixel: Float[Array, "2 ..."] | list[Array]  # f d p
    direction: Float[Array, "2 ..."] | list[Array]  # p = -P.xy / P.z
    inverse_depth: Float[Array, "..."]  # 1 / P.z; negative in front of the camera, zero where masked
    radius: Float[Array, "..."]  # |p|^2
    distortion: Float[Array, "..."]  # d = 1 + k1 |p|^2 + k2 |p|^4 of BAL, else 1
    rotated: Float[Array, "3 ..."] | list[Array]  # R X
    local: Float[Array, "3 ..."] | list[Array]  # P; (0, 0, -1) where masked and not BAL's
    placed: Float[Array, "3 ..."] | list[Array] | None  # P - m of a camera in a rig
    mask: Bool[AnyArray, "..."] | None  # as given

    def stacked(self) -> Projection:
        """The same with arrays in place of lists."""
        names = ["pixel", "direction", "rotated", "local", *([] if self.placed is None else ["placed"])]
        return self._replace(**{name: jnp.stack(list(getattr(self, name))) for name in names})


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


def frames(cameras: Float[Array, "parameters cameras"], unknowns: Unknowns | None = None) -> Frames:
    """Rotation matrices and intrinsics, once per camera and evaluation.

    Args:
        cameras: pose and lens of each camera.
        unknowns: knows their camera models; None: all are BAL's.
    """
    found = Frames(rotation_matrix(cameras[:3]), cameras[3:6], cameras[6:])
    if unknowns is not None and unknowns.in_rigs:
        rotation, translation = rotation_matrix(cameras[-6:-3]), cameras[-3:]
        place = jnp.concatenate([rotation.reshape(9, -1), translation])
        found = found._replace(lens=cameras[6:-6], from_rig=place)
    if unknowns is None or unknowns.models is None:
        return found
    model = None if unknowns.model is None else jnp.asarray(unknowns.model)
    return found._replace(model=model, models=Models(unknowns.models))


def moved(
    cameras: Float[Array, "parameters cameras"],
    step: Float[Array, "parameters cameras"],
    unknowns: Unknowns | None = None,
) -> Float[Array, "parameters cameras"]:
    """Cameras after a step, `R <- exp(w) R` for rotations."""
    found = (cameras + step).at[:3].set(compose_left(step[:3], cameras[:3]))
    if unknowns is None or not unknowns.in_rigs:
        return found
    return found.at[-6:-3].set(compose_left(step[-6:-3], cameras[-6:-3]))


def poses(
    cameras: Float[Array, "parameters cameras"], unknowns: Unknowns | None = None
) -> tuple[Float[Array, "3 cameras"], Float[Array, "3 cameras"]]:
    """Angle-axis and translation of each camera, also of one in a rig: `M R_r` and `M t_r + m` (problem/rigs.py)."""
    if unknowns is None or not unknowns.in_rigs:
        return cameras[:3], cameras[3:6]
    turned = jnp.einsum("ijc,jc->ic", rotation_matrix(cameras[-6:-3]), cameras[3:6], precision="highest")
    return compose_left(cameras[-6:-3], cameras[:3]), turned + cameras[-3:]


def project(
    frame: Frames, points: Float[Array, "3 ..."] | list[Array], mask: Bool[AnyArray, "..."] | None = None
) -> Projection:
    """Projects one point through one camera per column.

    Args:
        frame: camera of each column.
        points: point of each column, scene units.
        mask: where false, the projection and everything derived from it is exactly zero.

    Returns:
        Pixels and intermediate values, in lists. A point on the camera plane gives non-finite pixels; a point behind
        the camera is projected like any other, as in BAL.
    """
    rotation = frame.rotation
    rotated = [row[0] * points[0] + row[1] * points[1] + row[2] * points[2] for row in rotation]
    local = [rotated[k] + frame.translation[k] for k in range(3)]
    placed: list[Array] | None = None
    if frame.from_rig is not None:
        turn, m = frame.from_rig[:9], frame.from_rig[9:]
        p, q, r = local
        placed = [turn[3 * i] * p + turn[3 * i + 1] * q + turn[3 * i + 2] * r for i in range(3)]
        local = [placed[k] + m[k] for k in range(3)]
    x, y, z = local
    if frame.models is not None and mask is not None:
        local = x, y, z = [jnp.where(mask, row, value) for row, value in zip(local, (0.0, 0.0, -1.0), strict=True)]
    # masked twice: the derivative of the quotient, too, must not see the depth of an empty slot
    inverse = 1 / (z if mask is None else jnp.where(mask, z, jnp.ones_like(z)))
    if mask is not None:
        inverse = jnp.where(mask, inverse, jnp.zeros_like(inverse))
    u, v = -x * inverse, -y * inverse
    radius = u * u + v * v
    if frame.models is not None:
        pixel = list(model_pixel(frame, list(frame.lens), x, y, z))
        pixel = pixel if mask is None else [jnp.where(mask, row, jnp.zeros_like(row)) for row in pixel]
        return Projection(pixel, [u, v], inverse, radius, jnp.ones_like(radius), rotated, local, placed, mask)
    focal, k1, k2 = frame.lens
    distortion = 1 + radius * (k1 + k2 * radius)
    scale = focal * distortion
    return Projection([scale * u, scale * v], [u, v], inverse, radius, distortion, rotated, local, placed, mask)


def model_pixel(frame: Frames, lens: list[Array], x: Array, y: Array, z: Array) -> tuple[Array, Array]:
    """Pixel of a point in the frame of each camera (BAL's axes) by its camera model.

    Args:
        frame: says which camera has which model.
        lens: numbers of the lenses.
        x, y, z: of the points, scene units.
    """
    assert frame.models is not None
    models = frame.models.models
    pixel = models[-1].project(lens[: len(models[-1])], x, -y, -z)
    for number, model in enumerate(models[:-1]):
        assert frame.model is not None
        own = model.project(lens[: len(model)], x, -y, -z)
        pixel = tuple(jnp.where(frame.model == number, *pair) for pair in zip(own, pixel, strict=True))
    return pixel[0], pixel[1]


class Derivatives(NamedTuple):
    """Derivatives of the pixel by the camera (rotation on the manifold, translation, f, k1, k2) and by the point."""

    camera: list[list[Array]]  # [2][9] of [n]
    point: list[list[Array]]  # [2][3] of [n]


def derivatives(frame: Frames, projection: Projection, columns: tuple[int, ...] | None = None) -> Derivatives:
    """Jacobians of `project`, as lists of columns, each of which is one fused expression.

    Args:
        frame: camera of each column.
        projection: what `project` returned for it.
        columns: numbers of the lens to differentiate by; None: all.

    For BAL's model with `d = 1 + k1 |p|^2 + k2 |p|^4` and its derivative `e = k1 + 2 k2 |p|^2` by `|p|^2`:

        dz/dp = f (d I + 2 e p p^T)      dp/dP = -[I | p] / P.z      dz/dt = dz/dP
        dz/dw = -dz/dP [R X]x            dz/dX = dz/dP R             dz/d(f, k1, k2) = (d, f |p|^2, f |p|^4) p
    """
    by_camera_point, by_lens = (_bal_derivatives if frame.models is None else _model_derivatives)(frame, projection)
    if frame.from_rig is not None:
        by_camera_point, by_extrinsics = _through_rig(frame, projection, by_camera_point)
        by_lens = [[*own, *more] for own, more in zip(by_lens, by_extrinsics, strict=True)]
    columns = tuple(range(len(by_lens[0]))) if columns is None else columns
    qx, qy, qz = projection.rotated
    rotation = frame.rotation
    camera, point = [], []
    for row, numbers in zip(by_camera_point, by_lens, strict=True):
        a, b, c = row
        by_rotation = [qy * c - qz * b, qz * a - qx * c, qx * b - qy * a]
        camera.append([*by_rotation, *row, *(numbers[k]() for k in columns)])
        point.append([a * rotation[0][k] + b * rotation[1][k] + c * rotation[2][k] for k in range(3)])
    return Derivatives(camera, point)


Rows = tuple[list[list[Array]], list[list[Callable[[], Array]]]]
"""`dz/dP`, [2][3], and `dz/d numbers of the lens`, [2][numbers], each computed when it is asked for."""


def _through_rig(frame: Frames, projection: Projection, rows: list[list[Array]]) -> Rows:
    """From `dz/dP` of a camera in a rig, the derivative by the point in its frame, and by its extrinsics: left
    perturbation of M, and m."""
    assert frame.from_rig is not None
    assert projection.placed is not None
    turn, (x, y, z) = frame.from_rig[:9], projection.placed
    by_frame = [[a * turn[k] + b * turn[3 + k] + c * turn[6 + k] for k in range(3)] for a, b, c in rows]
    by_extrinsics: list[list[Callable[[], Array]]] = [
        [
            lambda b=b, c=c: y * c - z * b,
            lambda a=a, c=c: z * a - x * c,
            lambda a=a, b=b: x * b - y * a,
            *(lambda one=one: one for one in (a, b, c)),
        ]
        for a, b, c in rows
    ]
    return by_frame, by_extrinsics


def _bal_derivatives(frame: Frames, projection: Projection) -> Rows:
    u, v = projection.direction
    radius, distortion = projection.radius, projection.distortion
    focal, k1, k2 = frame.lens
    slope = 2 * (k1 + 2 * k2 * radius)
    scale = -focal * projection.inverse_depth
    cross = scale * slope * u * v
    radial = scale * (distortion + slope * radius)
    by_camera_point = [
        [scale * (distortion + slope * u * u), cross, radial * u],
        [cross, scale * (distortion + slope * v * v), radial * v],
    ]
    by_lens: list[list[Callable[[], Array]]] = [
        [
            lambda p=p: distortion * p,
            lambda p=p: focal * radius * p,
            lambda p=p: focal * radius * radius * p,
        ]
        for p in (u, v)
    ]
    return by_camera_point, by_lens


def _model_derivatives(frame: Frames, projection: Projection) -> Rows:
    """By forward mode, one number at a time: each derivative then has only the terms that depend on it."""
    lens, local = list(frame.lens), list(projection.local)

    def rate(function: Callable[[Array], tuple[Array, Array]], at: Array) -> tuple[Array, Array]:
        rates = jax.jvp(function, (at,), (jnp.ones_like(at),))[1]
        if projection.mask is None:
            return rates
        first, second = (jnp.where(projection.mask, row, jnp.zeros_like(row)) for row in rates)
        return first, second

    def by_place(k: int) -> tuple[Array, Array]:
        moved = lambda at: model_pixel(frame, lens, *[at if n == k else row for n, row in enumerate(local)])
        return rate(moved, local[k])

    @functools.cache
    def by_number(k: int) -> tuple[Array, Array]:
        return rate(lambda at: model_pixel(frame, [*lens[:k], at, *lens[k + 1 :]], *local), lens[k])

    places = [by_place(k) for k in range(3)]
    by_lens: list[list[Callable[[], Array]]] = [
        [lambda k=k, row=row: by_number(k)[row] for k in range(len(lens))] for row in range(2)
    ]
    return [[place[row] for place in places] for row in range(2)], by_lens
