"""Residuals of images and lenses: depth maps, a rolling shutter, and bounds of lenses."""

from __future__ import annotations

import jax.numpy as jnp

from jaxba.problem.residuals import residual, with_data
from jaxba.problem.row_data import ANY, NUMBER, POSITIVE, deviations, vectors
from jaxba.rotations import rotation_matrix


@with_data(measured=NUMBER, sigma=POSITIVE)
@residual
def depth(pose, point, image, *, measured, sigma):
    """A depth map at the pixel of a point: `scale z + shift - measured` over `sigma` (one number),
    with scale and shift of each image in the block `image`, (1, 0) if metric. Source: Ranftl et al.
    2020, "MiDaS", eq. 4 (for inverses)."""
    return (image[0] * pose.to_camera(point)[2] + image[1] - measured) / sigma


@with_data(pixel=vectors(2), time=NUMBER, sigma=deviations(2))
@residual
def rolling_shutter(pose, lens, point, velocity, *, pixel, time, sigma):
    """The pixel of a point `time` (seconds) after the moment of the pose, less `pixel` (2, as
    `BundleProblem.observations`), over `sigma` (two numbers). It stands for that observation: give
    it no weight.

    The block `velocity` has for each image the angular velocity in the camera's frame, as a
    gyroscope there measures it (rad/s), and the linear one in the world (scene units/s): `P =
    exp(-time w) (R (X - time v) + t)`. Source: Hedborg et al. 2012, "Rolling Shutter Bundle
    Adjustment", with constant velocities instead of interpolated poses."""
    turn = rotation_matrix(-time * velocity[:3, None])[..., 0]
    return (lens.project(turn @ pose.to_camera(point - time * velocity[3:])) - pixel) / sigma


@with_data(low=vectors(ANY), high=vectors(ANY), sigma=deviations(ANY))
@residual
def lens_bounds(lens, *, low, high, sigma):
    """A soft barrier at bounds of the numbers of a lens, in the order of its camera model: of the
    excess d over `sigma` a smooth hinge `(d + sqrt(d^2 + 1)) / 2`, 1/2 at a bound, d far beyond it
    and `1 / (4 |d|)` far inside (two numbers for each). Take `sigma` much smaller than the
    interval. Source: Barron 2021, "Squareplus"."""
    excess = jnp.concatenate([low, -high]) - jnp.concatenate([lens.numbers, -lens.numbers])
    d = (excess.reshape(2, -1) / sigma).ravel()
    root = jnp.sqrt(d * d + 1)
    # the same number, without cancellation
    return jnp.where(d < 0, 0.5 / (root + jnp.abs(d)), 0.5 * (d + root))
