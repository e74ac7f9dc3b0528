"""Residuals ready to use with `jaxba.with_residual`: what surveyors, robots, depth maps and lenses
say besides pixels.

Data are whitened by `sigma`, a standard deviation, or by `whitening`, `Sigma^(-1/2)` of a
covariance. Lengths are in scene units and in the frame that the problem has when the rows are
registered, angles in radians, rotations matrices, cameras' axes those of COLMAP
(`jaxba.problem.row_value.Pose`)."""

from jaxba.residuals.geometry import (
    baseline,
    control_point,
    distance,
    gravity,
    heading,
    point_to_plane,
    position,
)
from jaxba.residuals.images import depth, lens_bounds, rolling_shutter
from jaxba.residuals.motion import imu, preintegrated, relative_pose

__all__ = [
    "baseline",
    "control_point",
    "depth",
    "distance",
    "gravity",
    "heading",
    "imu",
    "lens_bounds",
]
__all__ += ["point_to_plane", "position", "preintegrated", "relative_pose", "rolling_shutter"]
