"""Points from the rays of their pixels: the nearest point to all rays, and a start that is never
worse."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq
from support import solve, solved, strayed, thrown

from jaxba import BundleProblem, Loss, StepOptions, build_layout, initial_state, lm_step
from jaxba.model.linearize import linearize, slot_frames
from jaxba.problem import geometry
from jaxba.problem.options import Refinement
from jaxba.refinement import acceptance
from jaxba.refinement.midpoints import choose_starts, midpoints, refine_from_starts
from jaxba.refinement.points import PreviousPoints, refine_points

LOSS = Loss()


@functools.partial(jax.jit, static_argnames=("loss",))
def _starts(layout, cameras, before, points, loss):
    previous = PreviousPoints.of(layout, before, linearize(layout, cameras, before, loss).reference)
    return choose_starts(layout, cameras, slot_frames(layout, cameras), points, loss, previous)


def _there(layout, cameras, before):
    reference = linearize(layout, cameras, before, LOSS).reference
    return slot_frames(layout, cameras), PreviousPoints.of(layout, before, reference)


@jax.jit
def _refined(layout, cameras, before, start):
    """Points and costs, stacked."""
    frames, previous = _there(layout, cameras, before)
    return jnp.concatenate(
        [
            (found := refine_points(layout, cameras, frames, start, LOSS, 3, previous))[0],
            found[1][None],
        ]
    )


@jax.jit
def _from_starts(layout, cameras, before, points, starts):
    frames, previous = _there(layout, cameras, before)
    found = refine_from_starts(layout, cameras, frames, points, LOSS, 3, previous, starts)
    return jnp.concatenate([found[0], found[1][None]])


_midpoints = jax.jit(lambda layout, cameras: midpoints(layout, slot_frames(layout, cameras)))


def order_of(problem: BundleProblem) -> tuple[np.ndarray, np.ndarray]:
    """Columns of a layout's points that are points of the problem, and which."""
    order = np.asarray(build_layout(problem).points)
    real = np.flatnonzero(order < problem.num_points)
    return real, order[real]


def in_layout(problem: BundleProblem, points: np.ndarray) -> np.ndarray:
    """Points in layout order."""
    return np.asarray(
        initial_state(build_layout(problem), problem.replace(points=points), StepOptions()).points
    )


def nearest_to_rays(problem: BundleProblem, point: int) -> np.ndarray:
    """Least squares over a point's rays by NumPy, each undistorted by a root search."""
    rows = []
    right = []
    for k in np.flatnonzero(problem.point_index == point):
        camera = np.asarray(problem.cameras)[problem.camera_index[k]]
        pixel = np.asarray(problem.observations)[k]
        f, k1, k2 = camera[6:]
        size = np.linalg.norm(pixel)
        radius = brentq(
            lambda r, s=size, f=f, a=k1, b=k2: f * r * (1 + a * r**2 + b * r**4) - s,
            0,
            2 * size / f,
        )
        turn = geometry.rotation_matrices(camera[None, :3])[0]
        ray = turn.T @ np.array([*(radius * pixel / size), -1])
        ray /= np.linalg.norm(ray)
        across = np.eye(3) - np.outer(ray, ray)
        rows.append(across)
        right.append(across @ -turn.T @ camera[3:6])
    return np.linalg.lstsq(np.concatenate(rows), np.concatenate(right))[0]


@pytest.mark.parametrize("make", [solved, lambda: thrown(1, 3.0)], ids=["at home", "far"])
def test_midpoints_are_nearest_to_all_rays_wherever_points_are(make):
    problem = make()
    cameras = np.array(problem.cameras)
    cameras[:, 7:] = 0.05, -0.02
    problem = problem.replace(cameras=cameras)
    found = np.asarray(_midpoints(build_layout(problem), cameras.T))
    real, order = order_of(problem)
    expected = np.array([nearest_to_rays(problem, point) for point in order])
    np.testing.assert_allclose(found[:, real].T, expected, rtol=1e-6, atol=1e-8)


def test_midpoints_of_exact_pixels_are_the_points():
    problem = solved()
    exact = problem.replace(observations=geometry.project(problem))
    found = np.asarray(_midpoints(build_layout(exact), np.asarray(problem.cameras).T))
    real, order = order_of(exact)
    np.testing.assert_allclose(found[:, real].T, np.asarray(problem.points)[order], rtol=1e-6)


def point_costs(problem: BundleProblem) -> np.ndarray:
    squared = np.sum(geometry.residuals(problem) ** 2, axis=1)
    return np.bincount(problem.point_index, 0.5 * squared, minlength=problem.num_points)


@pytest.mark.parametrize(
    "make", [lambda: thrown(2, 3.0), lambda: strayed(-1.0), lambda: strayed(1e4)]
)
def test_a_start_costs_no_more_than_where_the_step_went_and_is_behind_no_camera(make):
    home = solved()
    gone = make()
    layout = build_layout(home)
    cameras = np.asarray(home.cameras).T
    args = cameras, in_layout(home, home.points), in_layout(home, gone.points)
    found = np.asarray(_starts(layout, *args, LOSS)[0])
    real, order = order_of(home)
    points = np.array(home.points)
    points[order] = found[:, real].T
    after = home.replace(points=points)
    behind = np.bincount(gone.point_index, geometry.depths(gone) < 0, minlength=gone.num_points) > 0
    before = point_costs(gone)
    now = point_costs(after)
    assert (now[~behind] <= before[~behind] * (1 + 1e-12)).all()
    assert (geometry.depths(after) > 0).all()  # as at home
    moved = np.any(points != gone.points, axis=1)
    assert moved.any()
    assert now.sum() < 1e-2 * before.sum()


def test_where_the_step_was_right_nothing_is_moved():
    """At the minimum a point fits better than the midpoint of its rays, which minimises something
    else."""
    problem = solved()
    own = in_layout(problem, problem.points)
    found = _starts(build_layout(problem), np.asarray(problem.cameras).T, own, own, LOSS)
    np.testing.assert_array_equal(found[0], own)
    real, _ = order_of(problem)
    assert not np.array_equal(np.asarray(found[1])[:, real], own[:, real])  # the midpoint


def wrong(seed: int, size: float) -> tuple[BundleProblem, np.ndarray]:
    """Wrong matches, which give points several minima, and places far from where they are."""
    home = solved()
    rng = np.random.default_rng(seed)
    pixels = np.array(home.observations)
    some = rng.random(len(pixels)) < 0.3
    pixels[some] += 300 * rng.normal(size=(some.sum(), 2))
    noise = np.random.default_rng(seed).normal(size=home.points.shape)
    return home.replace(observations=pixels), home.points + size * noise


@pytest.mark.parametrize(("seed", "size"), [(0, 0.3), (1, 0.3), (2, 3.0)])
def test_from_both_starts_a_point_ends_at_the_cheaper_end_and_from_one_at_that_of_the_likely_one(
    seed, size
):
    """Against `refine_points` from each of them.

    Two programs round differently. By costs that agree to rounding a minimum is known to the root
    of it alone: both starts may end there, 1e-8 apart. Other minima are 1e-2 away and more."""
    home, points = wrong(seed, size)
    args = (
        build_layout(home),
        np.asarray(home.cameras).T,
        in_layout(home, home.points),
        in_layout(home, points),
    )
    apart = [np.asarray(_refined(*args[:3], start)) for start in _starts(*args, LOSS)]
    none, one, both = (np.asarray(_from_starts(*args, jnp.asarray(starts))) for starts in range(3))

    def same(found: np.ndarray, expected: np.ndarray) -> None:
        np.testing.assert_allclose(found[3], expected[3], rtol=1e-9)
        np.testing.assert_allclose(found[:3], expected[:3], rtol=1e-5, atol=1e-5)

    same(none, np.asarray(_refined(*args[:3], args[3])))
    same(one, apart[0])
    second = apart[1][3] < apart[0][3]
    assert (apart[1][3] < apart[0][3] * (1 - 1e-3)).any()
    same(both, np.where(second, apart[1], apart[0]))


@pytest.mark.slow
def test_a_step_that_promises_little_starts_points_from_both(monkeypatch):
    """Cameras that hardly move: the candidate is what points alone find from where they are."""
    home, points = wrong(2, 3.0)
    problem = home.replace(points=points)
    args = build_layout(home), np.asarray(home.cameras).T, *[in_layout(home, points)] * 2
    options = StepOptions(refinement=Refinement(points=3, starts="rays"))
    damping = jnp.asarray(1e12)
    costs = {}
    for limit, both in ((acceptance.NEAR_CONVERGENCE, True), (0.0, False)):
        monkeypatch.setattr(acceptance, "NEAR_CONVERGENCE", limit)
        once = jax.jit(lambda layout, state: lm_step(layout, state, damping, options)[1])
        info = once(args[0], initial_state(args[0], problem, options))
        assert info.predicted < 1e-3 * info.previous_cost
        costs[both] = float(np.sum(_from_starts(*args, jnp.asarray(1 + both))[3]))
        np.testing.assert_allclose(info.candidate_cost, costs[both], rtol=1e-6)
    assert costs[True] < costs[False] * (1 - 3e-5)


@pytest.mark.slow
def test_only_the_whole_step_asks_for_the_rays():
    """Points far away: they start from their rays where the step is whole, not where it is tried
    again shorter."""
    start = strayed(1e4)
    layout = build_layout(start)
    state = initial_state(layout, start, StepOptions())
    damping = jnp.asarray(1.0)
    costs = {}
    for trials in (1, 2):
        options = StepOptions(refinement=Refinement(points=3, starts="rays", trials=trials))
        once = jax.jit(
            lambda layout, state, options=options: lm_step(
                layout, state, damping, options, jnp.inf
            )[1]
        )
        info = once(layout, state)
        assert not info.accepted
        costs[trials] = float(info.candidate_cost)
    assert costs[1] < 0.1 * costs[2]


@pytest.mark.slow
def test_points_that_lie_far_away_come_back_in_four_iterations_where_their_rays_are_asked():
    start = strayed(30.0)
    best = geometry.cost(solved())
    step = StepOptions(refinement=Refinement(points=3))
    rays = StepOptions(refinement=Refinement(points=3, starts="rays"))
    found = solve(start, "gauss-newton", rays, max_iterations=4)
    np.testing.assert_allclose(found.final_cost, best, rtol=1e-3)
    other = solve(start, "gauss-newton", step, max_iterations=4)
    assert other.final_cost > 1.1 * best
