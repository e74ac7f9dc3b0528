"""Residuals of motion between images: relative poses, and inertial measurement units (IMU),
integrated beforehand.

Source for IMUs: Forster et al. 2017, "On-Manifold Preintegration for Real-Time Visual-Inertial
Odometry", with the midpoint rule instead of Euler's, measurements interpolated between samples, and
derivatives by JAX."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from jaxba.problem.checks import finite
from jaxba.problem.residuals import residual, with_data
from jaxba.problem.row_data import (
    MOUNT,
    POSITIVE,
    ROTATION,
    VECTOR,
    matrices,
    vectors,
    whitenings,
)
from jaxba.problem.row_value import times
from jaxba.rotations import angle_axis, left_jacobian_inverse, rotation_matrix
from jaxba.runtime.jit import jit
from jaxba.runtime.numerics import numerics


@with_data(rotation=ROTATION, translation=VECTOR, whitening=whitenings(6))
@residual
def relative_pose(pose, pose_2, *, rotation, translation, whitening):
    """Odometry or a loop closure: the pose of the second camera in the frame of the first, `P_1 =
    rotation P_2 + translation`, so that `translation` (3) is the second one's centre seen by the
    first.

    With Z this measurement and T the poses from camera to world, the logarithm in SE(3) of `Z^-1
    T_1^-1 T_2`: a rotation w (radians), then a translation, in the measured frame of the second
    camera, whitened by a matrix (6, 6). This is the error of GTSAM's BetweenFactorPose3. g2o's
    EDGE_SE3:QUAT has the translation first, `V(w)` times this one, then the vector part of a
    quaternion, nearly w / 2. Source: Sola et al. 2018, "A micro Lie theory", eq. 172."""
    between = pose_2.between(pose)
    turn = angle_axis((rotation.T @ between.rotation)[None])[0]
    shift = rotation.T @ (between.translation - translation)
    return times(
        whitening, jnp.concatenate([turn, left_jacobian_inverse(turn[:, None])[..., 0] @ shift])
    )


@with_data(
    rotation=ROTATION,
    velocity=VECTOR,
    position=VECTOR,
    by_bias=matrices(9, 6),
    bias=vectors(6),
    duration=POSITIVE,
    whitening=whitenings(15),
    gravity=VECTOR,
    mount=MOUNT,
)
@residual
def imu(
    pose,
    motion,
    pose_2,
    motion_2,
    *,
    rotation,
    velocity,
    position,
    by_bias,
    bias,
    duration,
    whitening,
    gravity,
    mount,
):
    """What an IMU measured between two images, and the random walk of its biases (fifteen numbers:
    rotation, velocity, position, biases of gyroscope and accelerometer; Forster et al. 2017, eqs.
    44, 45 and 48).

    The block `motion` has nine numbers of each image: velocity of the IMU in the world, and the
    biases. `preintegrated` makes the data up to `whitening`, for image after image. `gravity` (3)
    is in the world, such as (0, 0, -9.81). `mount` (3, 4) is `[R | t]` from the IMU's frame to the
    camera's, Kalibr's `T_cam_imu`. Scene units are metres."""
    changed = by_bias @ (motion[3:] - bias)
    first, second = (one.rotation.T @ mount[:, :3] for one in (pose, pose_2))
    turn = (rotation @ _exponential(changed[:3])).T @ first.T @ second
    start, end = (one.center + one.rotation.T @ mount[:, 3] for one in (pose, pose_2))
    fall = duration * times(first.T, gravity)
    speed = first.T @ (motion_2[:3] - motion[:3]) - fall - velocity
    way = first.T @ (end - start - duration * motion[:3]) - 0.5 * duration * fall - position
    delta = jnp.concatenate([speed, way]) - changed[3:]
    return times(
        whitening, jnp.concatenate([angle_axis(turn[None])[0], delta, motion_2[3:] - motion[3:]])
    )


def preintegrated(
    times: Any,
    angular_rates: Any,
    accelerations: Any,
    moments: Any,
    *,
    noise: Any,
    bias: Any = (0.0,) * 6,
) -> dict[str, Float[np.ndarray, "..."]]:
    """The data of `imu` from samples of an IMU: a row for each pair of successive images. Raises
    ValueError: shapes, noise that is not positive, or times that do not ascend or enclose the
    images; one line.

    Args:
        times: of the samples, ascending, shape (n,), seconds.
        angular_rates: shape (n, 3), rad/s.
        accelerations: specific forces as an accelerometer measures them (at rest: up), shape (n,
            3), m/s^2.
        moments: of the images, ascending, within `times`, shape (m + 1,), seconds.
        noise: as in Kalibr's files, shape (4,): densities of white noise of the gyroscope
            (rad/s/sqrt(Hz)) and of the accelerometer (m/s^2/sqrt(Hz)), and of the random walks of
            their biases (the same per second).
        bias: of the gyroscope and the accelerometer, about which the result is linear, shape
            (6,)."""
    t = finite("times", times, (np.size(times),))
    at = finite("moments", moments, (np.size(moments),))
    bias = finite("bias", bias, (6,))
    deviation = np.repeat(finite("noise", noise, (4,)), 3)
    measured = {"angular_rates": angular_rates, "accelerations": accelerations}
    samples = np.hstack([finite(name, x, (len(t), 3)) for name, x in measured.items()]) - bias
    if (
        len(at) < 2
        or not all((np.diff(x) > 0).all() for x in (t, at))
        or at[0] < t[0]
        or at[-1] > t[-1]
    ):
        raise ValueError(
            "times and moments must ascend, and times begin before and end after the moments"
        )
    if not (deviation > 0).all():
        raise ValueError("noise must be positive")
    # half of an interval is a step at least: a single one would leave the covariance singular
    knots = [np.unique([a, (a + b) / 2, b, *t[(t > a) & (t < b)]]) for a, b in pairwise(at)]
    longest = max(map(len, knots))
    ends = np.stack([np.pad(one, (0, longest - len(one)), mode="edge") for one in knots])
    steps = np.diff(ends)
    middles = (ends[:, 1:] + ends[:, :-1]) / 2
    between = np.stack([np.interp(middles, t, column) for column in samples.T], axis=-1)
    with numerics(np.float64):
        by_sample, (rotation, velocity, position) = jax.device_get(_derivatives(between, steps))
    duration = np.diff(at)
    # white noise, averaged over a step
    rate = np.divide(1.0, steps, out=np.zeros_like(steps), where=steps > 0)
    scaled = by_sample * (np.sqrt(rate)[..., None] * deviation[:6])[:, None]
    whitening = np.zeros((len(duration), 15, 15))
    whitening[:, :9, :9] = np.linalg.inv(
        np.linalg.cholesky(np.einsum("minc,mjnc->mij", scaled, scaled))
    )
    whitening[:, range(9, 15), range(9, 15)] = 1 / (deviation[6:] * np.sqrt(duration)[:, None])
    found = {
        "rotation": rotation,
        "velocity": velocity,
        "position": position,
        "by_bias": -by_sample.sum(axis=2),
    }
    return found | {
        "bias": np.tile(bias, (len(duration), 1)),
        "duration": duration,
        "whitening": whitening,
    }


def _exponential(vector: Float[Array, "3"]) -> Float[Array, "3 3"]:
    return rotation_matrix(vector[:, None])[..., 0]


def _integrated(
    samples: Float[Array, "n 6"], steps: Float[Array, " n"]
) -> tuple[Array, tuple[Array, Array, Array]]:
    """Nine numbers, with derivatives of rotation (by one after it), velocity and position (Forster
    et al., eq. 33)."""

    def advance(
        state: tuple[Array, Array, Array], of: tuple[Array, Array]
    ) -> tuple[tuple[Array, Array, Array], None]:
        (rotation, velocity, position) = state
        (sample, dt) = of
        half = rotation @ _exponential(0.5 * dt * sample[:3])
        force = half @ sample[3:]
        position = position + dt * (velocity + 0.5 * dt * force)
        return (half @ _exponential(0.5 * dt * sample[:3]), velocity + dt * force, position), None

    start = jnp.eye(3), jnp.zeros(3), jnp.zeros(3)
    (rotation, velocity, position), _ = jax.lax.scan(advance, start, (samples, steps))
    turn = jax.lax.stop_gradient(rotation).T @ rotation
    return jnp.concatenate([angle_axis(turn[None])[0], velocity, position]), (
        rotation,
        velocity,
        position,
    )


_derivatives = jit(jax.vmap(jax.jacrev(_integrated, has_aux=True)))
