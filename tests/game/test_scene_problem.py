"""A scene of the game as a problem of its own."""

from __future__ import annotations

import jax
import numpy as np
import pytest
import support
from tiny_game import KIND, problem_of

from jaxba import StepOptions
from jaxba.game.random_scenes import make_scenes
from jaxba.game.scene_bank import MIN_OBSERVATIONS, draw, info_of, initial_costs, worth_solving
from jaxba.game.scene_layout import scene_problem


@pytest.mark.slow
def test_a_scene_has_the_cost_of_its_start_and_no_more_than_what_is_observed():
    scenes = make_scenes(KIND, jax.random.key(5), 64)
    costs = initial_costs(KIND, scenes)
    for number in worth_solving(KIND, info_of(KIND, scenes, costs, 1))[:3]:
        problem = scene_problem(KIND, scenes, int(number))
        assert problem.num_observations == problem_of(KIND, scenes, int(number)).num_observations
        assert set(problem.camera_index) == set(range(problem.num_cameras))
        assert set(problem.point_index) == set(range(problem.num_points))
        np.testing.assert_allclose(support.cost(problem, StepOptions()), costs[number], rtol=1e-8)


def test_scenes_are_drawn_by_number():
    key = jax.random.key(0)
    first, again, other = (draw(KIND, key, number) for number in (3, 3, 4))
    assert support.same_bits(first, again)
    assert not support.same_bits(first.cameras, other.cameras)
    assert first.num_observations >= MIN_OBSERVATIONS
