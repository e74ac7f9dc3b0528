"""Embedded point iterations: every point by itself, never worse than before, and at the end where
SciPy ends.

A step with a lambda of 1e30 moves no camera and no point by itself, so that all that it does is the
refinement."""

from __future__ import annotations

import functools

import chex
import jax
import numpy as np
import pytest
import support
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from support import bal_file, needs_data, published_loss, solve, start, step

from jaxba import BundleProblem, Loss, StepOptions, read_bal
from jaxba.model.linearize import linearize, slot_frames
from jaxba.problem import geometry
from jaxba.problem.options import Refinement
from jaxba.refinement.points import (
    MAX_DISTANCE_RATIO,
    SMALL_DECREASE,
    PreviousPoints,
    refine_points,
)

pytestmark = pytest.mark.step

STILL = 1e30
"""A lambda under which the linear solve moves nothing."""

TO_THE_END = 60


def thrown(seed: int, size: float) -> BundleProblem:
    """`tiny` with points far from where they belong; the shape stays, so the program does too."""
    problem = support.tiny()
    noise = np.random.default_rng(seed).normal(size=problem.points.shape)
    return problem.replace(points=problem.points + size * noise)


def refined(problem: BundleProblem, iterations: int, loss: Loss | None = None):
    """The problem after refinement alone, and the record of it."""
    options = StepOptions(loss=loss or Loss(), refinement=Refinement(points=iterations))
    layout, before = start(problem, options)
    after, info = step(layout, before, STILL, options)
    return support.back(problem, before, after), info


def point_costs(problem: BundleProblem, loss: Loss) -> np.ndarray:
    """Cost of each point's observations."""
    squared = np.sum(geometry.residuals(problem) ** 2, axis=1)
    values = 0.5 * published_loss(loss.rho, loss.scale, squared)[0]
    return np.bincount(problem.point_index, values, minlength=problem.num_points)


@pytest.mark.parametrize("loss", [Loss(), Loss("huber", 2.0)], ids=["squared", "huber"])
@pytest.mark.parametrize(("seed", "size"), [(0, 0.0), (1, 0.3), (2, 1.0), (3, 3.0), (4, 10.0)])
def test_no_point_gets_worse_and_the_total_is_their_sum(seed, size, loss):
    problem = thrown(seed, size)
    before = point_costs(problem, loss)
    after, info = refined(problem, 3, loss)
    assert info.accepted
    assert (point_costs(after, loss) <= before * (1 + 1e-12) + 1e-12).all()
    np.testing.assert_allclose(info.cost, point_costs(after, loss).sum(), rtol=1e-10)
    assert info.cost <= info.previous_cost


def test_more_iterations_never_cost_more():
    for seed, size in ((0, 0.1), (1, 2.0)):
        problem = thrown(seed, size)
        costs = [float(refined(problem, k)[1].cost) for k in (1, 3, TO_THE_END)]
        assert costs[0] >= costs[1] >= costs[2]
        assert geometry.cost(problem) >= costs[0]


def test_points_take_no_further_step_after_one_that_brought_no_more_than_enough():
    layout, state = start(support.tiny())
    frames = slot_frames(layout, state.cameras)
    loss = Loss()
    refine = jax.jit(
        lambda points, iterations, enough: refine_points(
            layout, state.cameras, frames, points, loss, iterations, None, enough
        )
    )

    def total(iterations, enough=-np.inf):
        return float(np.sum(refine(state.points, iterations, enough)[1]))

    totals = [total(k) for k in range(5)]
    brought = -np.diff(totals)
    assert (brought[:3] > 0).all()
    assert (np.diff(brought[:3]) < 0).all()
    for enough in (*brought[:3] * (1 + 1e-6), *brought[:3] * (1 - 1e-6), 1e300):
        last = next(
            k
            for k in range(4)
            if brought[k] <= min(enough, SMALL_DECREASE * totals[k + 1]) or k == 3
        )
        np.testing.assert_allclose(total(4, enough), totals[last + 1], rtol=1e-12)
    # so that the last of them is not after the first
    assert brought[0] > SMALL_DECREASE * totals[1]


def test_cameras_are_not_touched():
    after, _ = refined(thrown(0, 0.3), 3)
    # the step itself is below 1e-25; it only shows where a number is exactly zero, such as k2
    np.testing.assert_allclose(after.cameras, support.tiny().cameras, rtol=0, atol=1e-25)


@pytest.mark.parametrize("loss", [Loss(), Loss("huber", 2.0)], ids=["squared", "huber"])
def test_every_point_ends_where_scipy_ends_on_that_point_alone(loss):
    problem = thrown(5, 0.05)
    found, _ = refined(problem, TO_THE_END, loss)
    rotations = geometry.rotation_matrices(problem.cameras[:, :3])
    for point in range(problem.num_points):
        own = problem.point_index == point
        cameras = problem.camera_index[own]
        seen = problem.observations[own]

        def residuals(x: np.ndarray, cameras=cameras, seen=seen) -> np.ndarray:
            local = rotations[cameras] @ x + problem.cameras[cameras, 3:6]
            r = support.distort(local[:, :2] / -local[:, 2:], problem.cameras[cameras, 6:]) - seen
            if loss.trivial:
                return r.ravel()
            squared = np.sum(r**2, axis=1)
            # the same direction with the length sqrt(rho), so that the sum of squares is the sum of
            # rho
            return (
                r * np.sqrt(published_loss(loss.rho, loss.scale, squared)[0] / squared)[:, None]
            ).ravel()

        best = least_squares(
            residuals, problem.points[point], method="lm", xtol=1e-15, ftol=1e-15, gtol=1e-15
        )
        # SciPy's derivatives, by differences, are off by 1e-8, and by that times its conditioning a
        # point's end
        np.testing.assert_allclose(found.points[point], best.x, rtol=1e-5, atol=2e-5)
        np.testing.assert_allclose(point_costs(found, loss)[point], best.cost, rtol=1e-9)


@pytest.mark.fully_compiled
@pytest.mark.parametrize("damping", [1e-12, 1e-6, 1e-2, 1.0])
def test_refinement_never_makes_the_candidate_of_a_step_worse(damping):
    for seed, size in ((0, 0.0), (1, 0.3), (2, 2.0)):
        layout, before = start(thrown(seed, size))
        plain = step(layout, before, damping, StepOptions())[1]
        with_points = step(layout, before, damping, StepOptions(refinement=Refinement(points=3)))[1]
        # two programs; without damping a direction that hardly costs anything is known to few
        # digits
        assert not with_points.candidate_cost > plain.candidate_cost * (1 + 1e-8)
        np.testing.assert_allclose(with_points.predicted, plain.predicted, rtol=1e-8)


def test_a_bold_step_that_fails_alone_is_saved_by_its_points():
    """Points thrown far, next to no damping: the plain step must be rejected, the refined one is
    taken."""
    problem = thrown(0, 2.0)
    layout, before = start(problem)
    after, plain = step(layout, before, 1e-8, StepOptions())
    assert not plain.accepted
    chex.assert_trees_all_equal(after, before, strict=True)
    _, info = step(layout, before, 1e-8, StepOptions(refinement=Refinement(points=3)))
    assert info.accepted
    assert info.cost < 0.1 * plain.previous_cost


def test_points_whose_rays_are_parallel_stay_finite():
    """Two cameras at one place leave the depth of their points open."""
    rng = np.random.default_rng(0)
    camera = [0.1, 0.2, -0.1, 0.3, 0.1, -5.0, 700.0, 0.0, 0.0]
    points = rng.normal(size=(6, 3))
    problem = BundleProblem.create(
        [camera, camera],
        points,
        rng.normal(scale=80, size=(12, 2)),
        np.tile([0, 1], 6),
        np.repeat(np.arange(6), 2),
    )
    options = StepOptions(refinement=Refinement(points=3))
    layout, before = start(problem, options)
    for damping in (STILL, 1e-2, 1e-8, 1e-16):
        after, info = step(layout, before, damping, options)
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(after))
        assert info.cost <= info.previous_cost


# Behind cameras


def depths(problem: BundleProblem) -> np.ndarray:
    """Distance along the viewing direction of every observation; negative behind the camera, which
    looks down -z."""
    turn = Rotation.from_rotvec(np.asarray(problem.cameras)[problem.camera_index, :3])
    local = turn.apply(np.asarray(problem.points)[problem.point_index])
    return -(local + np.asarray(problem.cameras)[problem.camera_index, 3:6])[:, 2]


def mirrored(problem: BundleProblem, which: np.ndarray) -> BundleProblem:
    """Points put where their first camera sees them at the same pixel, but behind it."""
    points = np.array(problem.points)
    for point in which:
        camera = problem.cameras[
            problem.camera_index[np.flatnonzero(problem.point_index == point)[0]]
        ]
        centre = -Rotation.from_rotvec(camera[:3]).inv().apply(camera[3:6])
        points[point] = 2 * centre - points[point]
    return problem.replace(points=points)


@functools.partial(jax.jit, static_argnames=("loss", "iterations"))
def _refined_after(layout, state, points, loss, iterations):
    """Points that a step took from those of the state to `points`, after point iterations."""
    previous = PreviousPoints.of(
        layout, state.points, linearize(layout, state.cameras, state.points, loss).reference
    )
    frames = slot_frames(layout, state.cameras)
    return refine_points(layout, state.cameras, frames, points, loss, iterations, previous)


def test_points_that_a_step_sent_behind_a_camera_start_again_from_previous():
    problem = support.tiny()
    lost = np.arange(0, 40, 3)
    layout, state = start(problem)
    assert (depths(problem) > 0).all()
    elsewhere = mirrored(problem, lost)
    assert (depths(elsewhere) < 0).any()
    _, there = start(elsewhere)
    from_previous, _ = _refined_after(layout, state, state.points, Loss(), 3)
    found, costs = _refined_after(layout, state, there.points, Loss(), 3)
    np.testing.assert_allclose(found, from_previous, rtol=1e-9)
    assert np.isfinite(costs).all()


def test_points_that_the_step_left_in_front_do_not_start_from_previous():
    problem = support.tiny()
    lost = np.arange(0, 40, 3)
    layout, state = start(problem)
    moved = problem.replace(points=np.array(problem.points) + 0.3)
    _, there = start(moved)
    _, both = start(mirrored(moved, lost))
    apart, _ = _refined_after(layout, state, there.points, Loss(), 1)
    mixed, _ = _refined_after(layout, state, both.points, Loss(), 1)
    at_previous, _ = _refined_after(layout, state, state.points, Loss(), 1)
    came_back = (np.asarray(mixed) == np.asarray(at_previous)).all(axis=0)
    stayed = (np.asarray(mixed) == np.asarray(apart)).all(axis=0)
    real = [(point == problem.points).all(axis=1).any() for point in np.asarray(state.points).T]
    assert (came_back ^ stayed)[real].all()
    assert came_back[real].sum() == len(lost)


# Far away


def nearness(problem: BundleProblem) -> np.ndarray:
    """Sum of inverse depths of every point."""
    return np.bincount(problem.point_index, 1 / depths(problem), problem.num_points)


def parallel(seed: int) -> BundleProblem:
    """Points in pictures from two cameras a hundredth of their distance apart, noisy enough that
    half of the rays meet nowhere: the cheapest places are at infinity and beyond."""
    rng = np.random.default_rng(seed)
    points = np.column_stack([rng.uniform(-2, 2, (60, 2)), rng.uniform(-12, -8, 60)])
    cameras = [[0, 0, 0, shift, 0, 0, 500.0, 0, 0] for shift in (0.0, 0.1)]
    camera = np.tile([0, 1], 60)
    point = np.repeat(np.arange(60), 2)
    local = points[point] + np.array(cameras)[camera, 3:6]
    pixels = -500 * local[:, :2] / local[:, 2:] + rng.normal(scale=5, size=(120, 2))
    return BundleProblem.create(cameras, points, pixels, camera, point)


def settled(problem: BundleProblem, iterations: int) -> BundleProblem:
    """The problem with its points after point iterations alone."""
    layout, state = start(problem)
    found, _ = _refined_after(layout, state, state.points, Loss(), iterations)
    order = np.asarray(layout.points)
    points = np.array(problem.points)
    real = order < problem.num_points
    points[order[real]] = np.asarray(found).T[real]
    return problem.replace(points=points)


@pytest.mark.parametrize("iterations", [1, 3, 10])
def test_no_point_goes_a_hundred_times_as_far_in_one_go_nor_beyond_infinity(iterations):
    problem = parallel(0)
    before = nearness(problem)
    after = nearness(settled(problem, iterations))
    assert (after >= before / MAX_DISTANCE_RATIO * (1 - 1e-9)).all()


def test_points_whose_rays_meet_far_away_come_near_to_them_iteration_by_iteration():
    """What stops a point is no wall: the next iteration goes on."""
    problem = parallel(0)
    distance = []
    for _ in range(4):
        distance.append(np.max(1 / nearness(problem)))
        problem = settled(problem, 10)
    assert (np.diff(distance) > 0).all()
    assert distance[-1] > 2 * MAX_DISTANCE_RATIO * distance[0]


def test_points_that_the_step_brought_from_behind_to_the_front_stay_there():
    problem = support.tiny()
    layout, there = start(problem)
    _, state = start(mirrored(problem, np.arange(problem.num_points)))
    points = np.asarray(state.points).T
    alone = _refined_after(layout, there, there.points, Loss(), 2)[0]
    came = _refined_after(layout, there._replace(points=state.points), there.points, Loss(), 2)[0]
    assert not np.allclose(points.T, there.points)
    np.testing.assert_array_equal(came, alone)


def test_a_point_that_the_step_took_far_away_starts_again_from_previous():
    problem = support.tiny()
    layout, state = start(problem)
    centre = np.mean(
        [-Rotation.from_rotvec(c[:3]).inv().apply(c[3:6]) for c in problem.cameras], axis=0
    )
    at_previous, _ = _refined_after(layout, state, state.points, Loss(), 1)
    real = [(point == problem.points).all(axis=1).any() for point in np.asarray(state.points).T]
    for times, came_back in ((3e3, True), (3.0, False)):
        points = centre + times * (np.asarray(problem.points) - centre)
        moved = problem.replace(points=points)
        assert ((nearness(moved) < nearness(problem) / MAX_DISTANCE_RATIO) == came_back).all()
        _, there = start(moved)
        found, _ = _refined_after(layout, state, there.points, Loss(), 1)
        assert ((np.asarray(found) == np.asarray(at_previous)).all(axis=0)[real] == came_back).all()


@needs_data
@pytest.mark.slow
def test_points_of_a_street_stay_in_front_of_their_cameras():
    """kittistereo00s: without a previous place to return to, it ended at 2952 with 61 observations
    behind."""
    folder = bal_file("x").parent.parent / "bal-converted"
    problem = read_bal(folder / "kittistereo00s-77-15638-pre.txt.bz2")
    solution = solve(problem, "bold")
    assert (depths(problem) > 0).all()
    assert (depths(solution.problem) > 0).mean() > 0.9999
    assert solution.final_cost < 2904
