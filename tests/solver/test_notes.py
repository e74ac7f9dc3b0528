"""What was measured and does not fit is a note with names, and what fits has none."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
import support

import jaxba
from jaxba.model.registration import residuals_of_rows
from jaxba.problem import geometry
from jaxba.problem.labels import Labels
from jaxba.solver.redundancy import Noise, left_of

SIGMA = 0.01  # standard deviation of measured positions, scene units; the scene is some units large
QUICK = support.solve_options(compilation="quick")
NAMES = tuple(f"{letter}.jpg" for letter in "abcdef")


def measured(off: np.ndarray, **more) -> jaxba.Solution:
    """The solution of a scene whose images were measured with normal errors and so far off
    besides."""
    problem = support.solved()
    count = problem.num_cameras
    labels = Labels(NAMES, 10 + np.arange(count), np.arange(count), np.arange(problem.num_points))
    noise = SIGMA * np.random.default_rng(7).normal(size=(count, 3))
    positions = geometry.camera_centers(problem.cameras) + noise + off
    problem = jaxba.with_position_priors(
        problem.replace(labels=labels), positions, stddev=SIGMA, align=False, **more
    )
    return jaxba.solve(problem, "ceres", QUICK)


def test_positions_that_fit_have_no_note():
    assert measured(np.zeros((6, 3))).notes == ()


def test_a_position_that_does_not_fit_is_named_with_how_far_off_it_is():
    off = np.zeros((6, 3))
    off[2, 0] = 1.0
    (note,) = measured(off).notes
    assert note.startswith("position_prior: does not fit the rest: image 12 (c.jpg) is ")
    amount, along = re.search(r"is ([\d.]+) \(x (-[\d.]+),", note).groups()
    assert 0.9 < float(amount) < 1.1
    assert -1.1 < float(along) < -0.9
    assert "(a.jpg)" not in note


@pytest.mark.slow
def test_a_wrong_position_under_a_robust_loss_is_named_as_well():
    off = np.zeros((6, 3))
    off[4] = [0.0, -2.0, 1.0]
    (note,) = measured(off, loss=jaxba.Loss("cauchy", 1.0)).notes
    assert note.startswith("position_prior: does not fit the rest: image 14 (e.jpg) is 2.")


def test_standard_deviations_that_are_too_small_are_called_that():
    off = 4 * SIGMA * np.random.default_rng(3).choice([-1.0, 1.0], (6, 3))
    (note,) = measured(off).notes
    (factor,) = re.search(r"standard deviations should be ([\d.]+) times as large", note).groups()
    assert 2 < float(factor) < 5


def test_positions_of_other_images_are_all_wrong():
    centers = geometry.camera_centers(support.solved().cameras)
    (note,) = measured(centers[[3, 0, 5, 2, 1, 4]] - centers).notes
    assert note.startswith("position_prior: does not fit the rest, by ")
    assert "axes" in note


def test_what_is_left_of_rows_is_what_solves_of_other_measurements_leave():
    """The change of all residuals with a number of one row, by two solves, is a column of the
    cofactors. Pixels and positions are exact: curved residuals would change the slope."""
    problem = measured(np.zeros((6, 3))).problem
    (rows,) = problem.residuals.rows
    centers = geometry.camera_centers(problem.cameras)
    problem = problem.replace(observations=geometry.project(problem))
    options = replace(QUICK, tolerances=jaxba.Tolerances(ftol=1e-15, xtol=1e-13, gtol=1e-12))
    ends = []
    step = 0.05
    for sign in (-1, 1):
        position = np.array(centers)
        position[3, 1] -= sign * step * SIGMA  # the residual before the solve grows by a step
        changed = replace(problem.residuals, rows=(replace(rows, data=(position, rows.data[1])),))
        solution = jaxba.solve(problem.replace(residuals=changed), "ceres", options)
        ends.append(residuals_of_rows(solution.problem)[0].ravel())
    none = np.zeros(problem.num_observations, bool)
    left, _ = left_of(problem, none, jaxba.Loss(), "free", Noise(1.0, 1.0))
    np.testing.assert_allclose(
        (ends[1] - ends[0]) / (2 * step), left.cofactor[:, 3 * 3 + 1], atol=1e-5
    )


def test_a_solve_without_iterations_says_nothing_of_what_fits():
    solution = measured(np.ones((6, 3)))
    assert solution.problem.residuals
    unsolved = jaxba.solve(solution.problem, options=jaxba.SolveOptions(max_iterations=0))
    assert unsolved.notes == ()


@pytest.mark.parametrize("count", [1, 6])
def test_notes_of_problems_without_measurements_are_empty(count):
    assert support.solve(support.tiny(), max_iterations=count).notes == ()


@pytest.mark.slow
def test_a_wrong_bar_that_the_pixels_give_way_to_is_named():
    """Few images with lenses of their own: a point moves along its rays, and the bar has a tenth of
    its deviation."""
    problem = measured(np.zeros((6, 3))).problem
    length = np.linalg.norm(problem.points[0] - problem.points[1])
    bar = jaxba.residuals.distance(point=[0], point_2=[1], length=1.2 * length, sigma=SIGMA)
    solution = jaxba.solve(jaxba.with_residual(problem, bar), "ceres", QUICK)
    assert np.abs(residuals_of_rows(solution.problem)[1]).max() < 0.5
    (note,) = solution.notes
    (error,) = re.search(
        r"^distance: does not fit the rest: point 0 and point 1 is (-[\d.]+) or", note
    ).groups()
    assert float(error) == pytest.approx(-0.2 * length, rel=0.1)
