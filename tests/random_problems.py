"""Small random problems of every kind: rigs, shared lenses, priors, losses, constants and
gauges."""

from __future__ import annotations

import warnings

import numpy as np
from scipy.spatial.transform import Rotation

from jaxba import (
    BundleProblem,
    Lenses,
    Loss,
    ProblemWarning,
    Rigs,
    hold,
    residuals,
    with_gauge,
    with_lens_priors,
    with_position_priors,
    with_residual,
    with_rotation_priors,
)
from jaxba.problem import geometry

LOSSES = Loss(), Loss(), Loss("huber", 1.0), Loss("soft_l1", 2.0), Loss("cauchy", 2.0)


def draw(kind: int, seed: int = 0) -> tuple[BundleProblem, Loss]:
    """A problem and a loss. Those of one kind have the same structure, and so share programs."""
    structure = np.random.default_rng([kind, 17])
    values = np.random.default_rng([kind, seed])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ProblemWarning)
        problem = _scene(structure, values)
        problem = (
            _measured(problem, structure, values)
            if structure.random() < 0.5
            else _fixed(problem, structure)
        )
    return problem, LOSSES[structure.integers(len(LOSSES))]


def _scene(structure: np.random.Generator, values: np.random.Generator) -> BundleProblem:
    """5 to 20 cameras around points, in rigs of up to three sensors, with up to three lenses or one
    each."""
    sensors = int(structure.integers(1, 4))
    points = int(structure.integers(30, 90))
    frames = int(structure.integers(-(-5 // sensors), 20 // sensors + 1))
    cameras = sensors * frames
    free = bool(structure.integers(2))
    frame, sensor = np.divmod(np.arange(cameras), sensors)
    lens = sensor if sensors > 1 else np.arange(cameras) % int(structure.choice([1, 2, cameras]))
    angle = 2 * np.pi * np.arange(frames) / frames * structure.choice([0.3, 1.0])
    upright = np.outer(-angle, [0, 1, 0]) + 0.05 * values.normal(size=(frames, 3))
    # of the points, in each frame
    middle = np.array([0, 0, -6.0]) + 0.3 * values.normal(size=(frames, 3))
    turn = 0.15 * values.normal(size=(sensors, 3))
    offset = 0.3 * values.normal(size=(sensors, 3))
    turn[0] = offset[0] = 0
    positions = values.uniform(-1.5, 1.5, size=(points, 3))
    intrinsics = np.array([700.0, -0.05, 0.0]) * (1 + 0.1 * values.normal(size=(lens.max() + 1, 3)))

    def placed(upright, middle, turn, offset, lenses) -> tuple[np.ndarray, np.ndarray]:
        place = Rotation.from_rotvec(turn[sensor])
        turns = (place * Rotation.from_rotvec(upright[frame])).as_rotvec()
        return np.hstack(
            [turns, place.apply(middle[frame]) + offset[sensor], lenses[lens]]
        ), place.as_matrix()

    seen = structure.random((cameras, points)) < 0.7
    camera, point = np.nonzero(
        seen | (np.add.outer(np.arange(cameras), np.arange(points)) % cameras < 2)
    )
    truth = BundleProblem.create(placed(upright, middle, turn, offset, intrinsics)[0], positions,
                                 np.zeros((len(camera), 2)), camera, point)  # fmt: skip
    pixels = geometry.project(truth) + 0.5 * values.normal(size=(len(camera), 2))

    def moved(x, by):
        return x + by * values.normal(size=x.shape)

    if sensors > 1 and free:
        turn[1:], offset[1:] = moved(turn[1:], 0.01), moved(offset[1:], 0.02)
    start = moved(upright, 0.01), moved(middle, 0.05)
    numbers = intrinsics * moved(np.ones_like(intrinsics), 0.01)
    begun, matrices = placed(*start, turn, offset, numbers)
    rigs = Rigs(frame, matrices, offset[sensor], (sensor > 0) & free) if sensors > 1 else None
    lenses = None if lens.max() + 1 == cameras else Lenses(lens, np.ones((lens.max() + 1, 3), bool))
    return BundleProblem.create(
        begun, moved(positions, 0.03), pixels, camera, point, lenses=lenses, rigs=rigs
    )


def _measured(
    problem: BundleProblem, structure: np.random.Generator, values: np.random.Generator
) -> BundleProblem:
    """With priors of any strength, and perhaps surveyed points or a scale bar."""

    def spread(low, high):
        return float(np.exp(values.uniform(np.log(low), np.log(high))))

    wanted = structure.random(5) < [0.7, 0.3, 0.3, 0.3, 0.2]
    count = problem.num_cameras
    if wanted[0]:
        sigma = spread(1e-3, 1.0)
        centers = geometry.camera_centers(problem.cameras) + sigma * values.normal(size=(count, 3))
        problem = with_position_priors(
            problem, centers, stddev=sigma, align=bool(structure.integers(2))
        )
    if wanted[1]:
        sigma = spread(1e-4, 0.1)
        turns = problem.cameras[:, :3] + 0.3 * sigma * values.normal(size=(count, 3))
        problem = with_rotation_priors(problem, turns, sigma**2 * np.eye(3))
    if wanted[2]:
        problem = with_lens_priors(problem, {"focal": spread(0.1, 100.0), "k1": spread(1e-3, 0.1)})
    if wanted[3]:
        sigma = spread(1e-3, 0.3)
        at = structure.permutation(problem.num_points)[:5]
        surveyed = problem.points[at] + sigma * values.normal(size=(5, 3))
        rows = residuals.control_point(
            point=at, position=surveyed, whitening=np.tile(np.eye(3) / sigma, (5, 1, 1))
        )
        problem = with_residual(problem, rows)
    if wanted[4]:
        one, other = structure.permutation(count)[:2]
        length = np.linalg.norm(
            np.diff(geometry.camera_centers(problem.cameras)[[one, other]], axis=0)
        )
        rows = residuals.baseline(
            pose=[one], pose_2=[other], length=1.05 * length, sigma=spread(1e-3, 0.3)
        )
        problem = with_residual(problem, rows)
    return problem


def _fixed(problem: BundleProblem, structure: np.random.Generator) -> BundleProblem:
    """With a gauge, or constant poses, points and numbers of lenses."""
    which = structure.integers(5)
    if which < 2:
        return with_gauge(problem, ("two-cameras", "free")[which])
    if which == 2:
        return hold(problem, poses=range(int(structure.integers(1, 4))), numbers=["k2"])
    if which == 3:
        return hold(problem, points=range(int(structure.integers(1, 9))), rotations=[0])
    return hold(problem, lenses=[0], extrinsics=[] if structure.integers(2) else "all")
