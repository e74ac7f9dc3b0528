"""Problems to test on, and the same mathematics once more: dense, in float64, and by other means
than jaxba's.

Nothing of jaxba's camera, loss or linear algebra is used for the truth: rotations are those of
Ceres' `AngleAxisRotatePoint`, derivatives come from `jax.jacfwd`, steps from a dense QR
factorisation."""

from __future__ import annotations

import functools
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import solve_triangular
from scipy.spatial.transform import Rotation

import jaxba
from jaxba import (
    BundleProblem,
    LMState,
    Solution,
    SolveOptions,
    StepOptions,
    Tolerances,
    initial_state,
    lm_step,
    random_scene,
    scene_like,
)
from jaxba.cli.constraints import surveyed
from jaxba.lm.records import StepInfo
from jaxba.problem import geometry
from jaxba.problem.frames import in_frames
from jaxba.problem.similarity import Similarity, transformed
from jaxba.structure.layout import Layout, build_layout
from jaxba.structure.segment_sums import point_sum, point_sums, tree_sum

DATA = os.environ.get("JAXBA_DATA")
needs_data = pytest.mark.skipif(DATA is None, reason="JAXBA_DATA names no folder of real problems")
DAMPINGS = (1e-8, 1e-2, 100.0)
MINIATURES = ("dubrovnik-3-7-pre", "dubrovnik-3-7-18-pre", "dubrovnik-1-1-pre")

_step = jax.jit(lm_step, static_argnames=("options",))


def constrained(problem: BundleProblem, *options: Any, **more: Any) -> BundleProblem:
    """The problem with what `jaxba-solve` holds constant and knows by its options."""
    return surveyed(problem, *options, **more).problem


def step(layout, state: LMState, damping, options: StepOptions, min_gain=0.0, iteration=0):
    """`lm_step`, compiled. Called as `solve` does, so that the compilation cache serves both."""

    def number(x):
        return jnp.asarray(x, state.cost.dtype)

    return _step(
        layout, state, number(damping), options, number(min_gain), jnp.asarray(iteration, jnp.int32)
    )


def solve_options(step: StepOptions | None = None, **asked) -> SolveOptions:
    """Options of a solve with the given step, by default the one that the policy was made for, in
    one program.

    Args:
        step: of the solve; its linear system is solved explicitly where nothing else is said.
        asked: fields of `SolveOptions`.
    """
    given = {}
    if step is not None:
        kept = ("conjugate_gradients", "refinement", "coordinates", "intrinsics", "loss")
        given = {name: getattr(step, name) for name in kept} | {"method": step.method or "lm"}
    if {**given, **asked}.get("method", "lm") == "lm":
        given["linear_solver"] = "explicit" if step is None else step.linear_solver
    return SolveOptions(**{"compilation": "full", **given, **asked})


def solve(
    problem, policy="ceres", options: StepOptions | None = None, *, callback=None, **asked
) -> Solution:
    """`jaxba.solve` with `solve_options`."""
    return jaxba.solve(problem, policy, solve_options(options, **asked), callback=callback)


def bal_file(name: str) -> Path:
    """A real problem of the BAL data set."""
    assert DATA is not None
    return Path(DATA) / "bal" / f"{name}.txt.bz2"


# Problems


def at_origin(problem: BundleProblem, size: float = 1.0) -> BundleProblem:
    """The problem moved so that the middle of its points is the origin, and their median distance
    from it `size`."""
    points = np.asarray(problem.points) - np.median(problem.points, axis=0)
    scale = size / np.median(np.abs(points).sum(axis=1))
    return transformed(
        problem, Similarity(scale, np.eye(3), -scale * np.median(problem.points, axis=0))
    )


@functools.cache
def tiny() -> BundleProblem:
    """6 cameras, 40 points, 200 observations: 40 visibilities are missing, so tracks differ."""
    return random_scene(scene_like("tiny"), 0)


@functools.cache
def paper(seed: int) -> BundleProblem:
    """10 cameras, 10 points, all visible: every seed has the same shape, so all share one
    program."""
    return random_scene(scene_like("paper"), seed)


@functools.cache
def whitened() -> BundleProblem:
    """`tiny` with correlated covariances, and two points whose weights make the clamp of the
    diagonal act."""
    problem = tiny()
    rng = np.random.default_rng(3)
    root = rng.normal(size=(problem.num_observations, 2, 2)) + 1.5 * np.eye(2)
    problem = BundleProblem.create(
        *arrays(problem), covariance=root @ root.transpose(0, 2, 1) + 0.01 * np.eye(2)
    )
    whitening = np.array(problem.whitening)
    whitening[problem.point_index == 4] *= 1e-7
    whitening[problem.point_index == 9] = 0
    return problem.replace(whitening=whitening)


@functools.cache
def odd() -> BundleProblem:
    """What files contain: a pair seen twice, cameras and points that nobody observes, a point seen
    once, points behind a camera, and a camera without rotation."""
    problem = tiny()
    rng = np.random.default_rng(5)
    cameras = np.vstack([problem.cameras, rng.normal(size=(2, 9))])
    middle = problem.points.mean(axis=0)
    points = np.vstack([problem.points, middle + rng.normal(size=(4, 3))])
    # camera 6 is nobody's, camera 7 looks down -z at the middle from 15 away and has point 41
    # behind it
    cameras[7] = [0, 0, 0, *(-middle - [0, 0, 15]), 600, -0.02, 0.001]
    points[41] = middle + np.array([0.4, -0.3, 20.0])
    at = points[[0, 1, 2, 43, 41]] + cameras[7, 3:6]
    seen = 600 * -at[:, :2] / at[:, 2:] + rng.normal(size=(5, 2))
    twice = np.flatnonzero(problem.point_index == 3)[:2]
    return BundleProblem.create(
        cameras,
        points,
        np.vstack([problem.observations, problem.observations[twice] + 1.0, seen]),
        np.concatenate([problem.camera_index, problem.camera_index[twice], np.full(5, 7)]),
        np.concatenate([problem.point_index, problem.point_index[twice], [0, 1, 2, 43, 41]]),
    )


@functools.cache
def single() -> BundleProblem:
    """One camera, one point, one observation: two equations for twelve numbers."""
    camera = [[0.1, -0.2, 0.05, 0.3, 0.2, -4.0, 500, -0.01, 0.002]]
    return BundleProblem.create(camera, [[0.5, -0.4, 0.7]], [[60.0, -20.0]], [0], [0])


def random_views(cameras: int, points: int, seed: int, duplicates: int = 0) -> BundleProblem:
    """Random views in random order; some are there twice, some cameras and points have none."""
    rng = np.random.default_rng(seed)
    seen = rng.random((cameras, points)) < rng.uniform(0.05, 0.5)
    seen[rng.integers(cameras), rng.integers(points)] = True
    views = rng.permutation(np.argwhere(seen))
    views = np.concatenate([views, views[rng.integers(len(views), size=duplicates)]])
    pixels = rng.normal(size=(len(views), 2))
    return BundleProblem.create(
        rng.normal(size=(cameras, 9)),
        rng.normal(size=(points, 3)),
        pixels,
        views[:, 0],
        views[:, 1],
    )


@functools.cache
def solved() -> BundleProblem:
    """`tiny` at its minimum."""
    return solve(tiny(), "ceres", tolerances=Tolerances(ftol=1e-12)).problem


def strayed(factor: float, every: int = 5) -> BundleProblem:
    """Every fifth point at a multiple of its distance from the first camera that sees it."""
    problem = solved()
    points = np.array(solved().points)
    centers = geometry.camera_centers(problem.cameras)
    for point in range(0, len(points), every):
        center = centers[problem.camera_index[np.argmax(problem.point_index == point)]]
        points[point] = center + factor * (points[point] - center)
    return problem.replace(points=points)


def thrown(seed: int, size: float) -> BundleProblem:
    """All points far from where they belong."""
    noise = np.random.default_rng(seed).normal(size=solved().points.shape)
    return solved().replace(points=solved().points + size * noise)


def arrays(problem: BundleProblem) -> tuple:
    """The arguments of `BundleProblem.create`."""
    return (
        problem.cameras,
        problem.points,
        problem.observations,
        problem.camera_index,
        problem.point_index,
    )


def start(problem: BundleProblem, options: StepOptions | None = None, dtype: str = "float64"):
    """Layout and state of a problem."""
    options = options or StepOptions()
    layout = build_layout(problem, options)
    return layout, _initial(layout, in_frames(problem), options, dtype)


@functools.partial(jax.jit, static_argnames=("options", "dtype"))
def _initial(layout, problem, options, dtype) -> LMState:
    return initial_state(layout, problem, options, jnp.dtype(dtype))


def same_bits(a, b) -> bool:
    """Whether two pytrees agree in every bit, NaN included."""
    pairs = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return all(np.asarray(x).tobytes() == np.asarray(y).tobytes() for x, y in pairs)


def step_info(
    accepted: bool, gain: float = 1.0, damping: float = 1.0, dtype=jnp.float64, **changes
) -> StepInfo:
    """A record for a damping rule to look at."""

    def number(x):
        return jnp.asarray(x, dtype)

    values = {
        "cost": 1.0,
        "previous_cost": 2.0,
        "candidate_cost": 1.0,
        "predicted": 1.0,
        "gain_ratio": gain,
        "damping": damping,
        "gradient_max": 1.0,
        "step_norm": 1.0,
        "parameter_norm": 1.0,
        "step_fraction": 1.0,
        "damping_fraction": 0.0,
        "forcing": 0.0,
        **changes,
    }
    return StepInfo(
        **{name: number(value) for name, value in values.items()},
        accepted=jnp.asarray(accepted),
        weightless=jnp.asarray(False),
        **dict.fromkeys(("cg_iterations", "repairs"), jnp.asarray(0, jnp.int32)),
    )


# The camera once more


def rotate(vector, point):
    """Rotates a point by an angle-axis vector as Ceres' `AngleAxisRotatePoint` does, first order at
    zero."""
    squared = jnp.sum(vector**2)
    zero = squared < 1e-30
    angle = jnp.sqrt(jnp.where(zero, 1.0, squared))
    axis = vector / angle
    turned = (
        point * jnp.cos(angle)
        + jnp.cross(axis, point) * jnp.sin(angle)
        + axis * jnp.sum(axis * point) * (1 - jnp.cos(angle))
    )
    return jnp.where(zero, point + jnp.cross(vector, point), turned)


def project_one(turn, camera, point):
    """Pixel of one point in one camera, whose rotation is multiplied by exp(turn) from the left."""
    local = rotate(turn, rotate(camera[:3], point)) + camera[3:6]
    p = -local[:2] / local[2]
    squared = jnp.sum(p**2)
    return camera[6] * (1 + camera[7] * squared + camera[8] * squared**2) * p


@jax.jit
def _projected(cameras, points):
    zero = jnp.zeros((cameras.shape[0], 3))
    jacobian = jax.vmap(jax.jacfwd(project_one, argnums=(0, 1, 2)))(zero, cameras, points)
    return jax.vmap(project_one)(zero, cameras, points), *jacobian


# Losses once more: loss_function.h of Ceres, `rho(s)` and `rho'(s)` for scale a


def distort(plane: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
    """Pixels of image plane coordinates p, [n, 2], under (f, k1, k2), [n, 3]: `f (1 + k1 |p|^2 + k2
    |p|^4) p`."""
    square = np.sum(plane**2, axis=1)
    focal, k1, k2 = intrinsics.T
    return (focal * (1 + square * (k1 + square * k2)))[:, None] * plane


def published_loss(name: str, scale: float, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Value and derivative as Ceres defines them."""
    a = scale
    b = scale**2
    s = np.asarray(s, np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        if name == "squared":
            return s, np.ones_like(s)
        if name == "huber":
            inside = s <= b
            return np.where(inside, s, 2 * a * np.sqrt(s) - b), np.where(inside, 1, a / np.sqrt(s))
        if name == "soft_l1":
            root = np.sqrt(1 + s / b)
            return 2 * b * (root - 1), 1 / root
        if name == "cauchy":
            return b * np.log1p(s / b), 1 / (1 + s / b)
        if name == "tukey":
            inside = s <= b
            return np.where(inside, b / 3 * (1 - (1 - s / b) ** 3), b / 3), np.where(
                inside, (1 - s / b) ** 2, 0
            )
    raise AssertionError(name)


# The step once more


@dataclass(frozen=True)
class Dense:
    """The damped normal equations of one linearisation as plain matrices; cameras first, then
    points."""

    residual: np.ndarray
    jacobian: np.ndarray
    diagonal: np.ndarray  # D / lambda
    damping: float
    step: np.ndarray

    @property
    def gradient(self) -> np.ndarray:
        """`J^T r`."""
        return self.jacobian.T @ self.residual

    @property
    def predicted(self) -> float:
        """`-(g.d + d.H d / 2)`, in the form that does not cancel."""
        moved = self.jacobian @ self.step
        return float(-moved @ (self.residual + 0.5 * moved))

    def norm(self, step: np.ndarray) -> float:
        """Norm in which the damped Hessian is the unit matrix: `sqrt(d.(H + D) d)`, pixels."""
        damped = self.damping * self.diagonal * step**2
        return float(np.sqrt(np.sum((self.jacobian @ step) ** 2) + np.sum(damped)))


def cost(problem: BundleProblem, options: StepOptions) -> float:
    """The objective in float64."""
    residual = _residual(problem)[0]
    return 0.5 * float(
        np.sum(published_loss(options.loss.rho, options.loss.scale, np.sum(residual**2, axis=1))[0])
    )


def _residual(problem: BundleProblem):
    pixel, *jacobian = _projected(
        jnp.asarray(problem.cameras)[problem.camera_index],
        jnp.asarray(problem.points)[problem.point_index],
    )
    residual = np.asarray(pixel) - problem.observations
    jacobian = [np.array(j) for j in jacobian]
    if problem.whitening is not None:
        residual = np.einsum("nij,nj->ni", problem.whitening, residual)
        jacobian = [np.einsum("nij,njk->nik", problem.whitening, j) for j in jacobian]
    return residual, jacobian


def linear(problem: BundleProblem, options: StepOptions) -> tuple[np.ndarray, np.ndarray]:
    """Residuals and Jacobian as a vector and a matrix, weighted by the loss; cameras first, then
    points."""
    residual, (turn, camera, point) = _residual(problem)
    if options.coordinates.rotation == "manifold":
        camera[:, :, :3] = turn
    weight = np.sqrt(
        published_loss(options.loss.rho, options.loss.scale, np.sum(residual**2, axis=1))[1]
    )
    count = problem.num_observations
    cameras = problem.num_cameras
    if options.intrinsics == "fixed":
        camera[:, :, 6:] = 0
    jacobian = np.zeros((count, 2, 9 * cameras + 3 * problem.num_points))
    rows = np.arange(count)
    for k in range(9):
        jacobian[rows, :, 9 * problem.camera_index + k] = weight[:, None] * camera[:, :, k]
    for k in range(3):
        jacobian[rows, :, 9 * cameras + 3 * problem.point_index + k] = (
            weight[:, None] * point[:, :, k]
        )
    return (weight[:, None] * residual).ravel(), jacobian.reshape(2 * count, -1)


def dense(problem: BundleProblem, options: StepOptions, damping: float) -> Dense:
    """Linearises and solves: the least squares problem `[J; sqrt(D)] d = [-r; 0]` by QR after
    scaling the columns.

    That is the damped normal equations without squaring the condition number, so that the truth is
    better than what is compared with it."""
    residual, jacobian = linear(problem, options)
    diagonal = np.ones(jacobian.shape[1])
    if options.coordinates.scaling == "diagonal":
        diagonal = np.clip(np.sum(jacobian**2, axis=0), 1e-6, 1e32)
    stacked = np.vstack([jacobian, np.diag(np.sqrt(damping * diagonal))])
    # what no residual depends on stays; a factorisation finds that to rounding only
    free = jacobian.any(axis=0)
    stacked = stacked[:, free]
    scale = 1 / np.linalg.norm(stacked, axis=0)
    q, r = np.linalg.qr(stacked * scale)
    found = np.zeros(len(free))
    found[free] = scale * solve_triangular(
        r, -q.T @ np.concatenate([residual, np.zeros(len(diagonal))])
    )
    return Dense(residual, jacobian, diagonal, damping, found)


def moved(problem: BundleProblem, options: StepOptions, change: np.ndarray) -> BundleProblem:
    """The problem after a step."""
    cameras = problem.cameras + change[: problem.cameras.size].reshape(-1, 9)
    if options.coordinates.rotation == "manifold":
        turn = Rotation.from_rotvec(change[: problem.cameras.size].reshape(-1, 9)[:, :3])
        cameras[:, :3] = (turn * Rotation.from_rotvec(problem.cameras[:, :3])).as_rotvec()
    return problem.replace(
        cameras=cameras, points=problem.points + change[problem.cameras.size :].reshape(-1, 3)
    )


def back(problem: BundleProblem, before: LMState, after: LMState) -> BundleProblem:
    """The problem at `after`; which column is which point is told by the start, where all points
    differ."""
    equal = (np.asarray(before.points).T[:, None, :] == problem.points).all(axis=2)
    assert (equal.sum(axis=1) <= 1).all()
    column, row = np.nonzero(equal)
    points = np.array(problem.points)
    points[row] = np.asarray(after.points).T[column]
    return problem.replace(cameras=np.asarray(after.cameras).T, points=points)


def difference(problem: BundleProblem, after: BundleProblem, options: StepOptions) -> np.ndarray:
    """The step between two sets of parameters, in the coordinates of the options."""
    cameras = np.array(after.cameras - problem.cameras)
    if options.coordinates.rotation == "manifold":
        turned = (
            Rotation.from_rotvec(np.array(after.cameras[:, :3]))
            * Rotation.from_rotvec(problem.cameras[:, :3]).inv()
        )
        cameras[:, :3] = turned.as_rotvec()
    return np.concatenate([cameras.ravel(), (after.points - problem.points).ravel()])


def check_step(problem: BundleProblem, options: StepOptions, damping: float) -> None:
    """Everything that a step says and does, against the dense solution of the damped normal
    equations.

    Parameters are compared in the norm of the damped Hessian. With seven gauge freedoms its
    condition number is about 1 / lambda under diagonal scaling and 1e15 for the smallest lambda
    under identity scaling, so that float64 does not define the gauge part of the step to 1e-8 in
    any other norm; in this one it always does. Where the condition number allows it, every kind of
    parameter and the cost behind the step are compared too."""
    layout, before = start(problem, options)
    after, info = step(layout, before, damping, options)
    truth = dense(problem, options, damping)
    now = cost(problem, options)
    well_conditioned = damping > 5e-5 and options.coordinates.scaling == "diagonal"

    np.testing.assert_allclose(before.cost, now, rtol=1e-12)
    np.testing.assert_allclose(info.previous_cost, now, rtol=1e-12)
    np.testing.assert_allclose(info.predicted, truth.predicted, rtol=1e-8)
    np.testing.assert_allclose(info.gradient_max, np.max(np.abs(truth.gradient)), rtol=1e-10)
    np.testing.assert_allclose(
        info.gain_ratio, (now - info.candidate_cost) / truth.predicted, rtol=1e-7
    )
    assert bool(info.accepted) == (info.candidate_cost < now)
    assert float(info.damping) == damping
    if well_conditioned:
        there = cost(moved(problem, options, truth.step), options)
        np.testing.assert_allclose(info.candidate_cost, there, rtol=1e-8, atol=1e-10 * now)
        np.testing.assert_allclose(info.step_norm, np.linalg.norm(truth.step), rtol=1e-8)
    if not info.accepted:
        assert same_bits(after, before)
        return
    end = back(problem, before, after)
    np.testing.assert_allclose(after.cost, cost(end, options), rtol=1e-9, atol=1e-12 * now)
    found = difference(problem, end, options)
    assert truth.norm(found - truth.step) <= 1e-8 * truth.norm(truth.step)
    if well_conditioned:
        size = problem.cameras.size
        cameras = found[:size].reshape(-1, 9)
        expected = truth.step[:size].reshape(-1, 9)
        for part in (slice(0, 3), slice(3, 6), 6, 7, 8):
            assert np.linalg.norm((cameras - expected)[:, part]) <= 1e-8 * np.linalg.norm(
                expected[:, part]
            )
        assert np.linalg.norm(found[size:] - truth.step[size:]) <= 1e-8 * np.linalg.norm(
            truth.step[size:]
        )


def batch_sums(pairs, chunks: np.ndarray) -> np.ndarray:
    """What a batch after the other sums of its own chunks, all in one row."""
    return np.concatenate(
        [row[sums].sum(axis=-1) for row, sums in zip(chunks, np.asarray(pairs.sums), strict=True)]
    )


def by_camera(layout: Layout, values: np.ndarray) -> np.ndarray:
    """Values of slots in the order of the cameras."""
    return values[np.asarray(layout.camera_levels[0]).ravel()]


def check_sums(layout: Layout, rng: np.random.Generator) -> None:
    """Sums over points and over cameras equal `np.add.at`, for random values in every slot that is
    used."""
    values = np.where(layout.slot_mask, rng.normal(size=(4, layout.num_slots)), 0)
    column = np.zeros((4, layout.num_points))
    np.add.at(column.T, layout.slot_point, values.T)
    np.testing.assert_allclose(
        point_sum(layout, jnp.asarray(values)), column, rtol=1e-12, atol=1e-13
    )
    apart = jax.jit(point_sums)(layout, list(jnp.asarray(values)))
    np.testing.assert_allclose(jnp.stack(apart), column, rtol=1e-12, atol=1e-13)
    camera = np.zeros((layout.num_cameras, 4))
    np.add.at(camera, layout.slot_camera, values.T)
    np.testing.assert_allclose(
        tree_sum(jnp.asarray(values.T), layout.camera_levels), camera, rtol=1e-12, atol=1e-13
    )
