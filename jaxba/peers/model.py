"""Quantities of a step that Ceres does not report, from the linear model along the step in COLMAP's parameters."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float

from jaxba.peers.colmap import SMALLEST_DEPTH
from jaxba.problem.bundle_problem import BundleProblem
from jaxba.runtime.jit import jit


class Observations(NamedTuple):
    """The observations of a problem on the device."""

    pixels: Array  # [2, n], in COLMAP's axes
    camera_index: Array  # [n]
    point_index: Array  # [n]


class StepMetrics(NamedTuple):
    """Quantities of a step `d`, with residuals `r` and Jacobian `J` at the parameters before it."""

    predicted: Float[Array, ""]  # decrease of the cost under the linear model, pixels^2
    damping_fraction: Float[Array, ""]  # d.D d / d.(H + D) d for a step with (H + D) d = -g
    step_norm: Float[Array, ""]  # rotations in radians
    parameter_norm: Float[Array, ""]  # before the step, in BAL's parameters
    cost: Float[Array, ""]  # after the step, as BAL defines it, pixels^2
    behind: Bool[Array, " observations"]  # observations that COLMAP ignores after the step


def observations_of(problem: BundleProblem, pixels: np.ndarray) -> Observations:
    """Puts the observations on the device; `pixels` are in COLMAP's axes, shape `(observations, 2)`."""
    return Observations(jnp.asarray(pixels.T), jnp.asarray(problem.camera_index), jnp.asarray(problem.point_index))


@jit
def step_metrics(observations: Observations, before: Any, after: Any) -> StepMetrics:
    """Metrics of the step between two sets of parameters `(poses [c, 7], lenses [c, 5], points [p, 3])`."""
    poses, lenses, points = before
    turn = half_rotation(poses[:, :4].T, after[0][:, :4].T)
    moved = (after[0][:, 4:] - poses[:, 4:]).T, (after[1] - lenses).T, (after[2] - points).T
    pose_rate = jnp.concatenate([_product(turn, poses[:, :4].T), moved[0]])
    camera, point = observations.camera_index, observations.point_index
    at = lambda a, b, c: (a[:, camera], b[:, camera], c[:, point])
    pixel, rate = jax.jvp(_pixel, at(poses.T, lenses.T, points.T), at(pose_rate, *moved[1:]))
    residual = pixel - observations.pixels
    there = at(*(block.T for block in after))
    squares = lambda *arrays: jnp.sqrt(sum(jnp.sum(x * x) for x in arrays))
    bal_angle = 2 * jnp.arctan2(jnp.linalg.norm(poses[:, 1:4], axis=1), jnp.abs(poses[:, 0]))
    slope, curvature = -jnp.sum(residual * rate), jnp.sum(rate * rate)  # -g.d and d.H d
    return StepMetrics(
        predicted=slope - 0.5 * curvature,
        damping_fraction=jnp.where(slope > 0, jnp.clip((slope - curvature) / slope, 0, 1), 0),
        step_norm=squares(2 * turn, *moved),
        parameter_norm=squares(bal_angle, poses[:, 4:], lenses, points),
        cost=0.5 * jnp.sum((_pixel(*there) - observations.pixels) ** 2),
        behind=_local(there[0], there[2])[2] < SMALLEST_DEPTH,
    )


def _local(pose: Float[Array, "7 n"], point: Float[Array, "3 n"]) -> Float[Array, "3 n"]:
    """The point in camera coordinates."""
    vector, real = pose[:3], pose[3]
    turned = jnp.cross(vector, point, axis=0)
    return point + 2 * (real * turned + jnp.cross(vector, turned, axis=0)) + pose[4:]


def _pixel(pose: Float[Array, "7 n"], lens: Float[Array, "5 n"], point: Float[Array, "3 n"]) -> Float[Array, "2 n"]:
    """Projection by COLMAP's RADIAL camera, also of points behind the camera."""
    local = _local(pose, point)
    p = local[:2] / local[2]
    radius = jnp.sum(p * p, axis=0)
    return lens[0] * (1 + radius * (lens[3] + lens[4] * radius)) * p + lens[1:3]


def _product(vector: Float[Array, "3 n"], q: Float[Array, "4 n"]) -> Float[Array, "4 n"]:
    """The quaternion product `(v, 0) q`, xyzw."""
    real = -jnp.sum(vector * q[:3], axis=0)
    return jnp.concatenate([q[3] * vector + jnp.cross(vector, q[:3], axis=0), real[None]])


def half_rotation(before: Float[Array, "4 n"], after: Float[Array, "4 n"]) -> Float[Array, "3 n"]:
    """`v` with `after = exp(v) before` for unit quaternions: half of the rotation vector between them, radians."""
    v, w = before[:3], before[3]
    vector = w * after[:3] - after[3] * v - jnp.cross(after[:3], v, axis=0)
    real = w * after[3] + jnp.sum(after[:3] * v, axis=0)
    sine = jnp.linalg.norm(vector, axis=0)
    return jnp.where(sine > 0, jnp.arctan2(sine, real) / jnp.where(sine > 0, sine, 1), 1) * vector
