"""The search for points at other depths: it finds what hangs elsewhere, moves nothing else, and
never costs more."""

from __future__ import annotations

from dataclasses import replace

import chex
import jax
import numpy as np
import pytest
import support
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from support import published_loss, solve, solve_options, solved, strayed, thrown

import jaxba
from jaxba import (
    BundleProblem,
    Loss,
    ProblemError,
    Refinement,
    Solution,
    SolveOptions,
    Termination,
    Tolerances,
    retriangulate,
    solve_and_retriangulate,
)
from jaxba.problem import geometry


def point_costs(problem: BundleProblem, loss: Loss) -> np.ndarray:
    """Cost of each point's observations."""
    squared = np.sum(geometry.residuals(problem) ** 2, axis=1)
    values = 0.5 * published_loss(loss.rho, loss.scale, squared)[0]
    return np.bincount(problem.point_index, values, minlength=problem.num_points)


# What hangs elsewhere


@pytest.mark.parametrize("factor", [-1.0, -3.0, 1e-2, 30.0, 1e4])
def test_points_behind_their_cameras_or_far_away_are_found_again(factor):
    start = strayed(factor)
    found = retriangulate(start)
    assert found.moved == np.sum(np.any(start.points != solved().points, axis=1))
    np.testing.assert_allclose(found.cost_after, geometry.cost(solved()), rtol=1e-6)
    assert (geometry.depths(found.problem) > 0).all()


@pytest.mark.parametrize("loss", [Loss(), Loss("cauchy", 2.0)], ids=["squared", "cauchy"])
@pytest.mark.parametrize(
    "make", [lambda: thrown(1, 3.0), support.odd, support.whitened], ids=["far", "odd", "white"]
)
def test_no_point_costs_more_and_what_did_not_move_keeps_every_bit(make, loss):
    problem = make()
    found = retriangulate(problem, loss)
    before = point_costs(problem, loss)
    after = point_costs(found.problem, loss)
    moved = np.any(np.asarray(found.problem.points) != problem.points, axis=1)
    assert found.moved == moved.sum()
    assert (after[moved] < before[moved]).all()
    chex.assert_trees_all_equal(found.problem.replace(points=problem.points), problem, strict=True)
    np.testing.assert_allclose(
        [found.cost_before, found.cost_after], [before.sum(), after.sum()], rtol=1e-9
    )

    def hidden(p):
        return np.bincount(p.point_index, geometry.depths(p) < 0, minlength=p.num_points)

    assert (hidden(found.problem) <= hidden(problem)).all()


def test_what_is_found_is_a_minimum_of_that_point_alone():
    """SciPy starts where the search ended and finds nothing better nearby."""
    problem = retriangulate(strayed(16.0)).problem
    for point in range(0, problem.num_points, 5):
        seen = problem.point_index == point
        cameras = np.asarray(problem.cameras)[problem.camera_index[seen]]
        pixels = problem.observations[seen]

        def residual(x: np.ndarray, cameras=cameras, pixels=pixels) -> np.ndarray:
            local = Rotation.from_rotvec(cameras[:, :3]).apply(x) + cameras[:, 3:6]
            return (support.distort(-local[:, :2] / local[:, 2:], cameras[:, 6:]) - pixels).ravel()

        best = least_squares(
            residual, problem.points[point], method="lm", xtol=1e-14, ftol=1e-14
        ).cost
        np.testing.assert_allclose(point_costs(problem, Loss())[point], best, rtol=1e-8)


def test_at_the_minimum_nothing_moves():
    found = retriangulate(solved())
    assert found.moved == 0
    assert found.cost_after == found.cost_before
    chex.assert_trees_all_equal(found.problem, solved(), strict=True)


def test_units_and_axes_of_the_scene_do_not_matter():
    start = strayed(-1.0)
    turn = Rotation.from_rotvec([0.3, -0.5, 0.2])
    scale = 250.0
    shift = np.array([7.0, -3.0, 11.0])
    cameras = np.array(start.cameras)
    rotation = Rotation.from_rotvec(cameras[:, :3]) * turn.inv()
    cameras[:, :3] = rotation.as_rotvec()
    cameras[:, 3:6] = scale * cameras[:, 3:6] - rotation.apply(shift)
    other = start.replace(cameras=cameras, points=scale * turn.apply(start.points) + shift)
    np.testing.assert_allclose(geometry.cost(other), geometry.cost(start), rtol=1e-9)
    one = retriangulate(start)
    two = retriangulate(other)
    assert one.moved == two.moved > 0
    np.testing.assert_allclose(two.cost_after, one.cost_after, rtol=1e-6)


@pytest.mark.xla
def test_a_second_problem_of_equal_shape_compiles_nothing():
    events = []
    retriangulate(strayed(2.0))

    def listen(event: str, seconds: float, **_: object) -> None:
        if "compile" in event:
            events.append(event)

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        retriangulate(strayed(-1.0))
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)
    assert not events


def test_a_cost_that_is_not_finite_is_refused():
    cameras = [[0, 0, 0, 0, 0, -4.0, 500, 0, 0]] * 2  # look down -z from z = 4
    problem = BundleProblem.create(cameras, [[0.5, -0.4, 4.0]], [[60.0, -20.0]] * 2, [0, 1], [0, 0])
    with pytest.raises(ProblemError, match="not finite: observation 0"):
        retriangulate(problem)


# In turns with the solve


STRANDING = solve_options(refinement=Refinement(points=3))
"""A step that leaves a point in the valley where it is; `bold` looks where its rays meet."""


def one_diverged() -> BundleProblem:
    """One point of forty behind its cameras: it drags them along, and such a solve converges far
    above the minimum."""
    return strayed(-3.0, every=40)


def in_turns(options: SolveOptions = STRANDING, **heard) -> Solution:
    """That point, searched for in turns with the solve."""
    return solve_and_retriangulate(one_diverged(), "ceres", options, **heard)


def no_search(_) -> None:
    pytest.fail("a search")


@pytest.mark.slow
def test_a_step_that_asks_the_rays_finds_the_point_by_itself():
    np.testing.assert_allclose(
        solve(one_diverged(), "bold").final_cost, geometry.cost(solved()), rtol=1e-6
    )
    assert jaxba.solve(one_diverged(), "ceres", STRANDING).final_cost > 1.1 * geometry.cost(
        solved()
    )


@pytest.mark.slow
def test_turns_end_lower_than_the_solve_alone_and_count_through():
    heard = []
    searches = []
    alone = jaxba.solve(one_diverged(), "ceres", STRANDING)
    both = in_turns(callback=heard.append, on_search=searches.append)
    assert both.converged
    assert alone.converged
    assert both.final_cost < alone.final_cost / 1.1
    np.testing.assert_allclose(both.final_cost, geometry.cost(solved()), rtol=1e-6)
    np.testing.assert_allclose(both.final_cost, geometry.cost(both.problem), rtol=1e-10)
    assert both.initial_cost == alone.initial_cost
    assert [record.iteration for record in heard] == list(range(1, both.iterations + 1))
    assert np.all(np.diff([record.time_s for record in heard]) > 0)
    assert all(len(field) == both.iterations for field in both.history)
    assert both.accepted == both.history.accepted.sum()
    assert np.all(np.diff(both.history.cost) <= 0)
    # the first search moved points, the last one had nothing left to do
    assert len(searches) >= 2
    assert searches[0].moved > 0
    assert searches[-1].cost_before - searches[-1].cost_after <= 1e-6 * searches[-1].cost_before


def test_where_there_is_nothing_to_find_it_is_the_solve():
    problem = support.tiny()
    watched = solve(problem, "ceres", callback=lambda record: None)  # of two programs, as it is
    found = solve_and_retriangulate(problem, "ceres", solve_options())
    chex.assert_trees_all_equal(found.problem, watched.problem, strict=True)


def test_all_iterations_together_keep_the_limit():
    alone = jaxba.solve(one_diverged(), "ceres", STRANDING)
    for more in (0, 1):
        both = in_turns(replace(STRANDING, max_iterations=alone.iterations + more))
        assert both.iterations == alone.iterations + more
        assert both.converged == (more == 0)
    assert both.termination == Termination.MAX_ITERATIONS
    assert both.final_cost < alone.final_cost


def test_a_stop_by_the_callback_ends_all_of_it():
    stopped = in_turns(callback=lambda record: record.iteration == 2, on_search=no_search)
    assert stopped.termination == Termination.STOPPED
    assert stopped.iterations == 2
    last = jaxba.solve(one_diverged(), "ceres", STRANDING).iterations
    converged = in_turns(callback=lambda record: record.iteration == last, on_search=no_search)
    assert converged.termination == Termination.COST
    assert converged.iterations == last


def test_the_search_counts_the_loss_of_the_solve():
    searches = []
    loss = Loss("cauchy", 2.0)
    found = solve_and_retriangulate(
        support.tiny(), "ceres", solve_options(loss=loss), on_search=searches.append
    )
    np.testing.assert_allclose(
        searches[0].cost_before, point_costs(found.problem, loss).sum(), rtol=1e-9
    )
    assert searches[0].cost_before < 0.95 * geometry.cost(found.problem)


def test_what_does_not_pay_is_dropped():
    """With a tolerance so wide that no search pays, the solve alone is what comes back."""
    searches = []
    wide = replace(STRANDING, tolerances=Tolerances(ftol=0.5))
    both = in_turns(wide, on_search=searches.append)
    (search,) = searches
    assert search.moved > 0
    assert not search.pays(0.5)
    watched = jaxba.solve(one_diverged(), "ceres", wide, callback=lambda _: None)
    chex.assert_trees_all_equal(both.problem, watched.problem, strict=True)
