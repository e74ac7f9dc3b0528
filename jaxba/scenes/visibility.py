"""Places points where enough cameras see them, and chooses the cameras of every track."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxba.problem.bundle_problem import ProblemError
from jaxba.problem.geometry import radial_distortion, rotation_matrices
from jaxba.scenes.config import VIEW_MARGIN, SceneConfig
from jaxba.scenes.tracks import MIN_LENGTH
from jaxba.scenes.trajectory import Path

BUDGET = 1 << 20  # candidate views handled at once: some 100 MB of temporaries
# to place a point where enough cameras see it, each nearer to the focus of the view than the last
ATTEMPTS = 24
# candidates per wanted view: 2, as half do not exist at an end of the path, and more for missed
# views
WINDOW = 2.5
NEAREST, FARTHEST = 0.5, 2.0  # parts of min_depth and max_depth between which a view counts
# every camera should see so many points: 8 residuals for its 6 degrees of freedom and focal length
MIN_VIEWS = 4


Views = tuple[
    Float[np.ndarray, "points 3"],
    Int[np.ndarray, " observations"],
    Int[np.ndarray, " observations"],
]
"""Points (scene units), and of each observation the camera, by its position along the path, and the
point."""


class TrueCameras:
    """The true cameras, laid out for fast tests of visibility."""

    def __init__(self, config: SceneConfig, path: Path, cameras: Float[np.ndarray, "cameras 9"]):
        self.config = config
        self.path = path
        self.count = len(cameras)
        self.rotations = rotation_matrices(cameras[:, :3])
        self.translations = cameras[:, 3:6]
        self.rows = np.ascontiguousarray(
            np.concatenate([self.rotations, self.translations[:, :, None]], axis=2).T
        )
        self.focal, self.k1, self.k2 = np.ascontiguousarray(cameras[:, 6:].T)
        self.half = np.array([config.image_width, config.image_height]) / 2

    def sample(
        self, reference: np.ndarray, effort: float, rng: np.random.Generator
    ) -> Float[np.ndarray, "n 3"]:
        """Random points in view of the reference cameras (n,); an effort near 1 keeps to the middle
        of the view."""
        near, far, focus = (
            np.log(depth[reference]) for depth in (self.path.near, self.path.far, self.path.focus)
        )
        depth = np.exp((1 - effort) * rng.uniform(near, far) + effort * focus)
        local = np.empty((len(reference), 3))
        plane = rng.uniform(-1, 1, (len(reference), 2)) * self.half / self.focal[reference, None]
        local[:, :2] = (1 - effort) * depth[:, None] * plane
        local[:, 2] = -depth
        return np.einsum(
            "nji,nj->ni", self.rotations[reference], local - self.translations[reference]
        )

    def sees(
        self, points: Float[np.ndarray, "n 3"], cameras: Int[np.ndarray, "n k"]
    ) -> Bool[np.ndarray, "n k"]:
        """Whether the point of each row is in front of, and in the image of, each candidate camera
        of the row."""
        x, y, z = (points[:, axis, None] for axis in range(3))
        across, upwards, behind = (
            a[cameras] * x + b[cameras] * y + c[cameras] * z + d[cameras]
            for a, b, c, d in self.rows.transpose(1, 0, 2)
        )
        depth = -behind
        unit = self.config.step * np.array(
            [NEAREST * self.config.min_depth, FARTHEST * self.config.max_depth]
        )
        good = (depth >= unit[0]) & (depth <= unit[1])
        inverse = 1 / np.where(good, depth, 1.0)
        px = across * inverse
        py = upwards * inverse
        square = px * px + py * py
        focal = self.focal[cameras]
        scale = focal * radial_distortion(square, self.k1[cameras], self.k2[cameras])
        for p, half in ((px, self.half[0]), (py, self.half[1])):
            good &= (np.abs(p) * focal <= VIEW_MARGIN * half) & (np.abs(p) * scale <= half)
        return good


def place_points(
    scene: TrueCameras, lengths: Int[np.ndarray, " points"], rng: np.random.Generator
) -> Views:
    """Places points so that the total number of views is exactly the wanted one.

    `lengths` are the wanted views of each point, longest first. A point that fewer cameras can see
    gets as many views as there are; the rest go to points that more cameras can see. Raises
    ProblemError: the cameras overlap too little."""
    count = len(lengths)
    reference = rng.permutation(np.arange(count, dtype=np.int32) % scene.count)
    points = np.empty((count, 3))
    cameras = []
    owners = []
    missing = 0
    start = 0
    while start < count:
        part = _next_part(lengths, start, _width(scene, int(lengths[start])))
        points[part], candidates, visible = _place(scene, lengths[part], reference[part], rng)
        taken, missing = _balance(lengths[part], visible.sum(axis=1), missing, rng)
        chosen = _choose(visible, taken, scene.config.gap_share, rng)
        cameras.append(candidates[chosen])
        owners.append(np.repeat(np.arange(part.start, part.stop, dtype=np.int32), taken))
        start = part.stop
    if missing:
        raise ProblemError(
            f"{missing} of {lengths.sum()} observations found no place: the cameras overlap too "
            "little "
            "(ask for fewer observations, deepen max_depth or shorten focal)"
        )
    return _rebalance(scene, points, np.concatenate(cameras), np.concatenate(owners), rng)


def _width(scene: TrueCameras, longest: int) -> int:
    """Candidate cameras for tracks of up to `longest` views; an odd number."""
    wanted = WINDOW * longest / max(1 - scene.config.gap_share, 1 / WINDOW) + 4
    return int(min(2 * (wanted // 2) + 1, 2 * scene.count - 1))


def _next_part(lengths: np.ndarray, start: int, width: int) -> slice:
    """Points from `start` on that are placed at once: within the memory budget and of similar track
    length."""
    stop = min(start + max(BUDGET // width, 1), len(lengths))
    similar = np.searchsorted(-lengths[start:stop], -(lengths[start] // 2), side="right")
    return slice(start, start + int(similar))


def _place(
    scene: TrueCameras, lengths: np.ndarray, reference: np.ndarray, rng: np.random.Generator
) -> tuple:
    """Points (n, 3), candidate cameras (n, k) and which of them see the point (n, k).

    The best attempt of each point is kept. The second half of the attempts takes other reference
    cameras, since one in a bend of the path may never share a point with enough others."""
    count = len(lengths)
    width = _width(scene, int(lengths[0]))
    points = np.empty((count, 3))
    seen = np.zeros(count, dtype=int)
    candidates = np.zeros((count, width), dtype=np.int32)
    visible = np.zeros((count, width), dtype=bool)
    todo = np.arange(count)
    for attempt in range(ATTEMPTS):
        first = (
            reference[todo]
            if attempt < ATTEMPTS // 2
            else rng.integers(scene.count, size=todo.size)
        )
        trial = scene.sample(first, attempt / ATTEMPTS, rng)
        cameras, inside = _window(scene, first, width, rng)
        views = scene.sees(trial, cameras) & inside
        number = views.sum(axis=1)
        better = np.flatnonzero(number > seen[todo])
        rows = todo[better]
        points[rows], candidates[rows], visible[rows] = (
            trial[better],
            cameras[better],
            views[better],
        )
        seen[rows] = number[better]
        todo = todo[seen[todo] < lengths[todo]]
        if not todo.size:
            break
    if seen.min() < MIN_LENGTH:
        raise ProblemError(
            "a camera shares no point with any other: deepen max_depth or shorten focal"
        )
    return points, candidates, visible


def _window(
    scene: TrueCameras, reference: np.ndarray, width: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Cameras around the reference, nearest first (n, width), and which of them exist.

    For a share of the rows every other column is around the same position on another round of the
    path."""
    column = np.arange(width)
    offset = (column + 1) // 2 * np.where(column % 2, 1, -1)
    cameras = reference[:, None] + offset.astype(np.int32)
    lap = scene.path.lap
    share = scene.config.revisit_share
    if share > 0 and width < lap < scene.count:
        rows = np.flatnonzero(rng.random(len(reference)) < share)
        near = reference[rows]
        other = np.where(near + lap < scene.count, near + lap, near - lap)
        other = np.where(other < 0, near, other)
        pair = np.where(column % 2, other[:, None], near[:, None]) + offset[column // 2]
        cameras[rows] = np.where((other != near)[:, None], pair, cameras[rows])
    inside = (cameras >= 0) & (cameras < scene.count)
    return np.where(inside, cameras, 0).astype(np.int32), inside


def _balance(
    wanted: np.ndarray, possible: np.ndarray, missing: int, rng: np.random.Generator
) -> tuple:
    """Numbers of views of each point, at most the possible ones, and how many are still missing
    from the total."""
    taken = np.minimum(wanted, possible)
    missing += int(wanted.sum() - taken.sum())
    while missing:
        open_rows = np.flatnonzero(possible > taken)
        if not open_rows.size:
            break
        taken[rng.permutation(open_rows)[:missing]] += 1
        missing -= min(missing, open_rows.size)
    return taken, missing


def _choose(
    visible: np.ndarray, taken: np.ndarray, gap_share: float, rng: np.random.Generator
) -> np.ndarray:
    """Mask (n, k) of `taken` visible candidates of each row, nearest first, with gaps where enough
    are visible."""
    skipped = rng.random(visible.shape, dtype=np.float32) < gap_share
    skipped[:, 0] = False  # the reference camera
    first = visible & ~skipped
    first &= np.cumsum(first, axis=1, dtype=np.int32) <= taken[:, None]
    rest = visible & skipped
    rest &= np.cumsum(rest, axis=1, dtype=np.int32) <= (taken - first.sum(axis=1))[:, None]
    return first | rest


def _rebalance(
    scene: TrueCameras,
    points: np.ndarray,
    owner: np.ndarray,
    point_index: np.ndarray,
    rng: np.random.Generator,
) -> Views:
    """Moves views from cameras that see most points to those that see fewer than four, where these
    see the point."""
    load = np.bincount(owner, minlength=scene.count)
    for poor in np.flatnonzero(load < MIN_VIEWS):
        could = scene.sees(points, np.full((len(points), 1), poor))[:, 0]
        could[point_index[owner == poor]] = False
        for point in rng.permutation(np.flatnonzero(could)):
            if load[poor] >= MIN_VIEWS:
                break
            track = np.flatnonzero(point_index == point)
            fullest = track[np.argmax(load[owner[track]])]
            if load[owner[fullest]] > MIN_VIEWS:
                load[owner[fullest]] -= 1
                load[poor] += 1
                owner[fullest] = poor
    return points, owner, point_index
