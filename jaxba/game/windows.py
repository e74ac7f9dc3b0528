"""Scenes of the game that are cut from real problems: neighbouring cameras with some of the points
that they share.

Visibility, noise, wrong matches and starts are those of the problem. Many real problems begin near
their end, so half of the windows begin where random scenes do: cameras and points are moved by the
same random amounts. Every camera has a lens of its own, also where the problem shares lenses or
keeps them constant."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import reverse_cuthill_mckee

from jaxba.game.random_scenes import (
    MIN_VIEWS,
    START_CENTER,
    START_DEPTH,
    START_ROTATION,
    SceneClass,
    Scenes,
)
from jaxba.io import read_problem
from jaxba.io.files import StrPath
from jaxba.problem import geometry
from jaxba.problem.bundle_problem import BundleProblem, ProblemError

# share of a problem's cameras, the last ones in the order of their places, whose windows are held
# out
HELD_OUT = 0.2
FEWEST_CAMERAS = 4  # cameras of the smallest window
MOVED = 0.5  # share of the windows that begin where random scenes do


def read_windows(
    problems: Sequence[StrPath | BundleProblem], kind: SceneClass, count: int, seed: int
) -> tuple[Scenes, Scenes]:
    """Windows of problems: those to train on, and held-out ones from other places. Problems are in
    memory, or files. Of `count` windows, as many of each problem, a fifth is held out; `kind` has
    their largest numbers of cameras and points, and `seed` is that of the choice. Raises
    ProblemError: as `read_all`."""
    parts: tuple[list, list] = [], []
    for number, problem in enumerate(read_all(problems)):
        rng = np.random.default_rng([seed, number])
        share = -(-count // len(problems))
        linked = covisible(problem)
        held = round(HELD_OUT * share)
        for part, cameras, wanted in zip(parts, places(linked), (share - held, held), strict=True):
            if len(cameras) >= FEWEST_CAMERAS:
                part.extend(window(problem, kind, linked, cameras, rng) for _ in range(wanted))
    # so that the first windows are of all problems
    shuffle = np.random.default_rng([seed, len(problems)]).permutation
    train, held_out = ([part[k] for k in shuffle(len(part))] for part in parts)

    def column(part, name):
        return jnp.asarray(np.stack([getattr(one, name) for one in part]))

    def stack(part):
        return Scenes(*(column(part, name) for name in Scenes._fields))

    return stack(train), stack(held_out)


def read_all(given: Sequence[StrPath | BundleProblem]) -> list[BundleProblem]:
    """The problems, in memory or files. Raises ProblemError: a problem cannot be read, has whitened
    observations, other lenses than BAL's or too few cameras; or none is large enough for windows in
    two places. One line."""
    problems = []
    for number, path in enumerate(given):
        if isinstance(path, BundleProblem):
            problem = path
            path = f"problem {number}"
        else:
            problem = read_problem(path)
        if problem.whitening is not None:
            raise ProblemError(f"{path}: windows of observations with covariances are not made")
        if problem.lenses is not None and not problem.lenses.all_bal:
            raise ProblemError(f"{path}: windows are made of cameras whose lenses are BAL's")
        if problem.num_cameras < FEWEST_CAMERAS:
            raise ProblemError(
                f"{path}: {problem.num_cameras} cameras; a window has {FEWEST_CAMERAS} at least"
            )
        problems.append(problem)
    least = round(FEWEST_CAMERAS / HELD_OUT)
    if max(problem.num_cameras for problem in problems) < least:
        raise ProblemError(
            f"no problem has {least} cameras, so that windows in another place can be held out"
        )
    return problems


def places(
    linked: Int[np.ndarray, "cameras cameras"],
) -> tuple[Int[np.ndarray, " train"], Int[np.ndarray, " held_out"]]:
    """The cameras of training and of held-out windows. In the order of a band matrix neighbours
    stand together, so that the last of them are another place. `linked` is as `covisible` returns
    it."""
    order = reverse_cuthill_mckee(coo_array(linked).tocsr(), symmetric_mode=True).astype(np.int64)
    first = len(order) - round(HELD_OUT * len(order))
    return order[:first], order[first:]


def covisible(problem: BundleProblem) -> Int[np.ndarray, "cameras cameras"]:
    """Points that two cameras have in common."""
    shape = problem.num_cameras, problem.num_points
    cells = np.unique(np.stack([problem.camera_index, problem.point_index]), axis=1)
    seen = coo_array((np.ones(cells.shape[1], np.int32), (cells[0], cells[1])), shape=shape).tocsr()
    return (seen @ seen.T).toarray()


def window(
    problem: BundleProblem,
    kind: SceneClass,
    linked: Int[np.ndarray, "cameras cameras"],
    allowed: Int[np.ndarray, " allowed"],
    rng: np.random.Generator,
) -> Scenes:
    """One window, its arrays without the axis of scenes.

    Cameras join one by one, each time the one that shares most points with those already there; of
    the points that two of them observe, as many as fit are drawn. `kind` has the largest numbers of
    cameras and points, `linked` is as `covisible` returns it, and `allowed` are cameras to choose
    from."""
    most = min(kind.cameras, len(allowed))
    size = int(rng.integers(min(FEWEST_CAMERAS, most), most + 1))
    chosen = [int(rng.choice(allowed))]
    while len(chosen) < size:
        rest = np.setdiff1d(allowed, chosen)
        chosen.append(int(rest[np.argmax(linked[rest][:, chosen].sum(axis=1))]))
    grid, pixels = _grid(problem, np.array(chosen))
    shared = np.flatnonzero(grid.sum(axis=0) >= 2)
    points = rng.permutation(shared)[: kind.points]
    grid = grid[:, points]
    grid &= (grid.sum(axis=1) >= MIN_VIEWS)[:, None]
    grid &= (grid.sum(axis=0) >= 2)[None]
    cameras = np.array(problem.cameras)[chosen]
    start = np.array(problem.points)[points]
    if rng.random() < MOVED:
        cameras, start = _moved(cameras, start, rng)
    more, rest = kind.cameras - len(chosen), kind.points + 1 - len(points)  # that are not observed
    whole_cameras = np.concatenate([cameras, np.repeat(cameras[:1], more, axis=0)])
    whole_points = np.pad(start, ((0, rest), (0, 0)))
    whole_grid = np.pad(grid, ((0, more), (0, rest)))
    whole_pixels = np.pad(pixels[:, :, points] * grid, ((0, 0), (0, more), (0, rest)))
    arrays: Any = (
        whole_cameras.T,
        whole_points.T,
        whole_pixels.reshape(2, -1),
        whole_grid.reshape(-1),
    )
    return Scenes(*arrays)


def _grid(
    problem: BundleProblem, chosen: Int[np.ndarray, " chosen"]
) -> tuple[Bool[np.ndarray, "chosen points"], np.ndarray]:
    """Which of the chosen cameras see which points, and where; of repeated observations the
    last."""
    place = np.full(problem.num_cameras, -1)
    place[chosen] = np.arange(len(chosen))
    row = place[np.asarray(problem.camera_index)]
    kept = row >= 0
    row = row[kept]
    column = np.asarray(problem.point_index)[kept]
    grid = np.zeros((len(chosen), problem.num_points), bool)
    pixels = np.zeros((2, len(chosen), problem.num_points))
    grid[row, column] = True
    pixels[:, row, column] = np.asarray(problem.observations)[kept].T
    return grid, pixels


def _moved(
    cameras: np.ndarray, points: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Cameras turned and shifted, and points moved along their distance, as at the start of random
    scenes."""

    def log_uniform(limits):
        return np.exp(rng.uniform(*np.log(limits)))

    turned = geometry.rotation_matrices(cameras[:, :3])
    centers = geometry.camera_centers(cameras)
    step = np.linalg.norm(np.diff(centers, axis=0), axis=1).mean()
    centers = centers + log_uniform(START_CENTER) * step * rng.normal(size=centers.shape)
    noise = geometry.rotation_matrices(
        log_uniform(START_ROTATION) * rng.normal(size=(len(cameras), 3))
    )
    turned = noise @ turned
    cameras = cameras.copy()
    cameras[:, :3] = geometry.angle_axis(turned)
    cameras[:, 3:6] = geometry.translations(turned, centers)
    middle = centers.mean(axis=0)
    factor = np.exp(log_uniform(START_DEPTH) * rng.normal(size=(len(points), 1)))
    return cameras, middle + factor * (points - middle)
