"""Triangulation of many tracks at once, from cameras with known poses.

Cameras here look down +z: a point `X` of the world is at `R X + t`, and its ray is `(x / z, y / z)`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxba.problem.geometry import perspective

GAUSS_NEWTON_STEPS = 6
"""Gauss-Newton steps of a point after the linear solution; three are enough on most tracks."""


@dataclass(frozen=True)
class Filters:
    """Criteria that a triangulated point must meet."""

    angle: float = 1.0
    """Least angle in degrees between two rays of a point."""

    pixels: float = 3.0
    """Largest reprojection error of an observation."""

    depth: float = 0.0
    """Depth in front of every camera that it must exceed, scene units."""


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


class Observations(NamedTuple):
    """Rays of tracks, sorted by track; every track from 0 to the last one has at least one."""

    camera: Int[np.ndarray, " n"]
    track: Int[np.ndarray, " n"]
    rays: Float[np.ndarray, "n 2"]


class Triangulated(NamedTuple):
    """Points and their errors."""

    points: Float[np.ndarray, "tracks 3"]
    angle: Float[np.ndarray, " tracks"]  # largest between the first or last ray and any other, degrees
    depth: Float[np.ndarray, " n"]  # of each observation
    error: Float[np.ndarray, " n"]  # distance of each ray from the point's, in units of the focal length

    def good(self, track: np.ndarray, filters: Filters, focal: float) -> Bool[np.ndarray, " tracks"]:
        """Tracks whose point passes all filters, in all observations."""
        bad = (self.depth <= filters.depth) | ~(self.error * focal <= filters.pixels)
        good = (self.angle >= filters.angle) & np.isfinite(self.points).all(axis=1)
        good[track[bad]] = False
        return good


def triangulate(views: Views, observations: Observations) -> Triangulated:
    """Points that minimise the squared reprojection errors: a linear solution, refined by Gauss-Newton.

    Source of the linear solution: Hartley and Zisserman, "Multiple View Geometry", section 12.2, with the world moved
    to the first camera of each track and scaled by its longest baseline.
    """
    camera, track, rays = observations
    count = int(track[-1]) + 1 if len(track) else 0
    starts = np.searchsorted(track, np.arange(count))
    centers = views.centers()
    origin = centers[camera[starts]]
    baseline = centers[camera] - origin[track]
    scale = np.maximum.reduceat(np.linalg.norm(baseline, axis=1), starts) if count else np.empty(0)
    scale = np.where(scale > 0, scale, 1.0)
    rotation = views.rotation[camera]
    shift = -np.einsum("nij,nj->ni", rotation, baseline / scale[track, None])
    rows = np.concatenate([rotation, shift[:, :, None]], axis=2)  # [n, 3, 4]
    lines = rays[:, :, None] * rows[:, 2:] - rows[:, :2]  # [n, 2, 4]
    normal = _sum(np.einsum("nki,nkj->nij", lines, lines), starts)
    homogeneous = np.linalg.eigh(normal)[1][:, :, 0] if count else np.empty((0, 4))
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        points = homogeneous[:, :3] / homogeneous[:, 3:]
    points = np.where(np.isfinite(points).all(axis=1, keepdims=True), points, 1e9)
    for _ in range(GAUSS_NEWTON_STEPS):
        points = _refine(points, rotation, shift, track, rays, starts)
    points = points * scale[:, None] + origin
    local = views.local(camera, points[track])
    with np.errstate(invalid="ignore", over="ignore"):
        error = np.linalg.norm(perspective(local) - rays, axis=1)
    return Triangulated(points, _angles(points, centers[camera], track, starts), local[:, 2], error)


def _refine(points, rotation, shift, track, rays, starts):
    """One Gauss-Newton step of every point, accepted where its own cost falls."""

    def residual(at):
        local = np.einsum("nij,nj->ni", rotation, at[track]) + shift
        difference = perspective(local) - rays
        cost = np.add.reduceat((difference**2).sum(axis=1), starts) if len(starts) else np.empty(0)
        return local, difference, cost

    local, difference, cost = residual(points)
    inverse = 1 / np.where(local[:, 2] == 0, np.inf, local[:, 2])
    plane = local[:, :2] * inverse[:, None]
    slope = inverse[:, None, None] * (rotation[:, :2] - plane[:, :, None] * rotation[:, 2:])  # [n, 2, 3]
    hessian = _sum(np.einsum("nki,nkj->nij", slope, slope), starts)
    gradient = _sum(np.einsum("nki,nk->ni", slope, np.nan_to_num(difference)), starts)
    hessian += 1e-12 * np.trace(hessian, axis1=1, axis2=2)[:, None, None] * np.eye(3) + 1e-300 * np.eye(3)
    new = points - np.linalg.solve(hessian, gradient[:, :, None])[:, :, 0]
    with np.errstate(invalid="ignore"):
        better = residual(new)[2] < cost
    return np.where(better[:, None], new, points)


def _angles(points, centers, track, starts):
    """Largest angle between the first or the last ray of a track and any other, degrees."""
    if not len(starts):
        return np.empty(0)
    directions = points[track] - centers
    with np.errstate(divide="ignore", invalid="ignore"):
        directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    ends = np.append(starts[1:], len(track)) - 1
    largest = np.zeros(len(starts))
    for reference in (starts, ends):
        chord = np.linalg.norm(directions - directions[reference][track], axis=1)
        angle = 2 * np.arcsin(np.minimum(chord / 2, 1))
        largest = np.maximum(largest, np.maximum.reduceat(np.nan_to_num(angle), starts))
    return np.rad2deg(largest)


def _sum(values: np.ndarray, starts: np.ndarray) -> np.ndarray:
    return np.add.reduceat(values, starts, axis=0) if len(starts) else np.empty((0, *values.shape[1:]))


def triangulate_robustly(
    views: Views, observations: Observations, filters: Filters, focal: float, min_views: int = 2
) -> tuple[Float[np.ndarray, "tracks 3"], Bool[np.ndarray, " n"]]:
    """Points of all tracks, and which observations are good; the point of a track without any is meaningless.

    A track that fails is triangulated once more without the observations whose errors are too large.

    Args:
        views: of all cameras.
        observations: of all tracks.
        filters: for points.
        focal: pixels.
        min_views: observations that a point needs.
    """
    first = triangulate(views, observations)
    good = first.good(observations.track, filters, focal)
    points, keep = first.points.copy(), good[observations.track]
    again = ~keep & (first.error * focal <= filters.pixels) & (first.depth > filters.depth)
    again &= np.bincount(observations.track[again], minlength=len(points))[observations.track] >= min_views
    if again.any():
        names, track = np.unique(observations.track[again], return_inverse=True)
        second = triangulate(views, Observations(observations.camera[again], track, observations.rays[again]))
        fine = second.good(track, filters, focal)
        points[names[fine]] = second.points[fine]
        keep[np.flatnonzero(again)[fine[track]]] = True
    keep &= np.bincount(observations.track[keep], minlength=len(points))[observations.track] >= min_views
    return points, keep
