"""Monocular visual odometry over key-frames: the initial poses of bundle adjustment.

The relative pose of two views with enough parallax comes from an essential matrix, and their tracks
are triangulated. The pose of every other view comes from the known points that it sees (PnP), and
new points are triangulated as soon as the angle between their rays is large enough. The first
baseline has length 1. Nothing is adjusted afterwards."""

from __future__ import annotations

from itertools import islice, pairwise
from typing import NamedTuple

import numpy as np

from jaxba.io.frames import Calibration
from jaxba.kitti.features import EPIPOLAR_PIXELS, essential
from jaxba.kitti.opencv import cv2
from jaxba.kitti.options import MIN_MATCHES, Build
from jaxba.kitti.tracks import Tracks, parallax, relative_rotation
from jaxba.kitti.triangulate import Observations, Views, triangulate
from jaxba.problem.bundle_problem import ProblemError

# median angle in degrees between the rays of the first two views that is enough
BOOTSTRAP_ANGLE = 2.0
# ... beyond which the essential matrix must be wrong: points nearer than three baselines
BOOTSTRAP_MOST = 20.0
BOOTSTRAP_ENOUGH = 5.0  # angle beyond which a pair of views is not rated higher
# share of the common tracks that must fit the motion: a wrong motion fits few of them
BOOTSTRAP_SHARE = 0.5
# ... and the least angle, where no pair has more; noise of a pixel is 0.1 degrees on KITTI
BOOTSTRAP_LEAST = 0.5
BOOTSTRAP_REACH = 12  # how many views after the first are tried as second ones
# inlier points that the pose of a view needs, and that the first two views must give
MIN_POINTS = 15
PNP_PIXELS = 3.0  # reprojection error of an outlier

PNP_ITERATIONS = 300

# largest depth in baselines of points that choose the motion. With OpenCV's 50, a slow drive has
# none
FARTHEST = 1e9
# known points that the length of a step needs: the median of three tolerates one outlier
MIN_KNOWN = 3
# median parallax below which a camera stands still: key-points are accurate to less than a pixel
STILL_PIXELS = 1.0
MOVED_PIXELS = 3.0  # ... and from which on it surely moves
SPEED_STEPS = 5  # steps whose median length per frame is used where two views share no known points


class _Motion(NamedTuple):
    """Relative pose of two views."""

    rotation: np.ndarray
    translation: np.ndarray  # of length 1
    angle: float  # median between the rays of a point, degrees
    good: int  # points in front of both
    shared: int  # tracks


class _Scene:
    """Poses and points that are known so far."""

    def __init__(
        self, tracks: Tracks, views: int, calibration: Calibration, options: Build
    ) -> None:
        self.tracks, self.focal, self.options = tracks, calibration.fx, options
        self.observations = Observations(
            tracks.image, tracks.track, calibration.rays(tracks.pixels)
        )
        self.views = Views(np.tile(np.eye(3), (views, 1, 1)), np.zeros((views, 3)))
        self.has_pose = np.zeros(views, bool)
        self.points = np.full((tracks.count, 3), np.nan)

    def place(self, view: int, rotation: np.ndarray, translation: np.ndarray) -> None:
        """Sets the pose of a view, and triangulates all tracks that it sees from all views with
        known poses."""
        self.views.rotation[view], self.views.translation[view], self.has_pose[view] = (
            rotation,
            translation,
            True,
        )
        tracks = self.tracks
        rows = tracks.rows_of_tracks(tracks.track[tracks.rows_of_image(view)])
        rows = rows[self.has_pose[tracks.image[rows]]]
        rows = rows[
            np.bincount(tracks.track[rows], minlength=tracks.count)[tracks.track[rows]] >= 2
        ]
        names, seen = self.observations.numbered(rows)
        found = triangulate(self.views, seen)
        good = found.good(seen.track, self.options.min_angle, self.options.max_error / self.focal)
        self.points[names[good]] = found.points[good]
        # two views alone may just be too close together
        known = ~good & (np.bincount(seen.track) > 2)
        self.points[names[known]] = np.nan

    def neighbour(self, view: int) -> int:
        """The nearest view whose pose is known."""
        placed = np.flatnonzero(self.has_pose)
        return int(placed[np.argmin(np.abs(placed - view))])

    def after(
        self, near: int, rotation: np.ndarray, translation: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """The pose that is reached from that of a view by a motion."""
        return rotation @ self.views.rotation[near], rotation @ self.views.translation[
            near
        ] + translation

    def shared(self, i: int, j: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Numbers of the tracks that two views share, and their rays in both."""
        a, b = self.tracks.shared(i, j)
        return self.tracks.track[a], self.observations.rays[a], self.observations.rays[b]

    def parallax(self, i: int, j: int) -> float:
        """Parallax of two views, pixels; NaN if they share too few tracks."""
        tracks, a, b = self.shared(i, j)
        return parallax(a, b, self.focal) if len(tracks) >= MIN_POINTS else np.nan

    def motion(self, i: int, j: int) -> _Motion | None:
        """Motion from view i to view j; None if they share too few tracks."""
        tracks, a, b = self.shared(i, j)
        matrix, inliers = essential(a, b, EPIPOLAR_PIXELS / self.focal)
        if matrix is None or inliers.sum() < MIN_POINTS:
            return None
        a = np.ascontiguousarray(a[inliers])
        b = np.ascontiguousarray(b[inliers])
        _, rotation, translation, front, _ = cv2.recoverPose(
            matrix, a, b, np.eye(3), distanceThresh=FARTHEST
        )
        front = np.asarray(front).ravel() > 0
        rotation = np.asarray(rotation)
        if front.sum() < MIN_POINTS:
            return None
        ahead, turned = (
            np.column_stack([rays, np.ones(len(rays))]) for rays in (a[front], b[front])
        )
        turned = turned @ rotation
        sine = np.linalg.norm(np.cross(ahead, turned), axis=1)
        angle = np.median(np.rad2deg(np.arctan2(sine, (ahead * turned).sum(axis=1))))
        return _Motion(
            rotation, np.asarray(translation).ravel(), float(angle), int(front.sum()), len(tracks)
        )


def visual_odometry(
    tracks: Tracks,
    views: int,
    calibration: Calibration,
    options: Build,
    names: tuple[int, ...],
) -> tuple[Views, tuple[int, ...]]:
    """Poses of all views from tracks alone.

    The poses of views before the first pair with parallax (a car that stands still, or only
    rotates) are found last. The images of the tracks are the views, 0 to `views` - 1; `names` are
    their frame numbers, for messages, and `options` has the limits for points. Returns the poses,
    the first view at the origin, and the views whose pose comes from the neighbouring view, for
    lack of known points. Raises ProblemError: no pair of views has parallax, or a view shares too
    few tracks with its neighbour."""
    scene = _Scene(tracks, views, calibration, options)
    first, second, motion = _bootstrap(scene, views, names)
    scene.place(first, np.eye(3), np.zeros(3))
    scene.place(second, motion.rotation, motion.translation)
    restarts = []
    forward = [*range(first + 1, second), *range(second + 1, views)]
    for view in [*forward, *range(first - 1, -1, -1)]:
        pose = _resect(scene, view)
        if pose is None:
            pose = _pose_from_neighbour(scene, view, names)
            restarts.append(view)
        scene.place(view, *pose)
    # the first view becomes the origin
    rotation = scene.views.rotation @ scene.views.rotation[0].T
    return Views(rotation, scene.views.translation - rotation @ scene.views.translation[0]), tuple(
        restarts
    )


def _bootstrap(scene: _Scene, views: int, names: tuple[int, ...]) -> tuple[int, int, _Motion]:
    """The first two views and their motion: the best pair of the first view that has a good one.

    A good pair has many inliers and enough parallax; the best one, by their product, of these or
    else of all."""
    found: list[tuple[bool, float, int, int]] = []
    motions: dict[tuple[int, int], _Motion] = {}
    largest = 0.0
    for i in range(views - 1):
        for j in range(i + 1, min(i + 1 + BOOTSTRAP_REACH, views)):
            motion = scene.motion(i, j)
            if motion is None or motion.angle > BOOTSTRAP_MOST:
                continue
            largest = max(largest, motion.angle)
            if motion.angle >= BOOTSTRAP_LEAST:
                strong = motion.good >= max(MIN_MATCHES, BOOTSTRAP_SHARE * motion.shared)
                found.append((strong, motion.good * min(motion.angle, BOOTSTRAP_ENOUGH), -i, -j))
                motions[i, j] = motion
        if any(strong and motions[-a, -b].angle >= BOOTSTRAP_ANGLE for strong, _, a, b in found):
            break
    if not found:
        raise ProblemError(
            f"no two of the key-frames {names[0]} to {names[views - 1]} have enough parallax to "
            "start from "
            f"(at most {largest:.2f} degrees, {BOOTSTRAP_LEAST} are needed): the camera stands "
            "still or only turns"
        )
    _, _, i, j = max(found)
    return -i, -j, motions[-i, -j]


def _resect(scene: _Scene, view: int) -> tuple[np.ndarray, np.ndarray] | None:
    """Pose of a view by the points that it sees: P3P within RANSAC, then Levenberg-Marquardt on the
    inliers."""
    rows = scene.tracks.rows_of_image(view)
    rows = rows[np.isfinite(scene.points[scene.tracks.track[rows], 0])]
    if len(rows) < MIN_POINTS:
        return None
    near = scene.neighbour(view)
    # in the frame of the neighbour, where coordinates are small and rounding errors too
    points = scene.views.local(np.full(len(rows), near), scene.points[scene.tracks.track[rows]])
    rays = np.ascontiguousarray(scene.observations.rays[rows])
    pinhole = (np.eye(3), np.zeros(4))
    ok, turn, shift, inliers = cv2.solvePnPRansac(
        points,
        rays,
        *pinhole,
        iterationsCount=PNP_ITERATIONS,
        reprojectionError=PNP_PIXELS / scene.focal,
        confidence=0.9999,
        flags=cv2.SOLVEPNP_AP3P,
    )
    if not ok or inliers is None or len(inliers) < MIN_POINTS:
        return None
    chosen: np.ndarray = np.asarray(inliers).ravel()
    turn, shift = cv2.solvePnPRefineLM(points[chosen], rays[chosen], *pinhole, turn, shift)
    return scene.after(near, np.asarray(cv2.Rodrigues(turn)[0]), np.asarray(shift).ravel())


def _pose_from_neighbour(
    scene: _Scene, view: int, names: tuple[int, ...]
) -> tuple[np.ndarray, np.ndarray]:
    """Pose of a view from its neighbour alone. The length of the step comes from the known points
    that both see, or if they are too few, from the steps nearby in which the camera moved."""
    near = scene.neighbour(view)
    tracks, a, b = scene.shared(near, view)
    if scene.parallax(near, view) < STILL_PIXELS:
        return scene.after(near, relative_rotation(a, b), np.zeros(3))
    found = scene.motion(near, view)
    if found is None:
        raise ProblemError(
            f"too few matches: key-frames {names[near]} and {names[view]} share {len(tracks)} "
            "tracks that fit one "
            f"motion badly, {MIN_POINTS} good ones are needed; choose other --frames"
        )
    known = np.flatnonzero(np.isfinite(scene.points[tracks, 0]))
    views = Views(np.stack([np.eye(3), found.rotation]), np.stack([np.zeros(3), found.translation]))
    rays = np.stack([a, b], axis=1)[known].reshape(-1, 2)
    count = np.arange(len(known))
    seen = Observations(np.tile([0, 1], len(known)), np.repeat(count, 2), rays)
    two = triangulate(views, seen)
    good = two.good(seen.track, 0.0, scene.options.max_error / scene.focal)
    depth = scene.views.local(np.full(len(known), near), scene.points[tracks[known]])[:, 2]
    step = float(np.median(depth[good] / two.points[good, 2])) if good.sum() >= MIN_KNOWN else 0.0
    if step <= 0:
        step = _speed(scene, near, names) * abs(names[view] - names[near])
    return scene.after(near, found.rotation, step * found.translation)


def _speed(scene: _Scene, near: int, names: tuple[int, ...]) -> float:
    """Median length per frame of the nearest steps in which the camera moved; the first two views
    are 1 apart."""
    placed = np.flatnonzero(scene.has_pose).tolist()
    centers = scene.views.centers()
    steps = sorted(pairwise(placed), key=lambda step: abs(step[0] + step[1] - 2 * near))
    moved = [
        *islice(((i, j) for i, j in steps if scene.parallax(i, j) >= MOVED_PIXELS), SPEED_STEPS)
    ]
    speeds = [np.linalg.norm(centers[j] - centers[i]) / abs(names[j] - names[i]) for i, j in moved]
    return float(np.median(speeds)) if moved else 1 / abs(names[placed[-1]] - names[placed[0]])
