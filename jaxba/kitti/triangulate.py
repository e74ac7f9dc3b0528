"""Triangulation of many tracks at once, from cameras with known poses.

Cameras here look down +z: a point `X` of the world is at `R X + t`, and its ray is `(x / z, y /
z)`."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxba.problem.geometry import perspective, translations

# Gauss-Newton steps of a point after the linear solution; three are enough on most tracks
GAUSS_NEWTON_STEPS = 6
SMALLEST = 1e-12  # damping of the linear systems of a point, relative, for rays that are parallel


class Views(NamedTuple):
    """Poses of cameras, world to camera."""

    rotation: Float[np.ndarray, "cameras 3 3"]
    translation: Float[np.ndarray, "cameras 3"]

    def centers(self) -> Float[np.ndarray, "cameras 3"]:
        """Positions in the world."""
        return -np.einsum("nji,nj->ni", self.rotation, self.translation)

    def local(self, camera: np.ndarray, points: np.ndarray) -> Float[np.ndarray, "n 3"]:
        """Points (n, 3) in the frames of cameras (n,)."""
        return np.einsum("nij,nj->ni", self.rotation[camera], points) + self.translation[camera]


def views_of_poses(poses: Float[np.ndarray, "views 3 4"]) -> Views:
    """World-to-camera views of camera-to-world poses."""
    rotation = poses[:, :, :3].transpose(0, 2, 1)
    return Views(rotation, translations(rotation, poses[:, :, 3]))


class Observations(NamedTuple):
    """Rays of tracks, sorted by track; every track from 0 to the last one has at least one."""

    camera: Int[np.ndarray, " n"]
    track: Int[np.ndarray, " n"]
    rays: Float[np.ndarray, "n 2"]

    def numbered(self, rows: np.ndarray) -> tuple[Int[np.ndarray, " tracks"], Observations]:
        """Numbers of the tracks of some rows, and these rows, whose tracks have positions among
        them as numbers."""
        names, track = np.unique(self.track[rows], return_inverse=True)
        return names, Observations(self.camera[rows], track, self.rays[rows])


class Triangulated(NamedTuple):
    """Points and their errors."""

    points: Float[np.ndarray, "tracks 3"]
    angle: Float[np.ndarray, " tracks"]  # largest between the first ray and any other, degrees
    depth: Float[np.ndarray, " n"]  # of each observation
    # distance of each ray from the point's, in units of the focal length
    error: Float[np.ndarray, " n"]

    def good(self, track: np.ndarray, angle: float, error: float) -> Bool[np.ndarray, " tracks"]:
        """Tracks whose point lies in front of all its cameras, with an angle and errors within
        these limits."""
        good = self.angle >= angle
        good[track[(self.depth <= 0) | ~(self.error <= error)]] = False
        return good


def triangulate(views: Views, observations: Observations) -> Triangulated:
    """Points that minimise the squared reprojection errors: the points nearest to the rays, refined
    by Gauss-Newton."""
    camera, track, rays = observations
    starts = np.flatnonzero(np.diff(track, prepend=-1))

    def total(values):
        return np.add.reduceat(values, starts, axis=0)

    rotation = views.rotation[camera]
    centers = views.centers()[camera]
    origin = centers[starts]  # of the points in the following, so that few digits are lost
    baseline = centers - origin[track]
    shift = -np.einsum("nij,nj->ni", rotation, baseline)
    directions = np.einsum("nji,nj->ni", rotation, np.column_stack([rays, np.ones(len(rays))]))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    across = np.eye(3) - directions[:, :, None] * directions[:, None]
    points = _solve(total(across), total(np.einsum("nij,nj->ni", across, baseline)))

    def residual(at: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        local = np.einsum("nij,nj->ni", rotation, at[track]) + shift
        with np.errstate(invalid="ignore", over="ignore"):
            difference = perspective(local) - rays
            return local, difference, total((difference**2).sum(axis=1))

    for _ in range(GAUSS_NEWTON_STEPS):
        local, difference, cost = residual(points)
        inverse = 1 / np.where(local[:, 2] == 0, np.inf, local[:, 2])
        plane = local[:, :2] * inverse[:, None]
        # [n, 2, 3]
        slope = inverse[:, None, None] * (rotation[:, :2] - plane[:, :, None] * rotation[:, 2:])
        gradient = np.einsum("nki,nk->ni", slope, np.nan_to_num(difference))
        new = points - _solve(total(np.einsum("nki,nkj->nij", slope, slope)), total(gradient))
        points = np.where((residual(new)[2] < cost)[:, None], new, points)
    local, difference, _ = residual(points)
    with np.errstate(divide="ignore", invalid="ignore"):
        directions = points[track] - baseline
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    chord = np.nan_to_num(np.linalg.norm(directions - directions[starts][track], axis=1))
    angle = np.rad2deg(2 * np.arcsin(np.minimum(np.maximum.reduceat(chord, starts) / 2, 1)))
    return Triangulated(points + origin, angle, local[:, 2], np.linalg.norm(difference, axis=1))


def _solve(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Solutions of many 3 x 3 systems, a little damped."""
    damping = SMALLEST * np.trace(matrix, axis1=1, axis2=2) + 1e-300
    return np.linalg.solve(matrix + damping[:, None, None] * np.eye(3), right[:, :, None])[:, :, 0]


def triangulate_robustly(
    views: Views, observations: Observations, angle: float, error: float, min_views: int = 2
) -> tuple[Float[np.ndarray, "tracks 3"], Bool[np.ndarray, " n"]]:
    """Points of all tracks, and which observations are good; the point of a track without any is
    meaningless.

    Points are triangulated once more without the observations whose errors are too large.

    A point needs `min_views` errors of at most `error` focal lengths, and two rays `angle` degrees
    apart."""
    first = triangulate(views, observations)
    points = first.points
    keep = (first.error <= error) & (first.depth > 0)
    keep &= (
        np.bincount(observations.track[keep], minlength=len(points))[observations.track]
        >= min_views
    )
    names, rest = observations.numbered(keep)
    second = triangulate(views, rest)
    good = second.good(rest.track, angle, error)
    points[names] = second.points
    keep[keep] = good[rest.track]
    return points, keep
