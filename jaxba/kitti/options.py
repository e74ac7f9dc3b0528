"""Options of the problem that is made of a sequence, which are those of `jaxba-kitti`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

# verified matches that link two frames: random matches of textured images reach some 15 inliers
MIN_MATCHES = 40


@dataclass(frozen=True)
class Build:
    """How the problem is made."""

    keypoints: int = 2000
    """Key-points per frame at most."""

    reach: int = 3
    """Previous frames that a frame is matched with."""

    min_matches: int = MIN_MATCHES
    """Verified matches between two frames at least."""

    keyframes: Annotated[str, "RULE"] = "auto"
    """auto: by parallax and the fraction of tracks left. all: every frame. N: every N-th frame."""

    start: Literal["vo", "poses"] = "vo"
    """vo: start from monocular visual odometry. poses: from --poses."""

    min_angle: float = 1.0
    """Smallest angle of a point's rays, degrees."""

    max_error: float = 3.0
    """Largest reprojection error of an observation, pixels."""

    min_views: int = 2
    """Key-frames that observe a point at least."""
