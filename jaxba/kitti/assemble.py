"""Views and tracks as a bundle adjustment problem in BAL's convention."""

from __future__ import annotations

import numpy as np

from jaxba.io.frames import Calibration
from jaxba.kitti.options import Build
from jaxba.kitti.tracks import Tracks
from jaxba.kitti.triangulate import Observations, Views, triangulate_robustly
from jaxba.problem.bundle_problem import BundleProblem, ProblemError
from jaxba.problem.geometry import COLMAP_FLIP, angle_axis

# from axes x right, y down, z forward (KITTI, COLMAP) to x right, y up, z backward (BAL)
FLIP = np.diag(COLMAP_FLIP)
MIN_OBSERVATIONS = 10  # observations that a camera needs: 20 residuals for its 9 parameters


Frames = tuple[int, ...]  # frame number of every camera


def assemble(
    tracks: Tracks, views: Views, calibration: Calibration, frames: Frames, options: Build
) -> BundleProblem:
    """The problem whose cameras are `views` and whose points are the tracks that triangulate well.

    Every camera starts with the focal length fx and without distortion. Where fy differs from fx,
    vertical pixels are scaled by fx / fy. The images of the tracks are the views, which are world
    to camera, looking down +z; `frames` are their numbers, and `options` has the limits for points.
    Raises ProblemError: a camera would see fewer than 10 points."""
    rays = calibration.rays(tracks.pixels)
    observations = Observations(tracks.image, tracks.track, rays)
    error = options.max_error / calibration.fx
    points, keep = triangulate_robustly(
        views, observations, options.min_angle, error, options.min_views
    )
    seen = np.bincount(tracks.image[keep], minlength=len(frames))
    if seen.min() < MIN_OBSERVATIONS:
        bad = int(seen.argmin())
        raise ProblemError(
            f"too few points: frame {frames[bad]} sees {seen[bad]} good ones, at least "
            f"{MIN_OBSERVATIONS} are needed; "
            "choose other --frames or --start, or a smaller --min-angle"
        )
    names, point_index = np.unique(tracks.track[keep], return_inverse=True)
    points = points[names]
    cameras = np.zeros((len(frames), 9))
    cameras[:, :3] = angle_axis(FLIP @ views.rotation)
    cameras[:, 3:6] = views.translation @ FLIP
    cameras[:, 6] = calibration.fx
    pixels = calibration.fx * rays[keep] * [1, -1]
    return BundleProblem.create(cameras, points, pixels, tracks.image[keep], point_index)
