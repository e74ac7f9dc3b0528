"""Residuals of points and poses: surveys, scale bars, planes, GNSS and attitude."""

from __future__ import annotations

import jax.numpy as jnp

from jaxba.problem.residuals import residual, with_data
from jaxba.problem.row_data import (
    DIRECTION,
    NUMBER,
    POSITIVE,
    UNIT_VECTOR,
    VECTOR,
    deviations,
    whitenings,
)
from jaxba.problem.row_value import times
from jaxba.problem.safe_math import safe_sqrt


@with_data(position=VECTOR, whitening=whitenings(3))
@residual
def control_point(point, *, position, whitening):
    """A surveyed point: its difference from `position` (3), whitened by a matrix (3, 3) (three
    numbers)."""
    return times(whitening, point - position)


@with_data(length=POSITIVE, sigma=POSITIVE)
@residual
def distance(point, point_2, *, length, sigma):
    """A scale bar: the distance between two points less `length`, over `sigma` (one number)."""
    return (safe_sqrt(jnp.sum((point_2 - point) ** 2)) - length) / sigma


@with_data(normal=UNIT_VECTOR, on_plane=VECTOR, sigma=POSITIVE)
@residual
def point_to_plane(point, *, normal, on_plane, sigma):
    """A surface that a LiDAR has measured: the distance of a point from the plane through
    `on_plane` (3) with a unit `normal` (3), over `sigma` (one number). Source: Chen and Medioni
    1992, "Object modelling by registration"."""
    return normal @ (point - on_plane) / sigma


@with_data(length=POSITIVE, sigma=POSITIVE)
@residual
def baseline(pose, pose_2, *, length, sigma):
    """The distance between the centres of two cameras less `length`, over `sigma` (one number)."""
    return (safe_sqrt(jnp.sum((pose_2.center - pose.center) ** 2)) - length) / sigma


@with_data(direction=DIRECTION, up=DIRECTION, sigma=deviations(3))
@residual
def gravity(pose, *, direction, up, sigma):
    """What an accelerometer at rest measures, which is up: `direction` (3, in the camera's frame)
    against `up` (3, in the world), of any length. The difference of the unit vectors, nearly the
    angle, over `sigma` (radians; three numbers, of which two count). Source: GTSAM's attitude
    factors, which have two numbers in the tangent plane."""
    return (
        times(pose.rotation, up) / jnp.sqrt(up @ up) - direction / jnp.sqrt(direction @ direction)
    ) / sigma


@with_data(azimuth=NUMBER, north=DIRECTION, up=DIRECTION, sigma=POSITIVE)
@residual
def heading(pose, *, azimuth, north, up, sigma):
    """What a compass measures: the azimuth of the optical axis, clockwise from `north` (3) about
    `up` (3) seen from above, less `azimuth`, over `sigma` (radians; one number within pi / sigma).
    Of `north` the part across `up` counts. Not defined where a camera looks straight up or down.
    Magnetic azimuths need the declination added."""
    east = jnp.cross(north, up)
    ahead = jnp.cross(up, east) / jnp.sqrt(up @ up)
    x = pose.rotation[2] @ ahead
    y = pose.rotation[2] @ east
    cos = jnp.cos(azimuth)
    sin = jnp.sin(azimuth)
    return jnp.arctan2(y * cos - x * sin, x * cos + y * sin) / sigma


@with_data(position=VECTOR, lever_arm=VECTOR, whitening=whitenings(3))
@residual
def position(pose, *, position, lever_arm, whitening):
    """A GNSS antenna at `lever_arm` (3) in the camera's frame, at `position` (3) in the world,
    whitened (3, 3)."""
    return times(whitening, pose.center + times(pose.rotation.T, lever_arm) - position)
