"""Poses of the cameras of a random scene, and the depths of the points that they see."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from jaxba.problem.bundle_problem import CAMERA_SIZE
from jaxba.problem.geometry import angle_axis, rotation_matrices, translations
from jaxba.scenes.config import SceneConfig

# part of a street that bends: with 400 cameras in a round by 2.25 degrees per camera
CORNER_SHARE = 0.4
# where on its side the path starts, as a part of the side, so that short paths bend too
FIRST_CORNER = 0.3
# amplitude of an orbit's height relative to its radius, so that the centres do not lie in a plane
ORBIT_WAVE = 0.2
# sigma of the logarithm of a photographer's distance: most stand within a factor of 2
PHOTO_SPREAD = 0.4
# photographers stand up to this far to either side of the facade's normal
PHOTO_ANGLE = np.deg2rad(50)
RELIEF = 1.5  # points of photos are within this factor of the photographer's distance to the facade


Depth = float | np.ndarray  # in scene units: one for all cameras, or one for each


@dataclass(frozen=True)
class Path:
    """Cameras in the order of the path, and the depths at which each one sees new points."""

    # world to camera; a camera looks down its -z, x to the right, y up
    rotations: Float[np.ndarray, "cameras 3 3"]
    centers: Float[np.ndarray, "cameras 3"]  # scene units
    near: Float[np.ndarray, " cameras"]  # nearest new points, in scene units
    far: Float[np.ndarray, " cameras"]  # farthest new points, in scene units
    # depth of the points that most other cameras see too, scene units
    focus: Float[np.ndarray, " cameras"]
    lap: int  # cameras after which the path returns to the same position; 0 where it never does
    index: Int[np.ndarray, " cameras"]  # index in the problem of each camera along the path


def make_path(config: SceneConfig, rng: np.random.Generator) -> Path:
    """The cameras of a scene, jitter included."""
    make = {"forward": _streets, "lateral": _streets, "orbit": _orbit, "photos": _photos}[
        config.trajectory
    ]
    path = make(config, rng)
    jitter = config.rotation_jitter * rng.standard_normal((config.cameras, 3))
    return replace(path, rotations=rotation_matrices(jitter) @ path.rotations)


def true_cameras(
    config: SceneConfig, path: Path, rng: np.random.Generator
) -> Float[np.ndarray, "cameras 9"]:
    """BAL parameters of the path's cameras, in the order of the path."""
    cameras = np.empty((config.cameras, CAMERA_SIZE))
    cameras[:, :3] = angle_axis(path.rotations)
    cameras[:, 3:6] = translations(path.rotations, path.centers)
    shortest, longest = config.focal
    cameras[:, 6] = shortest * (longest / shortest) ** rng.random(config.cameras)
    cameras[:, 7] = rng.uniform(*config.k1, config.cameras)
    cameras[:, 8] = rng.uniform(*config.k2, config.cameras)
    return cameras


def _streets(config: SceneConfig, rng: np.random.Generator) -> Path:
    """Rounds of a square with rounded corners; lateral cameras look outwards."""
    side = max(round(config.lap / 4), 1)
    sides = np.arange(config.cameras) / side + FIRST_CORNER
    block, within = np.divmod(sides, 1.0)
    heading = np.pi / 2 * (block + np.clip((within - 1 + CORNER_SHARE) / CORNER_SHARE, 0, 1))
    ahead = _directions(heading)
    centers = config.step * (np.cumsum(ahead, axis=0) - ahead)
    centers += config.step * config.position_jitter * rng.standard_normal(centers.shape)
    view = ahead if config.trajectory == "forward" else _directions(heading - np.pi / 2)
    far = config.step * config.max_depth
    return _path(view, centers, config.step * config.min_depth, far, far, 4 * side)


def _orbit(config: SceneConfig, rng: np.random.Generator) -> Path:
    """Rounds about the origin, which every camera looks at."""
    radius = np.sqrt(config.min_depth * config.max_depth)
    lap = max(round(2 * np.pi * radius), 1)
    angle = 2 * np.pi * np.arange(config.cameras) / lap
    centers = -_directions(angle)
    centers[:, 1] = ORBIT_WAVE * np.sin(2 * angle)
    centers = config.step * (
        radius * centers + config.position_jitter * rng.standard_normal(centers.shape)
    )
    focus = np.linalg.norm(centers, axis=1)
    near = np.maximum(config.step * config.min_depth, focus / 2)
    far = np.minimum(config.step * config.max_depth, focus * 2)
    return _path(-centers, centers, near, far, focus, lap)


def _photos(config: SceneConfig, rng: np.random.Generator) -> Path:
    """Photographs of points along a facade (the plane z = 0), from many sides and distances, in
    random order."""
    count = config.cameras
    targets = np.zeros((count, 3))
    targets[:, 0] = np.cumsum(rng.exponential(config.step, count))
    low = np.log(config.min_depth)
    high = np.log(config.max_depth)
    distance = np.clip((low + high) / 2 + PHOTO_SPREAD * rng.standard_normal(count), low, high)
    focus = config.step * np.exp(distance)
    side = -_directions(rng.uniform(-PHOTO_ANGLE, PHOTO_ANGLE, count))
    centers = targets + focus[:, None] * side
    centers[:, 1] += config.step * rng.standard_normal(count)
    path = _path(targets - centers, centers, focus / RELIEF, focus * RELIEF, focus, 0)
    return replace(path, index=rng.permutation(count).astype(np.int32))


def _path(
    view: np.ndarray, centers: np.ndarray, near: Depth, far: Depth, focus: Depth, lap: int
) -> Path:
    """Cameras that look along `view` from `centers` (both (n, 3)); a depth may be one number for
    all."""
    count = len(centers)
    near, far, focus = (
        np.broadcast_to(np.asarray(depth, dtype=np.float64), (count,))
        for depth in (near, far, focus)
    )
    return Path(
        _look(view),
        centers,
        np.minimum(near, far),
        far,
        focus,
        lap,
        np.arange(count, dtype=np.int32),
    )


def _directions(heading: np.ndarray) -> np.ndarray:
    """Horizontal unit vectors (n, 3): heading 0 is -z and a quarter turn is x, seen from above to
    the right."""
    return np.stack([np.sin(heading), np.zeros_like(heading), -np.cos(heading)], axis=1)


def _look(view: np.ndarray) -> np.ndarray:
    """World-to-camera rotations (n, 3, 3) that look along `view` (n, 3), with the world's y
    upwards."""
    back = -view / np.linalg.norm(view, axis=1, keepdims=True)
    right = np.cross([0.0, 1.0, 0.0], back)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    return np.stack([right, np.cross(back, right), back], axis=1)
