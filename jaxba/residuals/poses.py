"""Residuals of poses: baselines, inclinometer and compass, GNSS, and relative poses."""

from __future__ import annotations

import jax.numpy as jnp

from jaxba.problem.residuals import residual
from jaxba.problem.row_value import times
from jaxba.problem.safe_math import safe_sqrt
from jaxba.rotations import angle_axis, left_jacobian_inverse


@residual
def baseline(pose, pose_2, *, length, sigma):
    """The distance between the centres of two cameras less `length`, over `sigma` (one number)."""
    return (safe_sqrt(jnp.sum((pose_2.center - pose.center) ** 2)) - length) / sigma


@residual
def gravity(pose, *, direction, up, sigma):
    """What an accelerometer at rest measures, which is up: `direction` (3, of any length, in the camera's frame)
    against `up` (3, of any length, in the world).

    The difference of the unit vectors, whose length is the angle where it is small, over `sigma` (radians; three
    numbers, of which two count). Source: the attitude factors of GTSAM, which have two numbers in the tangent plane."""
    return (times(pose.rotation, up) / jnp.sqrt(up @ up) - direction / jnp.sqrt(direction @ direction)) / sigma


@residual
def heading(pose, *, azimuth, north, up, sigma):
    """What a compass measures: the azimuth of the optical axis from `north` (3), clockwise seen from above, about `up`
    (3), less `azimuth`, over `sigma` (radians; one number in (-pi, pi] / sigma).

    Of `north` only the part across `up` counts. Not defined for a camera that looks straight up or down. For
    magnetic azimuths add the declination."""
    east = jnp.cross(north, up)
    ahead = jnp.cross(up, east) / jnp.sqrt(up @ up)
    x, y = pose.rotation[2] @ ahead, pose.rotation[2] @ east
    cos, sin = jnp.cos(azimuth), jnp.sin(azimuth)
    return jnp.arctan2(y * cos - x * sin, x * cos + y * sin) / sigma


@residual
def position(pose, *, position, lever_arm, whitening):
    """A GNSS antenna at `lever_arm` (3) in the camera's frame, measured at `position` (3) in the world: the difference
    whitened by a matrix (3, 3) (three numbers). A lever arm of zeros: the camera's centre."""
    return times(whitening, pose.center + times(pose.rotation.T, lever_arm) - position)


@residual
def relative_pose(pose, pose_2, *, rotation, translation, whitening):
    """Odometry or a loop closure: the pose of the second camera in the frame of the first, `P_1 = rotation P_2 +
    translation`, so that `translation` (3) is the second one's centre seen by the first.

    With Z this measurement and T the poses from camera to world, the logarithm in SE(3) of `Z^-1 T_1^-1 T_2`: a
    rotation w (radians), then a translation, both in the measured frame of the second camera, whitened by a matrix
    (6, 6). It is the error of GTSAM's BetweenFactor of Pose3. That of g2o's EDGE_SE3:QUAT has the translation first,
    which is `V(w)` times this one, and then the vector part of a quaternion, nearly w / 2.
    Source: Sola et al. 2018, "A micro Lie theory", eqs. 172-174."""
    between = pose_2.between(pose)
    turn = angle_axis((rotation.T @ between.rotation)[None])[0]
    shift = rotation.T @ (between.translation - translation)
    return times(whitening, jnp.concatenate([turn, left_jacobian_inverse(turn[:, None])[..., 0] @ shift]))
