"""Options of a random scene, their checks, and named configurations."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Literal, get_args

import numpy as np

from jaxba.problem.bundle_problem import ProblemError

# arrangement of the cameras, see `SceneConfig`
Trajectory = Literal["forward", "lateral", "orbit", "photos"]
# half-width of the cone of monotone distortion, relative to the image without distortion
VIEW_MARGIN = 1.25


@dataclass(frozen=True)
class SceneConfig:
    """A random scene, and how far its initial values are from the truth. Lengths are in steps of
    the camera path."""

    cameras: int = 150
    """Number of cameras, at least 2."""

    points: int = 20000
    """Number of points; each is seen by at least two cameras."""

    observations: int = 0
    """Number of observations, met exactly; 0 takes points times mean_track."""

    mean_track: float = 4.4
    """Mean number of cameras that see a point, used where observations is 0 (BAL: 3.2 to 6.5)."""

    trajectory: Trajectory = "forward"
    """forward: along streets, looking ahead. lateral: the same path, looking outwards at right
    angles. orbit: around an object, looking at it. photos: tourists' photographs of a long facade,
    in random order."""

    step: float = 1.0
    """Distance between neighbouring cameras in scene units: the unit of every length below."""

    lap: int = 400
    """Cameras in one round of the forward and lateral path, four equal sides; a longer path repeats
    it."""

    position_jitter: float = 0.1
    """Sigma of a camera's distance from the smooth path, in steps."""

    rotation_jitter: float = 0.02
    """Sigma of a camera's rotation relative to that of the smooth path, in radians."""

    min_depth: float = 1.0
    """Nearest points, in steps."""

    max_depth: float = 100.0
    """Farthest points, in steps. Orbit and photos look from the geometric mean of the two
    depths."""

    gap_share: float = 0.3
    """Chance that a camera in the middle of a track misses the point although it could see it."""

    revisit_share: float = 0.05
    """Share of the points that are also matched on another round of the path (loop closure)."""

    image_width: float = 1280.0
    """Width of the images in pixels."""

    image_height: float = 960.0
    """Height of the images in pixels."""

    focal: tuple[float, float] = (800.0, 800.0)
    """Smallest and largest focal length in pixels; log-uniform between."""

    k1: tuple[float, float] = (-0.05, 0.0)
    """Smallest and largest first radial distortion; uniform between."""

    k2: tuple[float, float] = (0.0, 0.0)
    """Smallest and largest second radial distortion; uniform between."""

    noise: float = 0.5
    """Sigma of the measurements in pixels, per coordinate (BAL's optima: 0.6 to 0.9)."""

    outlier_share: float = 0.0
    """Share of the observations that are outliers."""

    outlier_size: float = 30.0
    """An outlier moves each coordinate by up to this many pixels, uniformly."""

    start_rotation: float = 0.002
    """Sigma of the start's camera rotations, in radians per axis."""

    start_center: float = 0.02
    """Sigma of the start's camera centres, in steps per axis."""

    start_point: float = 0.004
    """Sigma of the start's points per axis, relative to the smallest depth at which they are
    seen."""

    start_focal: float = 0.003
    """Sigma of the start's focal lengths, relative."""

    start_drift: float = 0.0
    """Sigma of the rotation by which the start's path drifts at each camera, in radians per axis.
    Points drift with the first camera that sees them, so residuals stay small, as with odometry,
    and many iterations are needed."""

    @property
    def total(self) -> int:
        """Observations that the scene will have."""
        return self.observations or round(self.points * min(self.mean_track, self.cameras))


def check(config: SceneConfig) -> None:
    """Refuses options that no scene can satisfy. Raises ProblemError: with one line that names the
    option."""
    for field in fields(config):
        value = getattr(config, field.name)
        if not isinstance(value, str) and not np.isfinite(value).all():
            raise ProblemError(f"{field.name} is not finite: {value}")
    if config.cameras < 2 or config.points < 1:
        raise ProblemError(
            f"a scene needs 2 cameras and a point, not {config.cameras} and {config.points}"
        )
    low = 2 * config.points
    high = config.cameras * config.points
    if not low <= config.total <= high:
        raise ProblemError(
            f"observations must be {low} to {high} for these cameras and points, not {config.total}"
        )
    positive = ("step", "lap", "min_depth", "image_width", "image_height")
    shares = ("gap_share", "revisit_share", "outlier_share")
    sigmas = (
        "position_jitter",
        "rotation_jitter",
        "noise",
        "outlier_size",
        "start_rotation",
        "start_center",
    )
    for name in (*positive, *shares, *sigmas, "start_point", "start_focal", "start_drift"):
        value = getattr(config, name)
        if value < 0 or (value == 0 and name in positive) or (value > 1 and name in shares):
            what = (
                "be positive"
                if name in positive
                else "be between 0 and 1"
                if name in shares
                else "not be negative"
            )
            raise ProblemError(f"{name} must {what}, not {value}")
    if config.trajectory not in get_args(Trajectory):
        raise ProblemError(
            f"trajectory must be forward, lateral, orbit or photos, not {config.trajectory}"
        )
    ranges = {
        "depth": (config.min_depth, config.max_depth),
        "focal": config.focal,
        "k1": config.k1,
        "k2": config.k2,
    }
    for name, (low, high) in ranges.items():
        if low > high:
            raise ProblemError(f"the range of {name} is empty: {low} to {high}")
    if config.focal[0] <= 0:
        raise ProblemError(f"focal must be positive, not {config.focal[0]}")
    corner = VIEW_MARGIN * np.hypot(config.image_width, config.image_height) / (2 * config.focal[0])
    square = np.linspace(0, corner**2, 100)
    if (1 + 3 * config.k1[0] * square + 5 * config.k2[0] * square**2 <= 0).any():
        raise ProblemError(
            "k1 and k2 fold the image over itself: bring them nearer to 0 or lengthen focal"
        )


OUTLIER_SHARE = 0.002
OUTLIER_SIZE = 10.0
"""Outliers give BAL's slow convergence: Ceres' rule needs 16 iterations on `ladybug-49` with them,
11 without."""

# times `cameras^-1.5`: a start's drift per camera; a street's end is off by 0.2 steps at any length
STREET_DRIFT = 0.3


def _street(cameras: int, points: int, observations: int) -> SceneConfig:
    """Like BAL's Ladybug: upright images, one focal length, hardly any distortion (measured on its
    first file)."""
    return SceneConfig(
        cameras=cameras,
        points=points,
        observations=observations,
        trajectory="forward",
        gap_share=0.5,
        image_width=768.0,
        image_height=1024.0,
        focal=(395.0, 410.0),
        k1=(0.0, 0.0),
        noise=0.65,
        start_drift=STREET_DRIFT * cameras**-1.5,
        outlier_share=OUTLIER_SHARE,
        outlier_size=OUTLIER_SIZE,
    )


def _photos(cameras: int, points: int, observations: int) -> SceneConfig:
    """Like BAL's collections of photographs: a crowd before a facade, images as in its first
    Trafalgar file."""
    return SceneConfig(
        cameras=cameras,
        points=points,
        observations=observations,
        trajectory="photos",
        min_depth=10.0,
        max_depth=250.0,
        gap_share=0.5,
        image_width=1600.0,
        image_height=1200.0,
        focal=(1000.0, 3000.0),
        noise=0.8,
        outlier_share=OUTLIER_SHARE,
        outlier_size=OUTLIER_SIZE,
    )


LIKE: dict[str, SceneConfig] = {
    "tiny": SceneConfig(6, 40, 200, trajectory="orbit", min_depth=4.0, max_depth=16.0),
    "paper": SceneConfig(10, 10, 100, trajectory="orbit", min_depth=4.0, max_depth=16.0),
    "random-150": SceneConfig(150, 20000, 88000),
    "ladybug-49": _street(49, 7776, 31843),
    "trafalgar-21": _photos(21, 11315, 36455),
    "dubrovnik-356": _photos(356, 226730, 1255268),
    "ladybug-1197": _street(1197, 126327, 563734),
    "venice-1778": _photos(1778, 993923, 5001946),
    "final-13682": _photos(13682, 4456117, 28987644),
}
"""Random scenes with the exact counts of known problems (BAL's header lines), plus small ones:
`paper` has the 10 cameras and 10 points, all visible, of the paper that this project reproduces."""


def scene_like(name: str) -> SceneConfig:
    """The configuration of a name in `LIKE`. Raises ProblemError: no such name; the message lists
    the known ones."""
    if name not in LIKE:
        raise ProblemError(f"no scene is called {name!r}; known are {', '.join(LIKE)}")
    return LIKE[name]


def _far(config: SceneConfig) -> SceneConfig:
    """The scene with a start that is five to ten times as far away as usual."""
    return replace(
        config, start_rotation=0.01, start_center=0.1, start_point=0.03, start_focal=0.03
    )


_SMALL = SceneConfig(cameras=20, points=1500, mean_track=4.5)
"""Scenes of this size have one capacity (structure/padding.py), and so share compiled programs."""

DEFAULT_SCENES: dict[str, SceneConfig] = {
    "street": replace(_SMALL, start_drift=0.003),
    "street-outliers": replace(_SMALL, outlier_share=0.02),
    "lateral": replace(_SMALL, trajectory="lateral"),
    "photos-far": _far(replace(_SMALL, trajectory="photos")),
    "orbit-noisy": replace(_SMALL, trajectory="orbit", noise=2.0),
    "orbit-far": _far(replace(_SMALL, trajectory="orbit")),
}
"""Random scenes that commands use if no problem is given: `jaxba-bench` all of them, `jaxba-solve`
the first."""
