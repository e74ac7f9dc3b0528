"""Monocular visual odometry over key-frames: the initial poses of bundle adjustment.

The relative pose of two views with enough parallax comes from an essential matrix, and their tracks are triangulated.
The pose of every other view comes from the known points that it sees (PnP), and new points are triangulated as soon as
the angle between their rays is large enough. The first baseline has length 1. Nothing is adjusted afterwards, so errors
accumulate.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from jaxba.io.frames import Calibration
from jaxba.kitti.features import essential
from jaxba.kitti.keyframes import parallax, relative_rotation
from jaxba.kitti.opencv import cv2
from jaxba.kitti.options import MIN_MATCHES
from jaxba.kitti.tracks import Tracks
from jaxba.kitti.triangulate import Filters, Observations, Triangulated, Views, triangulate
from jaxba.problem.bundle_problem import ProblemError
from jaxba.problem.geometry import perspective, translations

BOOTSTRAP_ANGLE = 2.0
"""Median angle in degrees between the rays of the points of the first two views that is enough."""

BOOTSTRAP_MOST = 20.0
"""... and beyond which the essential matrix must be wrong: the points would be nearer than three baselines."""

BOOTSTRAP_ENOUGH = 5.0
"""Angle beyond which a pair of views is not rated higher."""

BOOTSTRAP_SHARE = 0.5
"""Share of the common tracks that must fit the motion: a wrong motion fits few of them."""

BOOTSTRAP_LEAST = 0.5
"""... and the least angle, where no pair has more. Noise of a pixel is 0.1 degrees at KITTI's focal length."""

BOOTSTRAP_REACH = 12
"""How many views after the first are tried as second ones."""

MIN_POINTS = 15
"""Inlier points that the pose of a view needs, and that the first two views must give."""

PNP_PIXELS = 3.0
"""Reprojection error of an outlier."""

PNP_ITERATIONS = 300

EPIPOLAR_PIXELS = 1.0

SOFT_LOSS_SCALE = 0.5
"""Scale of the robust loss of the refined motion, relative to `EPIPOLAR_PIXELS`."""

FARTHEST = 1e9
"""Depth in baselines up to which points are used to choose the motion that has them in front. With OpenCV's 50, a slow
drive has none."""

MIN_KNOWN = 3
"""Known points that the length of a step needs: the median of three tolerates one outlier."""

STILL_PIXELS = 1.0
"""Median parallax below which a camera stands still: key-points are accurate to less than a pixel."""

MOVED_PIXELS = 3.0
"""... and from which on it surely moves."""

SPEED_STEPS = 5
"""Steps whose median length per frame is used where two views share no known points."""


class Odometry(NamedTuple):
    """Poses of all views, and how they were found."""

    views: Views  # world to camera, the first view at the origin
    bootstrap: tuple[int, int]
    restarts: tuple[int, ...]  # views whose pose comes from the neighbouring view, for lack of known points


class _Map:
    """Poses and points that are known so far."""

    def __init__(self, tracks: Tracks, views: int, calibration: Calibration, filters: Filters, seed: int) -> None:
        self.tracks, self.calibration, self.filters, self.seed = tracks, calibration, filters, seed
        self.rays = calibration.rays(tracks.pixels)
        self.rotation = np.tile(np.eye(3), (views, 1, 1))
        self.translation = np.zeros((views, 3))
        self.has_pose = np.zeros(views, bool)
        self.points = np.full((tracks.count, 3), np.nan)

    def set_pose(self, view: int, rotation: np.ndarray, translation: np.ndarray) -> None:
        self.rotation[view], self.translation[view], self.has_pose[view] = rotation, translation, True

    def triangulate(self, views: list[int]) -> None:
        """Triangulates again all tracks that these views see, from all views whose pose is known."""
        seen = np.unique(np.concatenate([self.tracks.track[self.tracks.rows_of_image(view)] for view in views]))
        rows = self.tracks.rows_of_tracks(seen)
        rows = rows[self.has_pose[self.tracks.image[rows]]]
        names, track = np.unique(self.tracks.track[rows], return_inverse=True)
        rows = rows[np.bincount(track)[track] >= 2]
        names, track = np.unique(self.tracks.track[rows], return_inverse=True)
        if not len(names):
            return
        observations = Observations(self.tracks.image[rows], track, self.rays[rows])
        found = triangulate(Views(self.rotation, self.translation), observations)
        good = found.good(track, self.filters, self.calibration.fx)
        self.points[names[good]] = found.points[good]
        known = ~good & (np.bincount(track) > 2)  # two views alone may just be too close together
        self.points[names[known]] = np.nan


def visual_odometry(
    tracks: Tracks,
    views: int,
    calibration: Calibration,
    filters: Filters,
    seed: int,
    names: tuple[int, ...],
    report: Callable[[int], None] = lambda done: None,
) -> Odometry:
    """Poses of all views from tracks alone.

    The poses of views before the first pair with parallax (a car that stands still, or only rotates) are found last.

    Args:
        tracks: their images are the views, 0 to `views` - 1.
        views: how many.
        calibration: of all views.
        filters: for points.
        seed: of random samples.
        names: frame numbers of the views, for messages.
        report: called with the number of views whose pose is known.

    Raises:
        ProblemError: no pair of views has parallax, or a view shares too few tracks with its neighbour.
    """
    scene = _Map(tracks, views, calibration, filters, seed)
    first, second = _bootstrap(scene, views, names)
    scene.triangulate([first, second])
    restarts = []
    forward = [*range(first + 1, second), *range(second + 1, views)]
    for done, view in enumerate([*forward, *range(first - 1, -1, -1)]):
        report(done + 2)
        pose = _resect(scene, view)
        if pose is None:
            pose = _pose_from_neighbour(scene, view, names)
            restarts.append(view)
        scene.set_pose(view, *pose)
        scene.triangulate([view])
    # the first view becomes the origin
    rotation = scene.rotation @ scene.rotation[0].T
    translation = scene.translation - rotation @ scene.translation[0]
    return Odometry(Views(rotation, translation), (first, second), tuple(restarts))


def _bootstrap(scene: _Map, views: int, names: tuple[int, ...]) -> tuple[int, int]:
    """Sets the poses of the first two views: the best pair of the first view that has a good one.

    A good pair has many inlier points and enough parallax; the best one has the largest product of both. If there is no
    good pair, the best of all pairs is used.
    """
    best: tuple[bool, float, int, int, _Motion] | None = None
    largest, enough = 0.0, False
    for i in range(views - 1):
        for j in range(i + 1, min(i + 1 + BOOTSTRAP_REACH, views)):
            motion = _relative(scene, i, j)
            if motion is None or motion.angle > BOOTSTRAP_MOST:
                continue
            largest = max(largest, motion.angle)
            if motion.angle < BOOTSTRAP_LEAST:
                continue
            strong = motion.good >= max(MIN_MATCHES, BOOTSTRAP_SHARE * motion.shared)
            value = motion.good * min(motion.angle, BOOTSTRAP_ENOUGH)
            enough |= strong and motion.angle >= BOOTSTRAP_ANGLE
            if best is None or (strong, value) > best[:2]:
                best = (strong, value, i, j, motion)
        if enough:
            break
    if best is None:
        raise ProblemError(
            f"no two of the key-frames {names[0]} to {names[views - 1]} have enough parallax to start from "
            f"(at most {largest:.2f} degrees, {BOOTSTRAP_LEAST} are needed): the camera stands still or only turns"
        )
    _, _, i, j, motion = best
    scene.set_pose(i, np.eye(3), np.zeros(3))
    scene.set_pose(j, motion.rotation, motion.translation)
    return i, j


class _Motion(NamedTuple):
    """Relative pose of two views."""

    rotation: np.ndarray
    translation: np.ndarray  # of length 1
    angle: float  # median of the good points, degrees
    good: int  # points
    shared: int  # tracks


def _relative(scene: _Map, i: int, j: int) -> _Motion | None:
    """Motion from view i to view j; None if they share too few tracks."""
    a, b = scene.tracks.shared(i, j)
    if len(a) < MIN_POINTS:
        return None
    threshold = EPIPOLAR_PIXELS / scene.calibration.fx
    matrix, inliers = essential(scene.rays[a], scene.rays[b], threshold, scene.seed)
    if matrix is None or inliers.sum() < MIN_POINTS:
        return None
    shared = len(a)
    a, b = scene.rays[a[inliers]], scene.rays[b[inliers]]
    first, second = np.ascontiguousarray(a), np.ascontiguousarray(b)
    _, rotation, translation, *_ = cv2.recoverPose(matrix, first, second, np.eye(3), distanceThresh=FARTHEST)
    rotation, translation = _refine(np.asarray(rotation), np.asarray(translation).ravel(), a, b, threshold)
    views = Views(np.stack([np.eye(3), rotation]), np.stack([np.zeros(3), translation]))
    found, good = _two_views(scene, views, a, b)
    if good.sum() < MIN_POINTS:
        return None
    return _Motion(rotation, translation, float(np.median(found.angle[good])), int(good.sum()), shared)


def _refine(
    rotation: np.ndarray, translation: np.ndarray, first: np.ndarray, second: np.ndarray, threshold: float
) -> tuple[np.ndarray, np.ndarray]:
    """The motion that fits all inliers, from one that fits five: three angles of the rotation, two of the direction.

    Source of the distances: Sampson 1982; Hartley and Zisserman 2004, section 11.4.3.
    """
    a, b = (np.column_stack([rays, np.ones(len(rays))]) for rays in (first, second))
    tangent = np.linalg.svd(translation[None])[2][1:]

    def motion(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        direction = translation + x[3:] @ tangent
        return Rotation.from_rotvec(x[:3]).as_matrix() @ rotation, direction / np.linalg.norm(direction)

    def distances(x: np.ndarray) -> np.ndarray:
        turned, direction = motion(x)
        matrix = np.cross(direction, turned, axisb=0, axisc=0)
        lines, back = a @ matrix.T, b @ matrix
        norm = np.sqrt((lines[:, :2] ** 2).sum(1) + (back[:, :2] ** 2).sum(1))
        return (lines * b).sum(1) / norm / threshold

    return motion(least_squares(distances, np.zeros(5), loss="soft_l1", f_scale=SOFT_LOSS_SCALE).x)


def _two_views(scene: _Map, views: Views, first: np.ndarray, second: np.ndarray) -> tuple[Triangulated, np.ndarray]:
    """Points of matched rays of two views, and which pass the filters, at any angle."""
    track = np.repeat(np.arange(len(first)), 2)
    rays = np.stack([first, second], axis=1).reshape(-1, 2)
    found = triangulate(views, Observations(np.tile([0, 1], len(first)), track, rays))
    return found, found.good(track, Filters(angle=0.0, pixels=scene.filters.pixels), scene.calibration.fx)


def _neighbour(scene: _Map, view: int) -> int:
    placed = np.flatnonzero(scene.has_pose)
    return int(placed[np.argmin(np.abs(placed - view))])


def _resect(scene: _Map, view: int) -> tuple[np.ndarray, np.ndarray] | None:
    """Pose of a view by the points that it sees: P3P within RANSAC, then Levenberg-Marquardt on the inliers."""
    rows = scene.tracks.rows_of_image(view)
    rows = rows[np.isfinite(scene.points[scene.tracks.track[rows], 0])]
    if len(rows) < MIN_POINTS:
        return None
    near = _neighbour(scene, view)
    # in the frame of the neighbour, where coordinates are small and rounding errors too
    points = scene.points[scene.tracks.track[rows]] @ scene.rotation[near].T + scene.translation[near]
    rays = np.ascontiguousarray(scene.rays[rows])
    cv2.setRNGSeed(scene.seed)
    ok, turn, shift, inliers = cv2.solvePnPRansac(
        points,
        rays,
        np.eye(3),
        np.zeros(4),
        iterationsCount=PNP_ITERATIONS,
        reprojectionError=PNP_PIXELS / scene.calibration.fx,
        confidence=0.9999,
        flags=cv2.SOLVEPNP_AP3P,
    )
    if not ok or inliers is None or len(inliers) < MIN_POINTS:
        return None
    chosen: np.ndarray = np.asarray(inliers).ravel()
    for _ in range(2):  # refine, find the inliers again, refine
        turn, shift = cv2.solvePnPRefineLM(points[chosen], rays[chosen], np.eye(3), np.zeros(4), turn, shift)
        rotation = np.asarray(cv2.Rodrigues(turn)[0])
        local = points @ rotation.T + np.asarray(shift).ravel()
        with np.errstate(invalid="ignore"):
            error = np.linalg.norm(perspective(local) - rays, axis=1)
        chosen = np.flatnonzero((error * scene.calibration.fx <= PNP_PIXELS) & (local[:, 2] > 0))
        if len(chosen) < MIN_POINTS:
            return None
    translation = rotation @ scene.translation[near] + np.asarray(shift).ravel()
    return rotation @ scene.rotation[near], translation


def _pose_from_neighbour(scene: _Map, view: int, names: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Pose of a view from its neighbour alone, with the length of the step from the known points that both see."""
    near = _neighbour(scene, view)
    a, b = scene.tracks.shared(near, view)
    if len(a) >= MIN_POINTS and parallax(scene.rays[a], scene.rays[b], scene.calibration.fx) < STILL_PIXELS:
        rotation, translation, step = relative_rotation(scene.rays[a], scene.rays[b]), np.zeros(3), 0.0
    else:
        found = _relative(scene, near, view)
        if found is None:
            raise ProblemError(
                f"too few matches: key-frames {names[near]} and {names[view]} share {len(a)} tracks that fit one "
                f"motion badly, {MIN_POINTS} good ones are needed; choose other --frames or --features"
            )
        rotation, translation = found.rotation, found.translation
        step = _step_length(scene, near, view, rotation, translation)
        if step is None:
            step = _speed(scene, near, names) * abs(names[view] - names[near])
    return rotation @ scene.rotation[near], rotation @ scene.translation[near] + step * translation


def _step_length(scene: _Map, near: int, view: int, rotation: np.ndarray, translation: np.ndarray) -> float | None:
    """Length of a step of known direction, from the known points that both views see; None if they are too few."""
    a, b = scene.tracks.shared(near, view)
    known = scene.points[scene.tracks.track[a]]
    use = np.isfinite(known[:, 0])
    if use.sum() < MIN_KNOWN:
        return None
    views = Views(np.stack([np.eye(3), rotation]), np.stack([np.zeros(3), translation]))
    found, good = _two_views(scene, views, scene.rays[a[use]], scene.rays[b[use]])
    if good.sum() < MIN_KNOWN:
        return None
    depth = (known[use][good] @ scene.rotation[near].T + scene.translation[near])[:, 2]
    length = float(np.median(depth / found.points[good, 2]))
    return length if length > 0 else None


def _speed(scene: _Map, near: int, names: tuple[int, ...]) -> float:
    """Median length per frame of the nearest steps in which the camera moved."""
    placed = np.flatnonzero(scene.has_pose)
    centers = Views(scene.rotation, scene.translation).centers()
    steps = sorted(pairwise(placed.tolist()), key=lambda step: abs(step[0] + step[1] - 2 * near))
    speeds: list[float] = []
    for i, j in steps:
        a, b = scene.tracks.shared(i, j)
        if len(a) >= MIN_POINTS and parallax(scene.rays[a], scene.rays[b], scene.calibration.fx) >= MOVED_PIXELS:
            speeds.append(float(np.linalg.norm(centers[j] - centers[i])) / abs(names[j] - names[i]))
        if len(speeds) == SPEED_STEPS:
            break
    if not speeds:  # only the first two views, whose distance is 1
        return 1.0 / abs(names[placed[-1]] - names[placed[0]])
    return float(np.median(speeds))


def views_of_poses(poses: Float[np.ndarray, "views 3 4"]) -> Views:
    """World-to-camera views of camera-to-world poses."""
    rotation = poses[:, :, :3].transpose(0, 2, 1)
    return Views(rotation, translations(rotation, poses[:, :, 3]))
