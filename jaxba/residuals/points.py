"""Residuals of points: depth maps, surveyed points, scale bars, planes, and pixels of a rolling shutter."""

from __future__ import annotations

import functools

import jax.numpy as jnp

from jaxba.problem.residuals import Residual, residual
from jaxba.problem.row_value import times
from jaxba.problem.safe_math import safe_sqrt
from jaxba.rotations import rotation_matrix


@residual
def depth(pose, point, image, *, measured, sigma):
    """A depth map at the pixel of a point, up to a scale and a shift of each image (one number).

    `scale z + shift - measured` over `sigma`, with (scale, shift) in the block `image`, which starts at (1, 0) for
    metric depths. Source: Ranftl et al. 2020, "Towards Robust Monocular Depth Estimation", eq. 4."""
    return (image[0] * pose.to_camera(point)[2] + image[1] - measured) / sigma


@residual
def control_point(point, *, position, whitening):
    """A surveyed point: its difference from `position` (3), whitened by a matrix (3, 3) (three numbers)."""
    return times(whitening, point - position)


@functools.partial(Residual, unknowns=("point", "point_2"), data=("length", "sigma"))
def distance(point, point_2, *, length, sigma):
    """A scale bar: the distance between two points less `length`, over `sigma` (one number)."""
    return (safe_sqrt(jnp.sum((point_2 - point) ** 2)) - length) / sigma


@residual
def point_to_plane(point, *, normal, on_plane, sigma):
    """The distance of a point from the plane through `on_plane` (3) with a unit `normal` (3), over `sigma` (one
    number), as of a surface that a LiDAR has measured. Source: Chen and Medioni 1992, "Object Modelling by Registration
    of Multiple Range Images"."""
    return normal @ (point - on_plane) / sigma


@residual
def rolling_shutter(pose, lens, point, velocity, *, pixel, time, sigma):
    """The pixel of a point seen `time` (seconds) after the moment of the pose, by a camera in steady motion (two
    numbers), less `pixel` (2, as `BundleProblem.observations`), over `sigma` (pixels).

    The block `velocity` has for each image the angular velocity in the camera's frame (rad/s, as a gyroscope there
    measures it) and the linear one in the world (scene units/s), so that
    `P = exp(-time w) (R (X - time v) + t)`. Without motion it is the pixel residual, which it stands for: give those
    observations no weight. Source: Hedborg et al. 2012, "Rolling Shutter Bundle Adjustment", with constant velocities
    instead of interpolated poses."""
    turn = rotation_matrix(-time * velocity[:3, None])[..., 0]
    return (lens.project(turn @ pose.to_camera(point - time * velocity[3:])) - pixel) / sigma
