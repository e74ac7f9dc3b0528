"""Options of the problem that is made of a sequence."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from jaxba.kitti.triangulate import Filters

Features = Literal["sift", "orb", "klt"]

MIN_MATCHES = 40
"""Verified matches that link two frames: random matches of textured images reach some 15 inliers."""


@dataclass(frozen=True)
class BuildOptions:
    """Options of `build`; those of `jaxba-kitti` of the same name say more."""

    features: Features = "sift"
    """Kind of key-points, or `klt` for points tracked by Lucas-Kanade."""

    keypoints: int = 2000
    """Largest number of key-points of a frame."""

    reach: int = 3
    """Number of earlier frames that a frame is matched with; for KLT, of bad frames in a row after which it fails."""

    min_matches: int = MIN_MATCHES
    """Verified matches that link two frames."""

    seed: int = 0
    """Seed of every random sample."""

    keyframes: str = "auto"
    """`auto`, `all` or N for every N-th frame."""

    start: Literal["vo", "poses", "noisy-poses"] = "vo"
    """Source of the initial poses."""

    rotation_sigma: float = 0.1
    """Of `noisy-poses`: degrees per key-frame."""

    translation_sigma: float = 0.05
    """Of `noisy-poses`: relative to the length of the motion."""

    min_angle: float = Filters.angle
    """Least angle in degrees between two rays of a point."""

    max_error: float = Filters.pixels
    """Largest reprojection error of an observation, pixels."""

    min_views: int = 2
    """Observations that a point needs."""
