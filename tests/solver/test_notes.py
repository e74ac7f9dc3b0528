"""What was measured and does not fit is a note with names, and what fits has none."""

from __future__ import annotations

import numpy as np
import pytest
import support

import jaxba
from jaxba.problem import geometry
from jaxba.problem.labels import Labels

SIGMA = 0.01  # standard deviation of measured positions, scene units; the scene is some units large
NAMES = tuple(f"{letter}.jpg" for letter in "abcdef")


def measured(off: np.ndarray, **more) -> jaxba.Solution:
    """The solution of a scene whose images were measured with normal errors and so far off besides."""
    problem = support.solved()
    count = problem.num_cameras
    labels = Labels(NAMES, 10 + np.arange(count), np.arange(count), np.arange(problem.num_points))
    noise = SIGMA * np.random.default_rng(7).normal(size=(count, 3))
    positions = geometry.camera_centers(problem.cameras) + noise + off
    problem = jaxba.with_position_priors(problem.replace(labels=labels), positions, stddev=SIGMA, align=False, **more)
    return support.solve(problem)


def test_positions_that_fit_have_no_note():
    assert measured(np.zeros((6, 3))).notes == ()


def test_a_position_that_does_not_fit_is_named():
    off = np.zeros((6, 3))
    off[2, 0] = 1.0
    (note,) = measured(off).notes
    assert note.startswith("position_prior: ")
    assert "image 12 (c.jpg)" in note


def test_a_solve_without_iterations_says_nothing_of_what_fits():
    solution = measured(np.ones((6, 3)))
    assert solution.problem.residuals
    unsolved = jaxba.solve(solution.problem, options=jaxba.SolveOptions(max_iterations=0))
    assert unsolved.notes == ()


@pytest.mark.parametrize("count", [1, 6])
def test_notes_of_problems_without_measurements_are_empty(count):
    assert support.solve(support.tiny(), max_iterations=count).notes == ()
