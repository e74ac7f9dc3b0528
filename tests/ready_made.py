"""Rows of all ready-made residuals of a scene, near what they measure."""

from __future__ import annotations

from typing import Any

import numpy as np

import jaxba
from jaxba import residuals
from jaxba.problem import geometry
from jaxba.problem.residuals import Rows
from jaxba.problem.similarity import Similarity, transformed
from jaxba.scenes import SceneConfig

CAMERAS = 5
POINTS = 30

EACH = np.arange(CAMERAS - 1)  # images and points that have rows

ORIGINS = {"origin": (0.0, 0.0, 0.0), "map": (6e5, 6.6e6, 100.0), "earth": (4e6, 5e5, 4.9e6)}
"""Where a scene may be: around the origin, in a projected system, around the centre of the earth;
metres."""


def scene(origin: str = "origin", size: float = 1.0, noise: float = 0.5) -> jaxba.BundleProblem:
    """A scene of some 20 metres times `size`."""
    problem = jaxba.random_scene(SceneConfig(CAMERAS, POINTS, 150, noise=noise), 3)
    return transformed(problem, Similarity(size, np.eye(3), np.array(ORIGINS[origin])))


def colmap_rotations(problem: jaxba.BundleProblem) -> np.ndarray:
    """Rotations from the world to the cameras, in the axes of COLMAP."""
    return geometry.COLMAP_FLIP[:, None] * geometry.rotation_matrices(problem.cameras[:, :3])


def row_of(name: str, problem: jaxba.BundleProblem) -> tuple[Rows, dict[str, Any]]:
    """Rows of a ready-made residual by its name, and the start of its unknowns."""
    return {
        "baseline": _baseline,
        "control_point": _control_point,
        "depth": _depth,
        "distance": _distance,
        "gravity": _gravity,
        "heading": _heading,
        "imu": _imu,
        "lens_bounds": _lens_bounds,
        "point_to_plane": _point_to_plane,
        "position": _position,
        "relative_pose": _relative_pose,
        "rolling_shutter": _rolling_shutter,
    }[name](problem)


def _baseline(problem: jaxba.BundleProblem) -> tuple[Rows, dict[str, Any]]:
    centers = geometry.camera_centers(problem.cameras)
    length = 1.1 * np.linalg.norm(np.diff(centers, axis=0), axis=1)
    return residuals.baseline(pose=EACH, pose_2=EACH + 1, length=length, sigma=0.1), {}


def _control_point(problem: jaxba.BundleProblem) -> tuple[Rows, dict[str, Any]]:
    whitening = np.eye(3) / 0.1
    place = problem.points[EACH] + 0.1
    return residuals.control_point(point=EACH, position=place, whitening=whitening), {}


def _depth(problem: jaxba.BundleProblem) -> tuple[Rows, dict[str, Any]]:
    kept = slice(None, None, 9)
    camera = problem.camera_index[kept]
    measured = 1.1 * geometry.depths(problem)[kept]
    point = problem.point_index[kept]
    rows = residuals.depth(pose=camera, point=point, image=camera, measured=measured, sigma=0.1)
    return rows, {"image": np.tile([1.0, 0.0], (CAMERAS, 1))}


def _distance(problem: jaxba.BundleProblem) -> tuple[Rows, dict[str, Any]]:
    length = 1.1 * np.linalg.norm(problem.points[EACH + 1] - problem.points[EACH], axis=1)
    return residuals.distance(point=EACH, point_2=EACH + 1, length=length, sigma=0.1), {}


def _gravity(problem: jaxba.BundleProblem) -> tuple[Rows, dict[str, Any]]:
    up = np.array([0.0, 0.2, 1.0])
    measured = colmap_rotations(problem)[EACH] @ up + 0.1
    return residuals.gravity(pose=EACH, direction=measured, up=up, sigma=0.1), {}


def _heading(problem: jaxba.BundleProblem) -> tuple[Rows, dict[str, Any]]:
    ahead = colmap_rotations(problem)[EACH, 2]
    azimuth = np.arctan2(ahead[:, 0], ahead[:, 1]) + 0.1
    north, up = np.eye(3)[1:]
    return residuals.heading(pose=EACH, azimuth=azimuth, north=north, up=up, sigma=0.1), {}


def _imu(problem: jaxba.BundleProblem) -> tuple[Rows, dict[str, Any]]:
    times = np.linspace(0.0, CAMERAS, 20 * CAMERAS + 1)
    rates = np.tile([0.1, 0.2, 0.3], (len(times), 1))
    forces = np.tile([0.0, 0.5, 9.8], (len(times), 1))
    noise = [1e-3, 1e-2, 1e-4, 1e-3]
    measured = residuals.preintegrated(times, rates, forces, np.arange(CAMERAS), noise=noise)
    down = np.array([0.0, 0.0, -9.81])
    index = {"pose": EACH, "motion": EACH, "pose_2": EACH + 1, "motion_2": EACH + 1}
    rows = residuals.imu(**index, **measured, gravity=down, mount=np.eye(3, 4))
    return rows, {"motion": np.zeros((CAMERAS, 9))}


def _lens_bounds(problem: jaxba.BundleProblem) -> tuple[Rows, dict[str, Any]]:
    lens = problem.cameras[:, 6:]
    low = lens.min(axis=0) - 1.0
    high = lens.max(axis=0) + 1.0
    return residuals.lens_bounds(lens=EACH, low=low, high=high, sigma=0.5), {}


def _point_to_plane(problem: jaxba.BundleProblem) -> tuple[Rows, dict[str, Any]]:
    normal = np.eye(3)[EACH % 3]
    place = problem.points[EACH] + 0.1
    return residuals.point_to_plane(point=EACH, normal=normal, on_plane=place, sigma=0.1), {}


def _position(problem: jaxba.BundleProblem) -> tuple[Rows, dict[str, Any]]:
    place = geometry.camera_centers(problem.cameras)[EACH] + 0.1
    arm = np.array([0.1, -0.2, 0.3])
    whitening = np.eye(3) / 0.1
    return residuals.position(pose=EACH, position=place, lever_arm=arm, whitening=whitening), {}


def _relative_pose(problem: jaxba.BundleProblem) -> tuple[Rows, dict[str, Any]]:
    rotation, translation = relative_poses(problem)
    whitening = np.diag([10.0] * 3 + [5.0] * 3)
    measured = {"rotation": rotation, "translation": translation + 0.1, "whitening": whitening}
    return residuals.relative_pose(pose=EACH, pose_2=EACH + 1, **measured), {}


def relative_poses(problem: jaxba.BundleProblem) -> tuple[np.ndarray, np.ndarray]:
    """Rotations and translations of all images but the first in the frame of the one before."""
    rotations = colmap_rotations(problem)
    moves = np.diff(geometry.camera_centers(problem.cameras), axis=0)
    turn = rotations[:-1] @ rotations[1:].transpose(0, 2, 1)
    return turn, np.einsum("nij,nj->ni", rotations[:-1], moves)


def _rolling_shutter(problem: jaxba.BundleProblem) -> tuple[Rows, dict[str, Any]]:
    camera = problem.camera_index
    point = problem.point_index
    time = np.linspace(-0.4, 0.4, len(camera))
    index = {"pose": camera, "lens": camera, "point": point, "velocity": camera}
    rows = residuals.rolling_shutter(**index, pixel=problem.observations, time=time, sigma=1.0)
    return rows, {"velocity": np.zeros((CAMERAS, 6))}
